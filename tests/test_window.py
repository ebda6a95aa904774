"""A filter that decides over several frames and goes back: against filters that were told from the start."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from kalmap.association import (
    Counter,
    Djnn,
    Existence,
    Keep,
    KnownIds,
    Mda,
    Merging,
    Region,
    Trial,
)
from kalmap.association.mda import UNUSED
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import SPURIOUS, ConfigError, EstimationError, EventError, Odometry, Sightings
from kalmap.slam import LandmarkSlam, run
from slam_problems import STEERING_BIASES, XYSensor, circle_events, feed, log_of, state_of
from window_problems import (
    DIAMETER,
    Watch,
    assert_same_state,
    rough_drive,
    standing,
    still,
)

SETTINGS = {
    "two": {"association": Mda(management=Keep())},
    "two, on trial": {"association": Mda(management=Trial(confirm=3, window=6)), "coordinates": "additive"},
    "three": {"association": Mda(window=3, management=Counter(admit=3), merging=Merging(gate=0.999))},
    "four": {"association": Mda(window=4, management=Existence()), "use": "sequential"},
    "four, narrow": {
        "association": Mda(window=4, management=Trial(4), gate=0.7, new_gate=0.7, merging=Merging(frames=2))
    },
    "five, attributes": {
        "association": Mda(window=5, attributes=(DIAMETER,), extent=0.1, region=Region(local=False)),
        "motion": VelocitySteering(biases=STEERING_BIASES[:2]),
    },
    "ambiguity": {"association": Mda(window=3, ambiguity=4.6, extent=0.5, management=Trial(3))},
}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", SETTINGS)
def test_going_back_leaves_no_trace(name, seed, monkeypatch):
    """Oracle: a filter that never goes back and is told what was decided in the end of every frame when it comes:
    belief, numbers, counters of the management, all bit for bit, at several times on the way and at the end."""
    watch, slam = Watch(monkeypatch), LandmarkSlam(**SETTINGS[name])
    events, revised = rough_drive(seed), 0
    for number, event in enumerate(events):
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        revised += len(slam.frame_revisions)
        if slam.frames_taken % 8 == 0:
            assert_same_state(slam, watch.told(events[: number + 1], **SETTINGS[name]))
    assert_same_state(slam, watch.told(events, **SETTINGS[name]))
    assert revised >= 8 and slam.frames_taken == sum(isinstance(e, Sightings) for e in events)


@pytest.mark.parametrize("window", [2, 3, 4])
@pytest.mark.parametrize("management", [Keep(), Trial(confirm=4), Trial(confirm=2)])
def test_what_was_taken_is_what_the_assignment_said(management, window, monkeypatch):
    """Oracle: the assignment's own answer, after every frame: in the frames of the window, but for the newest, a
    sighting of a landmark has its number, one of a track has that of the track's first, any other has none."""
    answers, labels, kinds = [], [], set()
    plain = Mda.explain_window
    monkeypatch.setattr(Mda, "explain_window", lambda *given: answers.append(plain(*given)) or answers[-1])
    slam = LandmarkSlam(association=Mda(window=window, management=management, region=Region(local=False)))
    for event in rough_drive(7):
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        for number, (again, _) in slam.frame_revisions.items():
            labels[number] = again
        labels.append(slam.frame_labels)
        keys = answers[-1][0]
        assert len(keys) == min(window, len(labels))
        waiting = labels[-len(keys) :]
        for f, row in enumerate(keys):
            newest = f == len(keys) - 1
            for (first, which), label in zip(row, waiting[f].tolist(), strict=True):
                kinds.add((first, newest))
                if first == -2:
                    assert label == SPURIOUS or newest
                else:
                    assert label == (which if first == -1 else waiting[first][which]) >= 0
    assert len(kinds) >= 2 * window


def test_when_a_frame_has_to_be_taken_again():
    """Oracle: by hand: what stood before the frame, what it founded (from 5 on), nothing, and the rest."""
    window = feed(LandmarkSlam(**still()), standing([[10.0]]))._window
    entry = window.pending[0]
    entry.glance = msgspec.structs.replace(entry.glance, founded=5)
    window._numbers = {(0, 2): 4}
    for then, same in ((3, [(-1, 3)]), (4, [(-1, 4), (0, 2)]), (5, [(1, 0), (-1, 5)]), (SPURIOUS, [UNUSED])):
        entry.applied = [then]
        window.pending = [entry, entry]
        for key in ((-1, 3), (-1, 4), (-1, 5), (0, 2), (0, 3), (1, 0), UNUSED):
            assert window._differs(1, [key]) == (key not in same), (then, key)


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_tracks_know_nothing_of_the_place(coordinates):
    """Oracle: closed form: two sightings from one place differ by the noise of both, however unsure the place is."""
    events = standing([[10.0, 12.0], [10.3, 11.9]])
    unsure = np.diag([4.0, 4.0, 0.25])
    slam = LandmarkSlam(**still(window=3), start_covariance=unsure, coordinates=coordinates)
    feed(slam, events)
    squared, log_volume = slam._window.pending[1].glance.links[0]
    apart = np.array([[0.3, 1.9], [-1.7, -0.1]])
    np.testing.assert_allclose(squared, apart**2 / 0.02, rtol=0.02)
    np.testing.assert_allclose(log_volume, np.log(0.02 * 2 * np.radians(1.0) ** 2), atol=0.02)


@pytest.mark.parametrize("scope", ["reduced", "full"])
def test_going_back_in_the_general_engine(scope, monkeypatch):
    """Oracle: as above, with models in numpy."""

    class Own(VelocitySteering, frozen=True):
        compiled = False

    settings = {"motion": Own(), "association": Mda(window=3, management=Trial(3)), "scope": scope}
    watch, events = Watch(monkeypatch), rough_drive(3, frames=9)
    slam = feed(LandmarkSlam(**settings), events)
    assert_same_state(slam, watch.told(events, **settings))
    assert watch.times > slam.frames_taken + 3


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
@pytest.mark.parametrize("window", [2, 3, 4])
@pytest.mark.parametrize("management", [Keep(), Trial(confirm=2)])
def test_where_nothing_is_ambiguous_it_is_the_filter_with_known_ids(management, window, coordinates):
    """Oracle: the filter that goes by identities, with the sightings that were left unused marked so: the same mean
    and covariance; and the log's own identities: a label always means the same one."""
    events = circle_events(8, frames=50)
    slam = LandmarkSlam(association=Mda(window=window, management=management), coordinates=coordinates)
    outcome = run(slam, log_of(events))
    ids = np.where(outcome.labels >= 0, outcome.truth_ids, -1)
    pairs = set(zip(ids[ids >= 0].tolist(), outcome.labels[ids >= 0].tolist(), strict=True))
    assert (ids >= 0).mean() > 0.95 and len(pairs) == len(outcome.estimate.landmarks) >= 10
    at = np.cumsum([0] + [len(e.ids) for e in events[1::2]])
    marked = [
        Sightings(e.time, e.values, ids[at[k // 2] : at[k // 2 + 1]]) if k % 2 else e
        for k, e in enumerate(events)
    ]
    known = feed(LandmarkSlam(association=KnownIds(), coordinates=coordinates), marked).estimate()
    identity = {label: truth for truth, label in pairs}
    order = [known.landmarks.ids.tolist().index(identity[n]) for n in outcome.estimate.landmarks.ids.tolist()]
    entries = np.concatenate([np.arange(3), *[(3 + 2 * k, 4 + 2 * k) for k in order]])
    mean, covariance = known.joint()
    np.testing.assert_allclose(outcome.estimate.joint()[0], mean[entries], atol=1e-9)
    np.testing.assert_allclose(outcome.estimate.joint()[1], covariance[np.ix_(entries, entries)], atol=1e-9)


# --- frames of all kinds --------------------------------------------------------------------------


@pytest.mark.parametrize("window", [2, 3, 4])
def test_first_frames_empty_frames_and_frames_at_one_time(window):
    """Oracle: by hand: nothing, the first, the same again at once, nothing, and again, with no odometry between."""
    slam = LandmarkSlam(**still(window=window, management=Keep()))
    slam.step(Odometry(1.0, np.array([[0.0, 0.0]]), np.array([0.1])))
    for ranges, expected in (([], []), ([10.0], [0]), ([10.0], [0]), ([], []), ([10.0, 15.0], [0, 1])):
        slam.step(Sightings(1.0, np.c_[ranges, np.zeros(len(ranges))].reshape(-1, 2)))
        assert slam.frame_labels.tolist() == expected and slam.time == 1.0
    slam.step(Sightings(1.0, np.array([[15.0, 0.0]])))
    assert slam.frame_labels.tolist() == [1] and slam._counts == [3, 2] and slam.frames_taken == 6


@pytest.mark.parametrize("window", [2, 3])
def test_sixty_sightings_a_frame(window):
    """Oracle: the identities: sixty things half a metre and more apart, seen six times in random order."""
    rng, events = np.random.default_rng(5), []
    z = np.c_[np.tile([8.0, 14.0, 20.0], 20), np.linspace(-1.4, 1.4, 60)]
    for k in range(6):
        events.append(Odometry(float(k), np.array([[0.0, 0.0]]), np.array([0.1])))
        order = rng.permutation(60)
        events.append(Sightings(float(k), z[order] + rng.normal(0, [0.05, 0.005], (60, 2)), order))
    outcome = run(LandmarkSlam(**still(window=window)), log_of(events))
    assert (outcome.labels >= 0).all()
    assert len(set(zip(outcome.truth_ids.tolist(), outcome.labels.tolist(), strict=True))) == 60


ONE = [[10.0, 0.3]]
MANY = np.c_[np.random.default_rng(0).uniform(1, 29, 200), np.random.default_rng(1).uniform(-1.5, 1.5, 200)]
STRANGE = {
    "two hundred": [MANY, MANY + 0.01, MANY],
    "all in one place": [ONE * 30, ONE * 30, ONE * 31],
    "one and nothing": [ONE, [], ONE, [], []],
    "around the seam": [[[10.0, 3.14159], [10.0, -3.14159]], [[10.0, -3.14159], [10.0, 3.14159]]],
    "behind and beyond": [[[10.0, 3.1], [500.0, 0.0]], [[10.0, 3.1], [500.0, 0.0]]],
}


@pytest.mark.parametrize("gates", [(0.999, 0.999999), (0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0)])
@pytest.mark.parametrize("story", STRANGE)
def test_strange_frames_and_gates(story, gates):
    """Oracle: a finite, positive definite state, lists that fit each other, and no landmark given twice."""
    method = Mda(window=3, gate=gates[0], new_gate=gates[1], management=Trial(2, 3), merging=Merging())
    slam = LandmarkSlam(association=method, start_covariance=0.01 * np.eye(3))
    for k, z in enumerate(STRANGE[story]):
        slam.step(Odometry(float(k), np.array([[0.0, 0.02]]), np.array([0.5])))
        slam.step(Sightings(float(k), np.array(z, dtype=float).reshape(-1, 2)))
        covariance = slam._belief.covariance()
        scale = np.sqrt(np.diag(covariance))
        np.linalg.cholesky(covariance / np.outer(scale, scale))
        assert method.fits(slam._memory, len(slam._ids)) and slam._memory["serial"] == slam._ids
        given = [label for label in slam.frame_labels.tolist() if label >= 0]
        assert len(given) == len(set(given)) and len(slam.frame_labels) == len(z)


def test_a_refused_frame_leaves_nothing_behind():
    """Oracle: a filter that never got it, then and in the end."""
    method = Mda(window=3, attributes=(DIAMETER,))
    slam, twin, events = LandmarkSlam(association=method), LandmarkSlam(association=method), rough_drive(4)
    for event in events:
        if isinstance(event, Sightings) and len(event.values):
            before = state_of(slam)
            for bad in (
                Sightings(event.time, event.values),
                Sightings(event.time, event.values * [-1.0, 1.0], attributes=event.attributes),
            ):
                with pytest.raises(EventError):
                    slam.step(bad)
            with pytest.raises(EventError):
                slam.step(Odometry(event.time, np.array([[np.nan, 0.0]]), np.array([0.1])))
            assert state_of(slam) == before
        feed(slam, [event])
        feed(twin, [event])
        assert state_of(slam) == state_of(twin)


def test_sightings_without_noise_cannot_be_compared():
    """Oracle: by hand: two exact sightings from one place have no distance in standard deviations: an error with the
    step's number, and the filter as it was."""
    slam, exact = LandmarkSlam(**still()), np.zeros((1, 2, 2))
    slam.step(Odometry(0.0, np.array([[0.0, 0.0]]), np.array([0.1])))
    slam.step(Sightings(0.0, np.array(ONE), covariance=exact))
    before = state_of(slam)
    with pytest.raises(EstimationError, match=r"step 1.*innovation covariance"):
        slam.step(Sightings(0.0, np.array(ONE), covariance=exact))
    assert state_of(slam) == before


@pytest.mark.parametrize("sensor", [RangeBearing(max_range=np.inf), XYSensor(np.eye(2))])
def test_a_sensor_without_end_is_refused(sensor):
    """Oracle: ConfigError: false sightings cannot be spread over it."""
    with pytest.raises(ConfigError, match="max_range"):
        LandmarkSlam(sensor=sensor, association=Mda())


# --- snapshots ------------------------------------------------------------------------------------


@pytest.mark.parametrize("scope", ["reduced", "full"])
def test_a_snapshot_brings_the_filter_back_as_often_as_wanted(scope):
    """Oracle: the filter's own state at the snapshot, and the state it had reached after the same events: bit for
    bit, with motion pending, landmarks on trial, mergers and what the associator remembers."""
    events = rough_drive(11, frames=40)[: None if scope == "reduced" else 24]
    cut = next(k for k in range(len(events) // 2, len(events)) if isinstance(events[k - 1], Odometry))
    method = Djnn(merging=Merging(frames=2, gate=0.999), gate=0.6, new_gate=0.6)
    slam = feed(LandmarkSlam(association=method, scope=scope), events[:cut])
    assert slam._belief.pending and slam._on_trial
    record, before = slam.snapshot(), state_of(slam)
    feed(slam, events[cut:])
    after = state_of(slam)
    assert after[2:] != before[2:] and (scope == "full" or len(slam.merged) > len(record.merged))
    for _ in range(2):
        slam.restore(record)
        assert state_of(slam)[2:] == before[2:]
        slam._time = -np.inf
        feed(slam, events[cut:])
        assert state_of(slam)[2:] == after[2:]
