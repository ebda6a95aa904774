"""Known identities and maximum likelihood, against brute force and the definitions of the gates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from kalmap.association import KnownIds, Likelihood
from kalmap.association.likelihood import chi_square_2
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import NEW, SPURIOUS, EventError, Odometry, Sightings
from kalmap.slam import LandmarkSlam
from slam_problems import circle_events, copy_belief, feed, state_of


class Fake:
    """A predicted map with given distances."""

    def __init__(self, squared, log_volume=None, view=None, count=None) -> None:
        self.squared = np.asarray(squared, dtype=float)
        self.log_volume = np.zeros_like(self.squared) if log_volume is None else log_volume
        self.count = self.squared.shape[1] if count is None else count
        self.positions = np.zeros((self.count, 2))
        self.view = view

    def innovations(self, candidates):
        return self.squared[:, candidates], self.log_volume[:, candidates]

    def in_view(self, margin):
        return np.ones(self.count, dtype=bool) if self.view is None else np.asarray(self.view)


def frame(count: int, ids=None, time: float = 1.0) -> Sightings:
    z = np.c_[np.full(count, 5.0), np.zeros(count)]
    return Sightings(time, z, None if ids is None else np.array(ids, dtype=np.int64))


def moved(**settings) -> LandmarkSlam:
    """A filter that has seen one odometry sample of a vehicle standing still."""
    slam = LandmarkSlam(VelocitySteering(), RangeBearing(), **settings)
    slam.step(Odometry(0.0, np.array([[0.0, 0.0]]), np.array([0.1])))
    return slam


# --- known identities -----------------------------------------------------------------------------


def test_known_ids_found_match_and_leave_unused():
    """Oracle: by hand: new ids get NEW, -1 stays unused, the second of a founding frame names the coming
    index."""
    known = KnownIds()
    memory = known.start()
    first, memory = known.associate(memory, frame(4, [7, -1, 3, 7]), Fake(np.zeros((4, 0))))
    np.testing.assert_array_equal(first.matched, [NEW, SPURIOUS, NEW, 0])
    second, memory = known.associate(memory, frame(3, [3, 9, 7]), Fake(np.zeros((3, 2))))
    np.testing.assert_array_equal(second.matched, [1, NEW, 0])
    assert memory == {7: 0, 3: 1, 9: 2}


def test_same_id_twice_in_the_founding_frame_is_used_twice():
    """Oracle: founding with one sighting and seeing it again at the same time."""
    values = np.array([[5.0, 0.1], [5.1, 0.12]])
    one, two = moved(), moved()
    one.step(Sightings(1.0, values, np.array([4, 4])))
    two.step(Sightings(1.0, values[:1], np.array([4])))
    two.step(Sightings(1.0, values[1:], np.array([4])))
    np.testing.assert_array_equal(one.estimate().joint()[0], two.estimate().joint()[0])
    np.testing.assert_array_equal(one.estimate().joint()[1], two.estimate().joint()[1])
    assert one.estimate().landmarks.sightings.tolist() == [2]


@pytest.mark.parametrize("ids", [None, [-2, 1], [5, -7], [1, 6, -3]])
def test_refused_ids_leave_nothing_behind(ids):
    """Oracle: a filter that never got the bad frame: same state, memory included, and the same future."""
    slam, twin = moved(), moved()
    for each in (slam, twin):
        each.step(frame(1, [1]))
    before = state_of(slam)
    bad = frame(len(ids), ids, 2.0) if ids else frame(2, None, 2.0)
    with pytest.raises(EventError) as caught:
        slam.step(bad)
    assert caught.value.field == "ids" and caught.value.time == 2.0
    assert state_of(slam) == before
    for each in (slam, twin):
        each.step(frame(3, [5, 6, 1], 3.0))
    assert state_of(slam) == state_of(twin)


@pytest.mark.parametrize("ids", [[1], [1, 2, 3]])
def test_ids_of_another_length_are_refused(ids):
    """Oracle: EventError naming the field; two sightings cannot have one or three identities."""
    slam = moved()
    before = state_of(slam)
    with pytest.raises(EventError) as caught:
        slam.step(frame(2, ids))
    assert caught.value.field == "ids"
    assert state_of(slam) == before


# --- likelihood -----------------------------------------------------------------------------------


def brute_force(squared: np.ndarray, cost: np.ndarray, gate: float) -> tuple[int, float]:
    """(pairs, least cost) of the best one-to-one assignment inside the gate, over all of them."""
    best = (0, 0.0)
    rows, columns = squared.shape
    for choice in itertools.product(range(-1, columns), repeat=rows):
        used = [c for c in choice if c >= 0]
        if len(used) != len(set(used)) or any(c >= 0 and squared[r, c] >= gate for r, c in enumerate(choice)):
            continue
        total = sum(cost[r, c] for r, c in enumerate(choice) if c >= 0)
        best = min(best, (-len(used), total))
    return -best[0], best[1]


@pytest.mark.parametrize("seed", range(60))
def test_one_to_one_against_brute_force(seed):
    """Oracle: every assignment tried: most pairs first, then least nu' S^-1 nu + ln det S."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 5), rng.integers(1, 5)
    squared = rng.exponential(10.0, (rows, columns))
    log_volume = rng.normal(-5, 4, (rows, columns))
    method = Likelihood(gate=0.99, new_gate=0.9999)
    matched = method.associate([None] * columns, frame(rows), Fake(squared, log_volume))[0].matched
    pairs, cost = brute_force(squared, squared + log_volume, chi_square_2(0.99))
    used = [(r, c) for r, c in enumerate(matched.tolist()) if c >= 0]
    assert len({c for _, c in used}) == len(used) == pairs
    assert all(squared[r, c] < chi_square_2(0.99) for r, c in used)
    np.testing.assert_allclose(sum((squared + log_volume)[r, c] for r, c in used), cost, atol=1e-9)
    for r, c in enumerate(matched.tolist()):
        if c < 0:
            assert (c == NEW) == (squared[r].min() >= chi_square_2(0.9999))


def test_gates_by_hand():
    """Oracle: chi-square with two degrees: inside the gate a match, in between unused,
    beyond a new landmark."""
    gate, new_gate = chi_square_2(0.999), chi_square_2(0.999999)
    np.testing.assert_allclose([gate, new_gate], [13.8155, 27.6310], atol=1e-4)
    squared = np.array([[gate - 0.01, 1e3], [gate + 0.01, 1e3], [new_gate + 0.01, 1e3]])
    matched = Likelihood().associate([None, None], frame(3), Fake(squared))[0].matched
    np.testing.assert_array_equal(matched, [0, SPURIOUS, NEW])


def test_loser_of_a_contest_is_left_unused():
    """Oracle: two sightings of one landmark: the nearer one has it,
    the other is too near to found another."""
    matched = Likelihood().associate([None], frame(2), Fake([[3.0], [1.0]]))[0].matched
    np.testing.assert_array_equal(matched, [SPURIOUS, 0])


def test_empty_map_and_empty_frame():
    """Oracle: by hand."""
    association, memory = Likelihood().associate([], frame(2), Fake(np.zeros((2, 0))))
    np.testing.assert_array_equal(association.matched, [NEW, NEW])
    association, memory = Likelihood().associate(memory, frame(0), Fake(np.zeros((0, 2))))
    assert len(association.matched) == 0 and memory == [None, None]


def test_confirmation_and_retirement_by_hand():
    """Oracle: counters worked out by hand: two sightings within three frames in view, or out."""
    method = Likelihood(confirm=2, confirm_window=3)
    far = 1e3
    association, memory = method.associate([], frame(3), Fake(np.zeros((3, 0))))
    assert memory == [[1, 1], [1, 1], [1, 1]]
    association, memory = method.associate(memory, frame(1), Fake([[0.1, far, far]], view=[1, 1, 0]))
    assert association.confirmed == (0,) and association.retired == ()
    assert memory == [None, [1, 2], [1, 1]]
    association, memory = method.associate(memory, frame(1), Fake([[far, far, far]], view=[1, 1, 0]))
    assert association.retired == (1,) and memory == [
        None,
        [1, 1],
        [1, 1],
    ]  # the last one is the new landmark
    assert association.matched.tolist() == [NEW]


def clutter_story(seed: int) -> list:
    """The circle drive with a false sighting in every second frame, somewhere within view."""
    rng, events = np.random.default_rng(seed), []
    for number, event in enumerate(circle_events(seed, frames=60)):
        if isinstance(event, Sightings) and number % 4 == 1:
            false = np.array([[rng.uniform(3, 25), rng.uniform(-1.2, 1.2)]])
            event = Sightings(event.time, np.vstack([false, event.values]), np.append(-1, event.ids))
        events.append(event)
    return events


def test_clutter_is_retired_and_bookkeeping_stays_aligned():
    """Oracle: the simulated identities: one landmark per true one at the end,
    each label always the same truth."""
    method = Likelihood(confirm=3, confirm_window=6)
    slam = LandmarkSlam(VelocitySteering(), RangeBearing(), association=method)
    retired, seen = 0, {}
    for event in clutter_story(5):
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        retired += len(slam.frame_association.retired)
        assert len(slam._memory) == len(slam._ids) == len(slam._counts) == (slam._belief.n - 3) // 2
        assert sum(state is None for state in slam._memory) == slam.landmark_count
        for truth, label in zip(event.ids.tolist(), slam.frame_labels.tolist(), strict=True):
            if truth >= 0 and label >= 0:
                seen.setdefault(label, []).append(truth)
    landmarks = slam.estimate().landmarks
    assert retired >= 15
    assert len(set(landmarks.ids.tolist())) == len(landmarks)
    numbers = landmarks.ids.tolist()
    assert sorted(max(set(seen[n]), key=seen[n].count) for n in numbers) == list(range(12))
    assert all(len(set(seen[n])) == 1 for n in numbers)


def test_landmarks_on_trial_are_left_out_of_the_estimate():
    """Oracle: the filter's own joint Gaussian, with the rows of unconfirmed landmarks deleted by numpy."""
    slam = LandmarkSlam(association=Likelihood(confirm=4, confirm_window=40))
    feed(slam, clutter_story(5)[:24])
    on_trial = [i for i, state in enumerate(slam._memory) if state is not None]
    assert 0 < len(on_trial) < len(slam._ids)
    gone = np.concatenate([[3 + 2 * i, 4 + 2 * i] for i in on_trial])
    mean, covariance = slam.estimate().joint()
    np.testing.assert_array_equal(mean, np.delete(slam._belief.mean[: slam._belief.n], gone))
    full = slam._belief.covariance()
    np.testing.assert_array_equal(covariance, np.delete(np.delete(full, gone, 0), gone, 1))
    landmarks = slam.estimate().landmarks
    assert landmarks.ids.tolist() == np.delete(slam._ids, on_trial).tolist()
    np.testing.assert_array_equal(landmarks.positions.ravel(), mean[3:])
    assert len(landmarks) == slam.landmark_count == len(slam._ids) - len(on_trial)


def test_removal_marginalises_exactly():
    """Oracle: the joint Gaussian before the removing frame, updated by a twin that only lacks the removal."""
    method = Likelihood(confirm=2, confirm_window=2)
    slam = LandmarkSlam(VelocitySteering(), RangeBearing(max_range=100.0), association=method)
    slam.step(Odometry(0.0, np.array([[1.0, 0.1]]), np.array([0.1])))
    slam.step(Sightings(0.0, np.array([[10.0, 0.5], [12.0, -0.5], [20.0, 0.0]])))
    slam.step(Odometry(1.0, np.array([[1.0, 0.1]]), np.array([0.1])))
    slam._belief.flush()
    twin = copy_belief(slam._belief)
    z = np.array([[9.9, 0.5], [19.9, 0.0]])
    slam.step(Sightings(1.0, z))
    assert slam.frame_association.retired == (1,)
    slam._engine.update(twin, z, np.array([3, 7]), RangeBearing().covariance(z))
    mean, covariance = slam.estimate().joint()
    kept = np.array([0, 1, 2, 3, 4, 7, 8])
    np.testing.assert_array_equal(mean, twin.mean[kept])
    np.testing.assert_array_equal(covariance, twin.covariance()[np.ix_(kept, kept)])
    assert slam.estimate().landmarks.ids.tolist() == [0, 2]


def test_likelihood_finds_the_truth_of_an_easy_drive():
    """Oracle: the filter that is given the identities, on the same drive without clutter."""
    events = circle_events(8, frames=50)
    blind = feed(LandmarkSlam(association=Likelihood()), events).estimate()
    told = feed(LandmarkSlam(association=KnownIds()), events).estimate()
    assert len(blind.landmarks) == len(told.landmarks)
    np.testing.assert_allclose(blind.pose, told.pose, atol=0.05)
