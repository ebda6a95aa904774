"""Several explanations of a run at once: against a filter alone, a bookkeeping of their own, and simulated truth."""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest

from kalmap.association import Attribute, Existence, Keep, KnownIds, Pmb
from kalmap.geometry.angles import wrap
from kalmap.models import Increments, RangeBearing
from kalmap.models.motion import motion_from_config
from kalmap.models.sensor import sensor_from_config
from kalmap.records import ConfigError, EventError, Odometry, Scan, Sightings
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, run
from kalmap.slam.mixture import Hypothesis, MixtureSlam, _joined, _pruned, _sorted
from slam_problems import circle_events, feed, state_of

METHOD = Pmb(management=Existence(), false_rate=5.0)


def cluttered(seed: int, **overrides):
    """The package's course, one look a second: two laps of 210 s with five false sightings for one or two others."""
    world = msgspec.structs.replace(world_by_name("clutter-5"), observe_every=40, **overrides)
    return simulate(world, seed)


def alone(log, method: Pmb = METHOD) -> LandmarkSlam:
    defaults = log.defaults
    return LandmarkSlam(
        motion_from_config(defaults.motion),
        sensor_from_config(defaults.sensor),
        association=method,
        start=log.start,
        start_covariance=log.start_covariance,
    )


def events_of(log, many: int | None = None) -> list:
    return list(log.open(None))[:many]


@pytest.fixture(scope="module")
def closing() -> list:
    """The part of a drive in which a loop closes in clutter, from its beginning on."""
    log = cluttered(6)
    return [event for event in events_of(log) if event.time <= 215.0]


def whole_state(slam: MixtureSlam) -> tuple:
    """Everything that a refused event must leave alone."""
    return tuple(
        (state_of(each.slam), each.log_weight, [labels.tolist() for labels, _ in each.past])
        for each in slam._hypotheses
    )


def test_one_explanation_is_the_best_options_path(closing):
    """Oracle: a filter alone that is handed the likeliest option of every frame: the same state bit for bit."""
    slam = alone(cluttered(6))
    mixture, slam = MixtureSlam(slam.copy(), most=1), slam.copy()
    for event in closing[:4000]:
        mixture.step(event)
        if not isinstance(event, Sightings):
            slam.step(event)
            continue
        noises = slam.noises_of(event)
        best = slam.association.options(slam.memory, event, slam.predicted(event, noises), 1)
        assert len(best) == 1
        slam.take_decided(event, noises, best[0].association)
        slam.took(event.time)
        np.testing.assert_array_equal(mixture.frame_labels, slam.frame_labels)
    assert state_of(mixture._first.slam) == state_of(slam)
    assert mixture.weights.tolist() == [1.0] and mixture.landmark_count == slam.landmark_count > 5


def test_where_nothing_is_in_doubt_it_is_the_filter():
    """Oracle: the filter alone on an easy drive, bit for bit."""
    events = circle_events(4, frames=30)
    slam = feed(LandmarkSlam(association=METHOD), events)
    mixture = feed(MixtureSlam(LandmarkSlam(association=METHOD)), events)
    assert state_of(mixture._first.slam) == state_of(slam) and len(mixture.weights) == 1
    np.testing.assert_array_equal(mixture.pose_covariance, slam.pose_covariance)
    assert mixture.frame_revisions == {} and mixture.frames_taken == slam.frames_taken == 30
    assert (mixture.time, mixture.frame_used) == (slam.time, slam.frame_used)


@pytest.mark.parametrize("seed", [1, 7, 31])
def test_it_waits_with_a_closing_until_it_is_sure(seed):
    """Oracle: the simulation: wrong closings are the likeliest for a while; at the end the mixture is within a
    metre of the truth and has its 35 landmarks: the explanation that none was right founded new ones."""
    log = cluttered(seed)
    mixture = MixtureSlam(alone(log), 10)
    outcome = run(mixture, log, reckon=False)
    assert np.hypot(*(outcome.estimate.pose[:2] - log.references[0].positions[-1])) < 0.8
    assert len(outcome.estimate.landmarks) == 35


@pytest.mark.parametrize("seed", [6, 12])
def test_it_closes_a_loop_that_one_explanation_closes_wrongly(seed):
    """Oracle: the simulation: at the end the mixture is within half a metre of the truth and has its 35 landmarks; the
    filter alone, which decided at once, is metres away."""
    log = cluttered(seed)
    truth = log.references[0].positions[-1]
    ends = {}
    for slam in (alone(log), MixtureSlam(alone(log), 10)):
        outcome = run(slam, log, reckon=False)
        assert outcome.error is None and outcome.association_seconds > 0.0
        assert outcome.association_seconds < outcome.runtime
        ends[type(slam)] = np.hypot(*(outcome.estimate.pose[:2] - truth)), len(outcome.estimate.landmarks)
    assert ends[MixtureSlam][0] < 0.5 and ends[MixtureSlam][1] == 35
    assert ends[LandmarkSlam][0] > 2.0


def test_weights_explanations_and_covariance(closing):
    """Oracle: by definition, after every frame: weights sum to one, sorted, none below a thousandth of the best, no
    more than asked for, no two explanations alike; the covariance is at least the likeliest's own and at least the
    mixture's second moment about its pose, and symmetric."""
    mixture, most = MixtureSlam(alone(cluttered(6)), 4), 0
    for event in closing:
        mixture.step(event)
        weights = mixture.weights
        most = max(most, len(weights))
        if not isinstance(event, Sightings) or len(weights) == 1:
            continue
        assert abs(weights.sum() - 1.0) < 1e-12 and (np.diff(weights) <= 0.0).all()
        assert weights[-1] >= 1e-3 * weights[0]
        slams = [each.slam for each in mixture._hypotheses]
        for i, one in enumerate(slams):
            for two in slams[:i]:
                off = one.pose - two.pose
                off[2] = wrap(off[2])
                near = off @ np.linalg.solve(two.pose_covariance, off) < 0.3
                ratio = np.diag(one.pose_covariance) / np.diag(two.pose_covariance)
                wide = np.maximum(ratio, 1.0 / ratio).max() > 1.5
                assert not near or wide or one.landmark_count != two.landmark_count
        own, whole = slams[0].pose_covariance, mixture.pose_covariance
        moment = np.zeros((3, 3))
        for weight, slam in zip(weights, slams):
            off = slam.pose - mixture.pose
            off[2] = wrap(off[2])
            moment += weight * (slam.pose_covariance + np.outer(off, off))
        for least in (own, moment):
            assert np.linalg.eigvalsh(whole - least)[0] > -1e-9 * np.trace(whole)
        np.testing.assert_allclose(whole, whole.T, rtol=1e-12)
        np.testing.assert_array_equal(mixture.estimate().covariance, whole)
    assert most == 4


def test_labels_are_those_of_the_likeliest_explanations_own_history(closing, monkeypatch):
    """Oracle: every filter writes down its own labels and hands them on when it is copied; the run loop's labels,
    revised as it is told, are those of the likeliest one's, and so are the decisions of the audit trail."""
    plain_copy, plain_take = LandmarkSlam.copy, LandmarkSlam.take_decided

    def copy(slam):
        twin = plain_copy(slam)
        twin.history = list(getattr(slam, "history", []))
        return twin

    def take_decided(slam, *frame):
        plain_take(slam, *frame)
        slam.history = [*getattr(slam, "history", []), slam.frame_labels.tolist()]

    monkeypatch.setattr(LandmarkSlam, "copy", copy)
    monkeypatch.setattr(LandmarkSlam, "take_decided", take_decided)
    mixture, told, revised = MixtureSlam(alone(cluttered(6)), 10), [], 0
    for event in closing:
        mixture.step(event)
        if isinstance(event, Sightings):
            for number, (labels, _) in mixture.frame_revisions.items():
                told[number] = labels.tolist()
            told.append(mixture.frame_labels.tolist())
            revised += len(mixture.frame_revisions)
            assert told == mixture._first.slam.history
    assert revised >= 3 and len(told) == mixture.frames_taken
    log = msgspec.structs.replace(cluttered(6), open=lambda skip: iter(closing))
    outcome = run(MixtureSlam(alone(log), 10), log, reckon=False, explain=True)
    assert outcome.labels_at_once.tolist() == [label for labels in told for label in labels]
    assert [decision.labels.tolist() for decision in outcome.decisions] == told
    assert [decision.number for decision in outcome.decisions] == list(range(len(told)))


def test_revisions_begin_where_the_mixture_did(closing):
    """Oracle: a mixture from the beginning: one that takes over a running filter numbers its frames as that did."""
    first = [event for event in closing if event.time <= 200.0]
    slam = alone(cluttered(6))
    early = feed(MixtureSlam(slam.copy()), closing)
    assert len(feed(MixtureSlam(slam.copy()), first).weights) == 1
    late = feed(MixtureSlam(feed(MixtureSlam(slam.copy()), first)._first.slam), closing[len(first) :])
    assert whole_state(late)[0][0] == whole_state(early)[0][0]
    assert late.frames_taken == early.frames_taken
    assert {n: r[0].tolist() for n, r in late.frame_revisions.items()} == {
        n: r[0].tolist() for n, r in early.frame_revisions.items()
    }


def moved(slam: LandmarkSlam, x: float) -> LandmarkSlam:
    twin = slam.copy()
    twin._belief.mean[0] += x
    return twin


def test_explanations_that_say_the_same_are_one_and_the_order_is_kept():
    """Oracle: by hand: b and b' become one of 0.6, which is now the likeliest; what is light or too much is dropped."""
    slam = LandmarkSlam(Increments(), RangeBearing(), association=METHOD)
    slam.step(Odometry(0.0, np.zeros((1, 3)), np.ones(1), 0.01 * np.eye(3)[None]))
    b = moved(slam, 5.0)
    whole = [(slam, 0.4), (b, 0.35), (moved(b, 0.01), 0.25)]
    hypotheses = [Hypothesis(each, float(np.log(weight)), []) for each, weight in whole]
    kept = _sorted(_joined(_sorted(hypotheses)))
    assert [each.slam for each in kept] == [b, slam]
    np.testing.assert_allclose(np.exp([each.log_weight for each in kept]), [1.0, 0.4 / 0.6])
    assert _pruned(kept, 1) == kept[:1]
    kept[1].log_weight = -7.0
    assert _pruned(kept, 2) == kept[:1]


def test_a_twin_is_fresh_and_has_the_settings():
    """Oracle: by hand."""
    mixture = feed(MixtureSlam(LandmarkSlam(association=METHOD), 7), circle_events(4, frames=5))
    twin = mixture.twin()
    assert (twin.most, twin.frames_taken, twin.landmark_count) == (7, 0, 0)
    assert twin._first.slam.association == METHOD and twin.pose.tolist() == [0.0, 0.0, 0.0]
    assert twin.motion is mixture.motion and twin.sensor is mixture.sensor


def test_the_same_answer_twice(closing):
    """Oracle: the first answer, bit for bit."""
    first, second = (feed(MixtureSlam(alone(cluttered(6)), 5), closing) for _ in range(2))
    assert whole_state(first) == whole_state(second)


BAD = {
    "late odometry": Odometry(-5.0, np.array([[1.0, 0.0]]), np.array([0.1])),
    "late frame": Sightings(-5.0, np.array([[5.0, 0.1]])),
    "frame at no time": Sightings(np.nan, np.array([[5.0, 0.1]])),
    "odometry that is none": Odometry(1e3, np.array([[np.nan, 0.0]]), np.array([0.1])),
    "odometry of no duration": Odometry(1e3, np.array([[1.0, 0.0]]), np.array([np.nan])),
    "odometry in another shape": Odometry(1e3, np.array([[1.0, 0.0, 0.0]]), np.array([0.1])),
    "range that is none": Sightings(1e3, np.array([[5.0, 0.1], [np.nan, 0.0]])),
    "endless range": Sightings(1e3, np.array([[np.inf, 0.1]])),
    "range below zero": Sightings(1e3, np.array([[-1.0, 0.1]])),
    "bearing that is none": Sightings(1e3, np.array([[5.0, np.nan]])),
    "sightings in another shape": Sightings(1e3, np.zeros((2, 3))),
    "identities that do not fit": Sightings(1e3, np.array([[5.0, 0.1]]), np.array([1, 2])),
    "covariances that do not fit": Sightings(1e3, np.array([[5.0, 0.1]]), covariance=np.eye(2)),
    "scan without a detector": Scan(1e3, np.ones(3), np.zeros(3)),
}


@pytest.fixture(scope="module")
def on_the_way(closing) -> tuple[MixtureSlam, list, tuple]:
    """A mixture with several explanations, the events that come next, and the state of another one after them."""
    before = [event for event in closing if event.time <= 208.0]
    mixture, other = (feed(MixtureSlam(alone(cluttered(6)), 5), before) for _ in range(2))
    assert len(mixture.weights) > 1
    after = closing[len(before) : len(before) + 200]
    return mixture, after, whole_state(feed(other, after))


@pytest.mark.parametrize("name", BAD)
def test_bad_events_are_refused_and_change_nothing(name, on_the_way):
    """Oracle: EventError; all explanations as they were, bit for bit, and the next events are taken as if it had not
    been there."""
    mixture, after, expected = copy.deepcopy(on_the_way[0]), *on_the_way[1:]
    state = whole_state(mixture)
    with pytest.raises(EventError):
        mixture.step(BAD[name])
    assert whole_state(mixture) == state
    assert whole_state(feed(mixture, after)) == expected


def test_a_frame_without_the_attribute_is_refused():
    """Oracle: EventError, and nothing changed; a frame before any odometry likewise."""
    method = Pmb(management=Keep(), attributes=(Attribute(name="diameter", sigma=0.1),))
    mixture = MixtureSlam(LandmarkSlam(association=method))
    seen = Sightings(0.0, np.array([[5.0, 0.1]]), attributes={"diameter": np.array([0.3])})
    with pytest.raises(EventError, match="before any odometry"):
        mixture.step(seen)
    mixture.step(Odometry(0.0, np.zeros((1, 2)), np.ones(1)))
    mixture.step(seen)
    state = whole_state(mixture)
    with pytest.raises(EventError, match="diameter"):
        mixture.step(Sightings(1.0, np.array([[5.0, 0.1]])))
    assert whole_state(mixture) == state and mixture.attribute_names == ("diameter",)


def test_other_associations_and_no_explanations_are_refused():
    """Oracle: ConfigError."""
    with pytest.raises(ConfigError, match="pmb"):
        MixtureSlam(LandmarkSlam(association=KnownIds()))
    with pytest.raises(ConfigError, match="at least 1"):
        MixtureSlam(LandmarkSlam(association=METHOD), 0)
