"""Association by the probability of pairs: against whole frames enumerated densely, and against simulated truth."""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from command import kalmap_inside
from kalmap.association import Existence, Keep, Merging, Pmb
from kalmap.geometry.ellipses import chi_square_2
from kalmap.models import Increments, RangeBearing
from kalmap.models.motion import motion_from_config
from kalmap.models.sensor import sensor_from_config
from kalmap.records import NEW, SPURIOUS, ConfigError, Odometry, Reason, Sightings
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, run
from matchings import matchings
from slam_problems import circle_events, feed

PLACES = np.array([[10.0, -0.4], [14.0, 0.1], [9.0, 0.6]])
SENSOR = RangeBearing(max_range=30.0, field_of_view=np.pi, sigma_range=0.1, sigma_bearing=0.01)
AREA = 30.0 * np.pi
GATE = chi_square_2(0.999)


def known(
    method: Pmb, *, sigma: float = 1.0, turn: float = 0.1, places=PLACES, seen: int = 1
) -> LandmarkSlam:
    """A filter that has landmarks there (range, bearing) and then has lost its own place by sigma m and turn rad."""
    slam = LandmarkSlam(Increments(), SENSOR, association=method)
    still = Odometry(0.0, np.zeros((1, 3)), np.ones(1))
    slam.step(still)
    for _ in range(seen):
        slam.step(Sightings(0.0, places))
    slam.step(Odometry(1.0, np.zeros((1, 3)), np.ones(1), np.diag([sigma**2, sigma**2, turn**2])[None]))
    return slam


def frame(*values) -> Sightings:
    return Sightings(1.0, np.array(values, dtype=float).reshape(-1, 2))


def enumerated(slam: LandmarkSlam, seen: Sightings, chance: np.ndarray, clutter: float) -> dict[tuple, float]:
    """ln of the frame's likelihood under every association inside the gates, by one dense Gaussian of its innovations.

    chance (C,): probability that each landmark is sighted if nothing hides it. clutter: a frame's false
    sightings.
    """
    predicted = slam.predicted(seen, slam.noises_of(seen))
    expected = predicted.expect(np.arange(predicted.count))
    count = len(expected.z)
    joint = predicted.cross(expected).transpose(0, 2, 1, 3).reshape(2 * count, 2 * count)
    squared, every = predicted.distances(expected)[0], {}
    missed = np.where(predicted.hidden(expected), 1.0, 1.0 - chance)
    for given in matchings(len(seen.values), count):
        rows = [m for m, c in enumerate(given) if c >= 0]
        if any(squared[m, given[m]] > GATE for m in rows):
            continue
        free = np.setdiff1d(np.arange(count), given)
        log = (len(given) - len(rows)) * np.log(clutter / AREA) + np.log(missed[free]).sum()
        if rows:
            columns = [given[m] for m in rows]
            entries = np.array([[2 * c, 2 * c + 1] for c in columns]).ravel()
            s = joint[np.ix_(entries, entries)] + np.kron(np.eye(len(rows)), predicted.noises[0])
            nu = (seen.values[rows] - expected.z[columns]).ravel()
            log += np.log(chance[columns]).sum() + multivariate_normal.logpdf(nu, cov=s)
        every[given] = float(log)
    return every


def pair_probabilities(every: dict[tuple, float], count: int) -> np.ndarray:
    """(M, C) over all associations."""
    logs = np.array(list(every.values()))
    shares, sets = np.exp(logs - np.logaddexp.reduce(logs)), np.array(list(every))
    return np.array([[shares[row == c].sum() for c in range(count)] for row in sets.T])


def certain(**more) -> Pmb:
    """No landmark on trial, and none in doubt after a few sightings: r is 1 to six digits."""
    return Pmb(management=Keep(), **more)


def chances(slam: LandmarkSlam, detection: float) -> np.ndarray:
    """(C,) P_D r."""
    return detection * np.array(slam.association.existence(slam.memory))


def test_a_lone_sighting_in_a_wide_gate_is_not_taken_and_three_that_agree_are():
    """Oracle: the pairs' probabilities by enumeration: one sighting where a landmark would be seen from three
    metres beside, in a gate that often holds clutter, could be either; with two others seen from there it is sure."""
    places = np.array([[10.0, -1.2], [20.0, 0.0], [10.0, 1.2]])
    points = places[:, :1] * np.c_[np.cos(places[:, 1]), np.sin(places[:, 1])] - [2.0, -2.0]
    beside = np.c_[np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])]
    for rows, taken in (([0], False), ([0, 1, 2], True)):
        slam = known(certain(), places=places, seen=6)
        slam.memory["false"], slam.memory["detected"] = [100.0, 20.0], [[18.0, 20.0]] * 6
        slam.explain = True
        seen = frame(*beside[rows])
        pairs = pair_probabilities(enumerated(slam, seen, chances(slam, 0.9), 5.0), 3)
        of_each = pairs[np.arange(len(rows)), rows]
        assert (of_each > 0.96).all() if taken else 0.3 < of_each < 0.9
        slam.step(seen)
        assert slam.frame_association.matched.tolist() == (rows if taken else [SPURIOUS])
        reason = Reason.PROBABLE if taken else Reason.IMPROBABLE
        assert slam.frame_decision.why.reasons.tolist() == [reason] * len(rows)


def test_a_pair_is_taken_exactly_if_it_is_sure():
    """Oracle: the pairs' probabilities by enumeration of 120 frames with the robot lost by a metre: taken are
    those of at least 0.95; within 0.02 of it either may be, for the associations that no growth reaches."""
    both = {True: 0, False: 0}
    for seed in range(120):
        rng = np.random.default_rng(seed)
        slam = known(certain(false_rate=1.0), seen=6, places=PLACES[: rng.integers(1, 4)])
        slam.memory["false"] = [20.0, 20.0]
        slam.memory["detected"] = [[18.0, 20.0]] * 6
        count, common = slam.landmark_count, rng.normal(0, [1.0, 0.1])
        real = PLACES[:count][rng.random(count) < 0.7] + common
        false = np.c_[rng.uniform(5, 20, 1), rng.uniform(-1, 1, 1)]
        seen = frame(*np.vstack([real, false]))
        pairs = pair_probabilities(enumerated(slam, seen, chances(slam, 0.9), 1.0), count)
        matched = slam.association.associate(
            slam.memory, seen, slam.predicted(seen, slam.noises_of(seen))
        ).matched
        for m, c in np.ndindex(pairs.shape):
            if abs(pairs[m, c] - 0.95) > 0.02:
                assert (matched[m] == c) == (pairs[m, c] > 0.95), (seed, m, c, pairs[m, c])
                both[bool(matched[m] == c)] += 1
    assert min(both.values()) > 40


def test_existence_is_a_bernoulli_update():
    """Oracle: by hand for two landmarks: odds times P_D N(nu; 0, S) / c of the one sighted, times 1 - P_D of the one
    missed; a sighting that founds one begins at new_rate / clutter."""
    places = PLACES[:2]
    slam = known(certain(), sigma=0.02, turn=0.002, places=places)
    slam.memory["odds"], slam.memory["false"] = [1.5, 2.5], [10.0, 20.0]
    slam.memory["detected"] = [[16.0, 20.0] for _ in range(6)]
    seen = frame(places[0] + [0.05, 0.004], [25.0, -1.0])
    predicted = slam.predicted(seen, slam.noises_of(seen))
    expected = predicted.expect(np.arange(2))
    s = expected.spreads[0] + predicted.noises[0]
    density = multivariate_normal.pdf(seen.values[0] - expected.z[0], cov=s)
    slam.step(seen)
    assert slam.frame_association.matched.tolist() == [0, NEW]
    exact = [1.5 + np.log(0.8 * density / (0.5 / AREA)), 2.5 + np.log(0.2), np.log(0.2 / 0.5)]
    np.testing.assert_allclose(slam.memory["odds"], exact, rtol=1e-9)
    r = 1.0 / (1.0 + np.exp(-np.array(exact)))
    np.testing.assert_allclose(slam.estimate().landmarks.existence, r, rtol=1e-9)
    assert slam.memory["false"] == [11.0, 21.0]
    assert slam.memory["detected"] == [[16.0, 20.0], [16.0, 20.0], [17.0, 22.0], *[[16.0, 20.0]] * 3]


def test_existence_stays_within_bounds():
    """Oracle: by hand: ln odds end at 12; misses in a row of one that is believed, at 0."""
    slam = known(certain(), sigma=0.01, turn=0.001, places=PLACES[:1])
    for _ in range(20):
        slam.step(frame(PLACES[0]))
    assert slam.memory["odds"] == [12.0]
    for _ in range(60):
        slam.step(frame())
    assert slam.memory["odds"] == [0.0]


def test_the_options_weigh_as_the_associations():
    """Oracle: ln of the frame's likelihood under each association, enumerated: one sighting between two landmarks,
    with the robot lost so that every pair tells; each option's log is the exact one, and so are their shares."""
    places = np.array([[10.0, 0.0], [11.5, 0.0]])
    slam = known(certain(false_rate=0.5), places=places, seen=6)
    slam.memory["false"], slam.memory["detected"] = [10.0, 20.0], [[18.0, 20.0]] * 6
    seen = frame([10.6, 0.03])
    every = enumerated(slam, seen, chances(slam, 0.9), 0.5)
    predicted = slam.predicted(seen, slam.noises_of(seen))
    before = copy.deepcopy(slam.memory)
    options = slam.association.options(slam.memory, seen, predicted, 10)
    assert slam.memory == before and [o.association.matched.tolist() for o in options[:2]] == [[0], [1]]
    got = {tuple(max(m, -1) for m in o.association.matched.tolist()): o.log_likelihood for o in options}
    for given, log in got.items():
        np.testing.assert_allclose(log, every[given], atol=1e-5)
    assert all(given in got for given, log in every.items() if log > max(every.values()) + np.log(0.01))
    assert len(slam.association.options(slam.memory, seen, predicted, 1)) == 1


def test_a_frame_without_doubt_has_one_option():
    """Oracle: `associate` on the same frames: where the robot knows its place there is one, with the same pairs."""
    slam = LandmarkSlam(association=Pmb(management=Existence()))
    for event in circle_events(4, frames=20):
        if isinstance(event, Sightings):
            predicted = slam.predicted(event, slam.noises_of(event))
            options = slam.association.options(slam.memory, event, predicted, 10)
            alone = slam.association.associate(slam.memory, event, predicted)
            assert len(options) == 1
            np.testing.assert_array_equal(options[0].association.matched, alone.matched)
        slam.step(event)


@pytest.fixture(scope="module")
def learnt() -> LandmarkSlam:
    """The package's course with 4 false sightings a frame and P_D 0.95 near, 0.3 far, half a lap long."""
    world = world_by_name("faded-35")
    log = simulate(msgspec.structs.replace(world, clutter=4.0), 1)
    slam = LandmarkSlam(
        motion_from_config(log.defaults.motion),
        sensor_from_config(log.defaults.sensor),
        association=Pmb(management=Existence(), merging=Merging()),
        start=log.start,
    )
    outcome = run(slam, log)
    assert outcome.error is None
    return slam


def test_rates_are_learnt(learnt):
    """Oracle: the simulation's own: 4 false sightings a frame, P_D from 0.95 at the sensor straight to 0.3 at 30 m."""
    false, frames = learnt.memory["false"]
    assert abs(false / frames - 4.0) < 0.6
    for ring, (seen, looked) in enumerate(learnt.memory["detected"]):
        if looked > 150:
            assert abs(seen / looked - (0.95 - 0.65 * (ring + 0.5) / 6)) < 0.08, ring
    assert sum(looked > 150 for _, looked in learnt.memory["detected"]) >= 3


def test_a_memory_fits_its_map(learnt):
    """Oracle: by hand: every list has an entry for each landmark."""
    method, memory, count = learnt.association, learnt.memory, len(learnt._ids)
    assert method.fits(memory, count) and not method.fits(memory, count + 1)
    for key in ("odds", "score", "confirmed"):
        assert not method.fits(memory | {key: memory[key][:-1]}, count)
    assert len(method.existence(memory)) == count
    assert all(0.0 < r < 1.0 for r in method.existence(memory))


@pytest.mark.parametrize(
    "settings",
    [
        {"sure": 0.4},
        {"sure": 1.0},
        {"detection": 0.0},
        {"detection": 1.0},
        {"false_rate": 0.0},
        {"false_rate": np.inf},
        {"false_rate": np.nan},
        {"new_rate": 0.0},
        {"new_rate": np.nan},
        {"seeds": 0},
        {"gate": 1.5},
        {"extent": -1.0},
        {"patience": 0},
    ],
    ids=str,
)
def test_settings_without_a_meaning_are_refused(settings):
    """Oracle: ConfigError that names the setting."""
    with pytest.raises(ConfigError, match=next(iter(settings))):
        Pmb(**settings)


def test_frames_of_nothing_and_too_much():
    """Oracle: by hand: an empty frame on an empty map, and a hundred sightings at once: finite numbers, no error."""
    rng = np.random.default_rng(3)
    slam = LandmarkSlam(Increments(), SENSOR, association=Pmb(management=Existence()))
    slam.step(Odometry(0.0, np.zeros((1, 3)), np.ones(1)))
    for count in (0, 1, 100, 0, 100, 3):
        z = np.c_[rng.uniform(0.5, 30, count), rng.uniform(-1.5, 1.5, count)]
        feed(slam, [Sightings(1.0, z)])
        assert np.isfinite(slam.pose).all() and np.isfinite(slam.memory["odds"]).all()
        assert slam.association.fits(slam.memory, len(slam._ids))


def test_the_command_line_tells_why(tmp_path):
    """Oracle: a run by it leaves an audit trail whose reasons are its own, and a landmark's story."""
    line = ["run", "clutter-2", "--set", "world.observe_every=80", "--association", "pmb", "--out", tmp_path]
    answer = kalmap_inside(*line)
    assert (answer.code, answer.err) == (0, "") and (tmp_path / "association.sqlite").is_file()
    said = [kalmap_inside("why", tmp_path, *words) for words in (["--landmark", 0], [], ["--frame", 5])]
    assert [each.code for each in said] == [0, 0, 0], said
    assert said[0].out.startswith("landmark 0: ") and "hypothes" in said[2].out
    refused = kalmap_inside("run", "clutter-2", "--association", "pmb", "--set", "association.false_rate=0")
    assert refused.code == 2 and "false_rate" in refused.error
