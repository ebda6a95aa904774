"""Known identities and association by place, against brute force and the definitions of the gates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fake_map import Fake, decide, frame, memory_of
from kalmap.association import Djnn, Jcbb, KnownIds, Likelihood, Nearest, Trial
from kalmap.geometry.ellipses import chi_square_2
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import NEW, SPURIOUS, EventError, Odometry, Reason, Sightings
from kalmap.slam import LandmarkSlam
from slam_problems import state_of


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
    first = decide(known, memory, frame(4, [7, -1, 3, 7]), Fake(np.zeros((4, 0))))
    np.testing.assert_array_equal(first.matched, [NEW, SPURIOUS, NEW, 0])
    second = decide(known, memory, frame(3, [3, 9, 7]), Fake(np.zeros((3, 2))))
    np.testing.assert_array_equal(second.matched, [1, NEW, 0])
    assert memory == {7: 0, 3: 1, 9: 2}
    assert known.fits(memory, 3) and not known.fits(memory, 2) and not known.fits({7: 0, 3: 2}, 2)


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


# --- the rules ------------------------------------------------------------------------------------


def brute_force(squared: np.ndarray, cost: np.ndarray, gate: float) -> tuple[int, float]:
    """(pairs, least cost) of the best one-to-one assignment inside the gate, over all of them."""
    best = (0, 0.0)
    rows, columns = squared.shape
    for choice in itertools.product(range(-1, columns), repeat=rows):
        used = [c for c in choice if c >= 0]
        if len(used) != len(set(used)) or any(c >= 0 and squared[r, c] > gate for r, c in enumerate(choice)):
            continue
        total = sum(cost[r, c] for r, c in enumerate(choice) if c >= 0)
        best = min(best, (-len(used), total))
    return -best[0], best[1]


def random_table(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 5), rng.integers(1, 5)
    return rng.exponential(10.0, (rows, columns)), rng.normal(-5, 4, (rows, columns))


@pytest.mark.parametrize(
    "method", [Likelihood(gate=0.99, new_gate=0.9999), Nearest(gate=0.99, new_gate=0.9999, one_to_one=True)]
)
@pytest.mark.parametrize("seed", range(60))
def test_one_to_one_against_brute_force(method, seed):
    """Oracle: every assignment tried: most pairs first, then least nu' S^-1 nu + ln det S."""
    squared, log_volume = random_table(seed)
    rows, columns = squared.shape
    matched = decide(method, memory_of(method, columns), frame(rows), Fake(squared, log_volume)).matched
    pairs, cost = brute_force(squared, squared + log_volume, chi_square_2(0.99))
    used = [(r, c) for r, c in enumerate(matched.tolist()) if c >= 0]
    assert len({c for _, c in used}) == len(used) == pairs
    assert all(squared[r, c] <= chi_square_2(0.99) for r, c in used)
    np.testing.assert_allclose(sum((squared + log_volume)[r, c] for r, c in used), cost, atol=1e-9)
    for r, c in enumerate(matched.tolist()):
        if c < 0:
            assert (c == NEW) == (squared[r].min() >= chi_square_2(0.9999))


@pytest.mark.parametrize("seed", range(60))
def test_nearest_takes_each_sighting_for_itself(seed):
    """Oracle: equations (4) and (5) of Zhou, Zhao & Zhang 2010 for each sighting alone."""
    method, (squared, log_volume) = Nearest(gate=0.95, new_gate=0.999), random_table(seed)
    rows, columns = squared.shape
    matched = decide(method, memory_of(method, columns), frame(rows), Fake(squared, log_volume)).matched
    for r in range(rows):
        inside = [c for c in range(columns) if squared[r, c] <= chi_square_2(0.95)]
        if inside:
            assert matched[r] == min(inside, key=lambda c: (squared + log_volume)[r, c])
        else:
            assert matched[r] == (NEW if squared[r].min() >= chi_square_2(0.999) else SPURIOUS)


def test_gates_by_hand():
    """Oracle: chi-square with two degrees: inside the gate a match, in between unused,
    beyond a new landmark."""
    gate, new_gate = chi_square_2(0.999), chi_square_2(0.999999)
    np.testing.assert_allclose([gate, new_gate], [13.8155, 27.6310], atol=1e-4)
    squared = np.array([[gate - 0.01, 1e3], [gate + 0.01, 1e3], [new_gate + 0.01, 1e3]])
    for method in (Likelihood(), Nearest(), Nearest(one_to_one=True), Jcbb()):
        matched = decide(method, memory_of(method, 2), frame(3), Fake(squared)).matched
        np.testing.assert_array_equal(matched, [0, SPURIOUS, NEW])


def test_loser_of_a_contest_is_left_unused():
    """Oracle: two sightings of one landmark: the nearer one has it, the other is too near to found another; plain
    nearest neighbour gives it to both, as the paper's does."""
    for method, expected in ((Likelihood(), [SPURIOUS, 0]), (Nearest(), [0, 0])):
        matched = decide(method, memory_of(method, 1), frame(2), Fake([[3.0], [1.0]])).matched
        np.testing.assert_array_equal(matched, expected)


def test_landmarks_on_trial_take_what_confirmed_ones_leave():
    """Oracle: by hand: 0 is confirmed, 1 is on trial and nearer: 0 gets it all the same. What is far from 0 goes to 1,
    one to one."""
    for method in (
        Likelihood(management=Trial(2)),
        Nearest(management=Trial(2)),
        Djnn(),
        Jcbb(management=Trial(2)),
    ):
        memory = memory_of(method, 2)
        decide(method, memory, frame(1), Fake([[1.0, 90.0]], view=[1, 0]))
        assert memory["confirmed"] == [True, False]
        matched = method.associate(memory, frame(1), Fake([[5.0, 1.0]], view=[1, 0])).matched
        assert matched.tolist() == [0]
        squared = [[90.0, 2.0], [90.0, 1.0], [90.0, 20.0], [90.0, 90.0]]
        matched = method.associate(memory, frame(4), Fake(squared, view=[1, 0])).matched
        assert matched.tolist() == [SPURIOUS, 1, SPURIOUS, NEW]


@pytest.mark.parametrize("method", [Likelihood(), Nearest(), Nearest(one_to_one=True), Djnn(), Jcbb()])
def test_empty_map_and_empty_frame(method):
    """Oracle: by hand."""
    memory = method.start()
    association = decide(method, memory, frame(2), Fake(np.zeros((2, 0))))
    np.testing.assert_array_equal(association.matched, [NEW, NEW])
    association = decide(method, memory, frame(0), Fake(np.zeros((0, 2)), view=[0, 0]))
    assert len(association.matched) == 0 and association.retired == ()
    assert memory["serial"] == [0, 1] and memory["founded"] == 2


def test_reasons_by_hand():
    """Oracle: by hand: the reason of every fate, and the pairs inside three times the gate or the wider gate."""
    gate, new_gate = chi_square_2(0.95), chi_square_2(0.99)
    method = Likelihood(gate=0.95, new_gate=0.99, management=Trial(confirm=2, window=9))
    memory = memory_of(method, 3)
    decide(method, memory, frame(2), Fake([[0.1, 90.0, 90.0], [90.0, 0.1, 90.0]]))
    squared = np.array([[1.0, 90, 90], [2.0, 90, 90], [8.0, 90, 90], [90, 90, 1.0], [90, 90, 20.0]])
    predicted = Fake(squared, np.full((5, 3), -2.0))
    predicted.explain = True
    association = method.associate(memory, frame(5), predicted)
    why = association.why
    assert association.matched.tolist() == [0, SPURIOUS, SPURIOUS, 2, NEW]
    assert why.reasons.tolist() == [
        Reason.ASSIGNED, Reason.CONTEST_LOST, Reason.BETWEEN_GATES, Reason.NEAREST, Reason.FOUNDED,
    ]  # fmt: skip
    assert (why.gate, why.new_gate) == (gate, new_gate)
    assert why.pairs.tolist() == [[0, 0], [1, 0], [2, 0], [3, 2]]
    assert why.squared.tolist() == [1.0, 2.0, 8.0, 1.0]
    np.testing.assert_allclose(why.log_volume, -2.0)
    assert [(each.landmark, each.action) for each in why.managed] == [(2, "confirmed")]
