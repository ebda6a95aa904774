"""Maps as random finite sets, judged and kept: metrics of the last map, its course, methods by name, the joint."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from kalmap.evaluation import evaluate, gospa, ospa, set_cutoffs
from kalmap.kernels import set_layout as sets
from kalmap.records import ConfigError, FilterConfig, FiniteSetConfig, RunConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import run, slam_from_config
from kalmap.slam.map_course import CourseKeeper
from kalmap.study import Case, Method, parse_method
from kalmap.study.cases import run_case
from kalmap.study.present import method_label
from kalmap.study.set_course import course_metrics, judge_course
from test_evaluation_metrics import log as course_log  # noqa: F401
from test_evaluation_metrics import moved, result_of


def short_world(**fields):
    return msgspec.structs.replace(world_by_name("phd-2"), observe_every=80, **fields)


@pytest.fixture(scope="module")
def short():
    """A log of 73 looks, the settings of a PHD filter on it, the filter after it, and what the run came to."""
    log = simulate(short_world(), 3)
    config = parse_method("rb-phd", finite_set=log.defaults.finite_set).on(log.defaults)
    slam = slam_from_config(config, log)
    return log, config, slam, run(slam, log)


def with_map(estimate, positions):
    count = len(positions)
    landmarks = msgspec.structs.replace(
        estimate.landmarks,
        ids=np.arange(count),
        positions=positions,
        covariances=np.tile(np.eye(2), (count, 1, 1)),
        sightings=np.ones(count, int),
        existence=np.ones(count),
    )
    return msgspec.structs.replace(estimate, landmarks=landmarks)


def test_the_last_map_is_judged_as_a_set(course_log):  # noqa: F811
    """Oracle: the distances themselves, of 33 features 0.3 m off, and one that is none."""
    trace, estimate = result_of(course_log)
    true = course_log.references[0].landmarks
    found = np.concatenate([true[:33] + [0.3, 0.0], [[500.0, 500.0]]])
    metrics = evaluate(trace, with_map(estimate, found), course_log, ids_known=False)
    near, far = ospa(found, true, cutoff=10.0), gospa(found, true, cutoff=20.0)
    assert metrics["ospa_m"] == pytest.approx(near.value)
    assert metrics["ospa_m"] == pytest.approx(math.sqrt((33 * 0.09 + 2 * 100.0) / 35))
    assert metrics["ospa_localisation_m"] == pytest.approx(near.localisation)
    assert metrics["ospa_cardinality_m"] == pytest.approx(near.cardinality)
    assert metrics["gospa_m"] == pytest.approx(far.value)
    assert (metrics["gospa_missed"], metrics["gospa_false"], metrics["cardinality_error"]) == (2, 1, -1)
    assert (metrics["ospa_cutoff_m"], metrics["gospa_cutoff_m"]) == (10.0, 20.0)


def test_it_is_judged_after_the_alignment_of_the_trajectory(course_log):  # noqa: F811
    trace, estimate = result_of(course_log, errors=np.zeros((1, 3)))
    elsewhere = msgspec.structs.replace(course_log, references=(moved(course_log),))
    for known in (True, False):
        metrics = evaluate(trace, estimate, elsewhere, ids_known=known)
        assert metrics["ospa_m"] == pytest.approx(0.0, abs=1e-6) and metrics["cardinality_error"] == 0


def test_without_true_landmarks_nothing_is_said(course_log):  # noqa: F811
    trace, estimate = result_of(course_log)
    bare = msgspec.structs.replace(course_log.references[0], landmarks=np.zeros((0, 2)))
    metrics = evaluate(trace, estimate, msgspec.structs.replace(course_log, references=(bare,)))
    assert metrics["ospa_m"] is metrics["gospa_m"] is metrics["cardinality_error"] is None
    nothing = evaluate(trace, with_map(estimate, np.zeros((0, 2))), course_log, ids_known=False)
    assert nothing["ospa_m"] == 10.0 and nothing["cardinality_error"] == -35


def test_the_cut_offs_shrink_with_a_short_sensor():
    assert set_cutoffs(80.0) == set_cutoffs(15.0) == (10.0, 20.0)
    assert set_cutoffs(3.0) == pytest.approx((2.0, 4.0))


def test_a_world_states_its_detection_and_clutter():
    stated = world_by_name("rfs-70-6").defaults().finite_set
    assert (stated.detection, stated.clutter) == (0.7, pytest.approx(0.46 * 4 * math.pi))
    assert world_by_name("course-35").defaults().finite_set.detection == 1.0
    assert world_by_name("faded-35").defaults().finite_set.detection == pytest.approx(0.625)
    assert world_by_name("grove").defaults().finite_set == FiniteSetConfig()


def test_methods_of_sets_by_name():
    own = FiniteSetConfig(clutter=3.0, particles=7, weighting="empty")
    method = parse_method(" SRCKF-PHD:Motion:single-feature ", finite_set=own)
    assert method.name == "srckf-phd:motion:single-feature"
    assert method.finite_set == FiniteSetConfig(
        method="srckf-phd", clutter=3.0, particles=7, proposal="motion", weighting="single-feature"
    )
    assert parse_method("pmb", finite_set=own).finite_set.weighting is None
    assert parse_method("ekf", finite_set=own).finite_set is None
    for text, said in (
        ("rb-phd:jcbb", "unknown suffix 'jcbb'.*:motion.*:multi-feature"),
        ("rb-phd:motion:sightings", "motion and sightings contradict"),
        ("pmb:empty", "one way only"),
        ("ekf:motion", "unknown suffix 'motion'"),
        ("phd", "unknown filter 'phd'.*rb-phd"),
    ):
        with pytest.raises(ConfigError, match=said):
            parse_method(text)


def test_each_family_gets_its_own_settings():
    """A method of filters turns off that of sets which the settings may name, and the other way round."""
    base = RunConfig(finite_set=FiniteSetConfig(method="pmb", clutter=4.0))
    kalman = Method("ekf", FilterConfig(name="ekf")).on(base)
    assert kalman.by_ids and not kalman.by_place and kalman.finite_set.clutter == 4.0
    sets = parse_method("rb-phd:motion", finite_set=base.finite_set).on(base)
    assert not sets.by_ids and not sets.by_place
    assert method_label(kalman) == "ekf, invariant"
    assert method_label(sets) == "rb-phd, 10 particles, motion proposal"


class Counting:
    """Stands in for a filter: one landmark at (frame, 0)."""

    config = FiniteSetConfig()

    def __init__(self):
        self.time = 0.0

    def map(self):
        row = np.zeros((1, 64))
        row[0, :] = 1.0
        row[0, 1:3] = self.time
        return row

    def landmark_places(self):
        return np.array([[self.time, 0.0]])


@pytest.mark.parametrize(("frames", "kept"), [(0, 0), (1, 1), (400, 400), (401, 201), (5000, 313)])
def test_a_course_never_grows_long(frames, kept):
    """Evenly spaced instants, at most 400, with the first among them."""
    slam = Counting()
    keeper = CourseKeeper(slam)
    for number in range(frames):
        slam.time = float(number)
        keeper.frame()
    course = keeper.course()
    assert len(course.times) == len(course.places) == kept
    assert frames == 0 or course.times[0] == 0.0
    assert len(np.unique(np.diff(course.times))) <= 1


def test_a_course_is_judged_by_what_was_in_view(short):
    """Oracle: the range and half plane of every look, by hand; the last map's distance, by itself."""
    log, config, _, outcome = short
    judged = judge_course(outcome, log, config)
    truth = log.references[0]
    looks = np.searchsorted(truth.times, judged.times + 1e-9) - 1
    seen, numbers = np.zeros(len(truth.landmarks), bool), []
    every = np.arange(80, looks[-1] + 1, 80)
    for row in np.concatenate([[0], every]):
        offset = truth.landmarks - truth.positions[row]
        ahead = offset @ [np.cos(truth.headings[row]), np.sin(truth.headings[row])]
        seen |= (np.hypot(*offset.T) < 30.0) & (ahead > 0.0)
        if row in looks:
            numbers.append(seen.sum())
    assert abs(judged.errors.true - numbers).max() <= 1  # it is asked at the samples between the looks too
    last = outcome.estimate.landmarks.positions
    assert judged.errors.estimated[-1] == len(last)
    everything = ospa(last, truth.landmarks, cutoff=10.0).value
    assert judged.errors.true[-1] == 39 and judged.errors.ospa[-1] == pytest.approx(everything)
    means = course_metrics(judged)
    assert means["ospa_course_m"] == pytest.approx(judged.errors.ospa.mean())
    assert means["cardinality_course_error"] == pytest.approx(
        np.abs(judged.errors.estimated - judged.errors.true).mean()
    )


def test_the_mixture_is_the_last_map(short):
    """Oracle: the rule, by the filter's own rows: landmarks are the components of a feature's weight, and of those
    that were sighted three times the ones that one miss at the largest P_D took below it."""
    _, config, slam, outcome = short
    mixture, landmarks = outcome.course.mixture, outcome.estimate.landmarks
    means, places = (set(map(tuple, points)) for points in (mixture.means, landmarks.positions))
    assert len(places) == len(landmarks) and places <= means
    heavy = mixture.means[mixture.weights >= config.finite_set.feature]
    assert set(map(tuple, heavy)) <= places  # and beside them those that were missed lately
    rows = slam.map()
    np.testing.assert_array_equal(rows[:, sets.WEIGHT], mixture.weights)
    feature, detection = config.finite_set.feature, slam.rates.profile.max()
    light, known = mixture.weights < feature, rows[:, sets.SEEN] >= 3.0
    forgiven = light & known & (mixture.weights >= feature * (1.0 - detection) ** config.finite_set.forgive)
    assert len(landmarks) == len(heavy) + forgiven.sum()
    assert places - set(map(tuple, heavy)) == set(map(tuple, mixture.means[forgiven]))
    assert forgiven.any() and (light & known & ~forgiven).any()
    assert np.linalg.eigvalsh(mixture.covariances).min() > 0.0


def test_a_study_keeps_the_course():
    method = parse_method("pmb", finite_set=FiniteSetConfig(particles=2))
    record = run_case(Case(short_world(), method, 1))
    sets = record.sets
    assert record.error is None and len(sets.times) == len(sets.ospa) == len(sets.true) > 70
    assert record.metrics["ospa_course_m"] == pytest.approx(np.mean(sets.ospa))
    assert run_case(Case(short_world(), Method("ekf", FilterConfig(name="ekf")), 1)).sets is None


def test_the_joint_holds_the_biases_too():
    """It can be saved: pose, biases and landmarks in this order, symmetric and positive semi-definite."""
    log = simulate(short_world(), 1)
    motion = msgspec.structs.replace(log.defaults.motion, biases=("steering_offset", "speed_scale"))
    base = msgspec.structs.replace(log.defaults, motion=motion)
    estimate = run(slam_from_config(parse_method("pmb").on(base), log), log).estimate
    mean, covariance = estimate.joint()
    assert len(mean) == 5 + 2 * len(estimate.landmarks) == len(covariance)
    assert mean[3:5] == pytest.approx([estimate.biases[name][0] for name in motion.biases])
    assert np.sqrt(np.diag(covariance)[3:5]) == pytest.approx(
        [estimate.biases[name][1] for name in motion.biases]
    )
    np.testing.assert_allclose(mean[5:], estimate.landmarks.positions.ravel())
    np.testing.assert_allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
