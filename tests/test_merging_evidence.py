"""When landmarks are taken for one and the same: counting by hand, and log odds against scipy and brute force."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from kalmap.association import Merging
from kalmap.association.merging import Suspicion
from kalmap.geometry.ellipses import chi_square_2

SERIALS = list(range(9))


class Near:
    """A predicted map of landmarks in the plane with a given joint covariance; a sensor that sees 30 m ahead."""

    max_range, half_view = 30.0, 0.5 * np.pi
    sensor_pose = (0.0, 0.0, 0.0)

    def __init__(self, at, covariance=None) -> None:
        self.at = np.array([(x, 0.0) if np.isscalar(x) else x for x in at], float).reshape(-1, 2)
        n = 2 * len(self.at)
        self.covariance = 0.5 * np.eye(n) if covariance is None else covariance

    def positions(self, indices):
        return self.at[indices]

    def joint(self, indices):
        entries = np.stack([2 * indices, 2 * indices + 1], axis=1).ravel()
        return self.at[indices].ravel(), self.covariance[np.ix_(entries, entries)]

    def difference(self, pairs, extent):
        """(mean, covariance) of the differences of several pairs, written with blocks."""
        g = np.zeros((2 * len(pairs), 2 * len(self.at)))
        for k, (i, j) in enumerate(pairs):
            g[2 * k : 2 * k + 2, 2 * i : 2 * i + 2] = np.eye(2)
            g[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = -np.eye(2)
        return g @ self.at.ravel(), g @ self.covariance @ g.T + 2 * extent**2 * np.eye(len(g))

    def separations(self, first, second, extent):
        each = [self.difference([pair], extent) for pair in zip(first, second, strict=True)]
        return np.array([d @ np.linalg.solve(s, d) for d, s in each])


def suspect(merging, memory, near, seen, expected=None, serials=None, extent=0.0):
    near = near if isinstance(near, Near) else Near(near)
    count = len(near.at)
    expected = np.ones(count, bool) if expected is None else np.array(expected, bool)
    serials = list(range(count)) if serials is None else serials
    return merging.suspect(memory, serials, near, np.arange(count), np.array(seen, bool), expected, extent)


def log_odds(near, pairs, frames=(), extent=0.0, unseen=1.5) -> float:
    """scipy's density of the differences at 0, against one landmark anywhere for each pair, and `unseen` a frame."""
    d, s = near.difference(pairs, extent)
    density = len(near.at) / (near.half_view * near.max_range**2)
    chance = len(pairs) * np.log(density)
    return multivariate_normal.logpdf(np.zeros(len(d)), d, s) - chance + unseen * sum(frames)


def test_counting_by_hand():
    """Oracle: by hand: frames that see one of a pair while the other should be seen are counted, and one that sees
    both says -1 for ever."""
    merging, memory = Merging(odds=1e9), Merging().start()
    for frame, seen in enumerate(([1, 0], [0, 1], [1, 0])):
        found = suspect(merging, memory, [0.0, 1.0], seen)
        assert (found.apart, found.alike) == ((), ((0, 1),))
        merging.settle(memory, found, SERIALS)
        assert memory["0 1"] == frame + 1
    found = suspect(merging, memory, [0.0, 1.0], [1, 1])
    assert (found.apart, found.alike) == (((0, 1),), ())
    merging.settle(memory, found, SERIALS)
    for seen in ([1, 0], [1, 1], [0, 1]):
        assert memory["0 1"] == -1
        found = suspect(merging, memory, [0.0, 1.0], seen)
        assert (found.apart, found.alike, found.merged) == ((), (), ())
        merging.settle(memory, found, SERIALS)


@pytest.mark.parametrize(
    ("at", "seen", "expected", "extent", "alike"),
    [
        ([0.0, 1.0], [0, 0], [1, 1], 0.0, ()),  # nobody was seen
        ([0.0, 1.0], [1, 0], [1, 0], 0.0, ()),  # the other could not be seen
        ([0.0, 1.0], [1, 0], [0, 1], 0.0, ((0, 1),)),  # seen, though it was not to be expected
        ([0.0, 4.0], [1, 0], [1, 1], 0.0, ()),  # 16 squared: outside the gate of 9.21
        ([0.0, 4.0], [1, 0], [1, 1], 1.0, ((0, 1),)),  # one metre wide each: 16 / 3
        ([0.0, 11.0], [1, 0], [1, 1], 9.0, ()),  # farther apart than 10 m
        ([0.0, 6.0], [0, 1], [1, 1], 9.0, ((0, 1),)),
        ([0.0, 0.1, 6.0, 6.3], [1, 0, 0, 1], [1, 1, 1, 1], 0.0, ((0, 1), (2, 3))),
        ([0.0], [1], [1], 0.0, ()),
        ([], [], [], 0.0, ()),
    ],
)  # fmt: skip
def test_who_is_suspected_by_hand(at, seen, expected, extent, alike):
    """Oracle: by hand, see the comments; the gate is -2 ln 0.01 = 9.21."""
    assert suspect(Merging(), {}, at, seen, expected, extent=extent).alike == alike


@pytest.mark.parametrize("extent", [0.0, 0.3])
@pytest.mark.parametrize("known", [0, 1, 2, 7])
@pytest.mark.parametrize("gap", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
def test_a_pair_is_judged_by_its_odds(gap, known, extent):
    """Oracle: the log odds with scipy: at least 7 merges, less does not; this frame counts, at most three do."""
    near = Near([20.0, 20.0 + gap])
    found = suspect(Merging(), {"0 1": known}, near, [1, 0], extent=extent)
    odds = log_odds(near, [(0, 1)], [min(known + 1, 3)], extent)
    assert abs(odds - 7.0) > 1e-3
    assert bool(found.merged) == (odds >= 7.0)
    for keep, drop, said in found.merged:
        assert (keep, drop) == (0, 1)
        np.testing.assert_allclose(said, odds, atol=1e-6)


def test_a_frame_that_sees_nobody_merges_nobody():
    """Oracle: by hand: however ripe the evidence."""
    assert suspect(Merging(), {"0 1": 9}, [20.0, 20.1], [0, 0]).merged == ()


def test_the_older_stays():
    """Oracle: by hand: index 1 carries number 4, index 0 number 9."""
    found = suspect(Merging(), {"4 9": 5}, [0.0, 0.1], [1, 0], serials=[9, 4])
    assert [(keep, drop) for keep, drop, _ in found.merged] == [(1, 0)]


def lost(seed: int, old, offset, astray: float) -> Near:
    """Landmarks `old`, and all of them again by a robot that was `offset` astray: one error for all the new ones."""
    rng, n = np.random.default_rng(seed), 2 * len(old)
    covariance = 0.02 * np.eye(2 * n)
    covariance[n:, n:] += np.kron(np.ones((len(old), len(old))), astray**2 * np.eye(2))
    new = np.array(old) + offset + rng.normal(0, 0.1, (len(old), 2))
    return Near([*old, *new], covariance)


OLD = [(14.0, 3.0), (19.0, -4.0), (22.5, 6.0)]


@pytest.mark.parametrize("seed", range(5))
def test_pairs_that_fit_together_are_merged_together(seed):
    """Oracle: scipy, all sets of disjoint pairs tried: the true one is the best, and each pair alone is too little."""
    near = lost(seed, OLD, (1.5, -2.0), 2.0)
    seen = [0, 0, 0, 1, 1, 1]
    found = suspect(Merging(), {}, near, seen, expected=np.zeros(6))
    close = [(i, j) for i in range(3) for j in range(3, 6)]
    assert all(log_odds(near, [pair]) < 7.0 for pair in close)
    best, pairs = max(
        (log_odds(near, [(i, j) for i, j in zip(some, others, strict=True)]), (some, others))
        for k in (1, 2, 3)
        for some in itertools.combinations(range(3), k)
        for others in itertools.permutations(range(3, 6), k)
    )
    assert pairs == ((0, 1, 2), (3, 4, 5)) and best > 12.0
    assert sorted((keep, drop) for keep, drop, _ in found.merged) == [(0, 3), (1, 4), (2, 5)]
    np.testing.assert_allclose([odds for _, _, odds in found.merged], best, atol=1e-3)


def test_a_row_that_fits_twice_is_left_alone():
    """Oracle: by hand: two new ones in the middle between three old ones in a row fit one step on as well as one
    step back: two sets that contradict each other and have the same odds. Without the third they fit one way."""
    old = [(12.0, 0.0), (16.0, 0.0), (20.0, 0.0)]
    new = [(14.0, 0.0), (18.0, 0.0)]
    covariance = 0.002 * np.eye(10)
    covariance[6:, 6:] += np.kron(np.ones((2, 2)), 4.0 * np.eye(2))
    near = Near([*old, *new], covariance)
    on, back = log_odds(near, [(0, 3), (1, 4)]), log_odds(near, [(1, 3), (2, 4)])
    np.testing.assert_allclose(on, back)
    assert on > 7.0
    assert suspect(Merging(), {}, near, [0, 0, 0, 1, 1]).merged == ()
    fewer = Near([*old[1:], *new], covariance[2:, 2:])
    assert [pair[:2] for pair in suspect(Merging(), {}, fewer, [0, 0, 1, 1]).merged] == [(0, 2), (1, 3)]


def test_a_set_is_looked_for_in_every_fifth_frame():
    """Oracle: by hand: the memory counts frames; what is ripe in the second is merged in the sixth."""
    merging, memory, merged = Merging(), Merging().start(), []
    for _ in range(6):
        found = suspect(merging, memory, [20.0, 20.1], [1, 0])
        merging.settle(memory, found, SERIALS)
        merged.append(len(found.merged))
    assert merged == [0, 0, 0, 0, 0, 1]


def test_who_was_seen_with_the_one_was_seen_with_the_other():
    """Oracle: by hand: 7 becomes 2 and 5 becomes 4; 7 was seen together with 5 and 8, so that 2 is neither 4 nor 8."""
    memory = {"frames": 3, "2 7": 3, "5 7": -1, "7 8": -1, "3 7": 2, "4 5": 3, "4 8": 1, "0 1": -1}
    found = Suspicion(merged=((0, 3, 9.0), (1, 2, 9.0)))
    Merging().settle(memory, found, [2, 4, 5, 7, 8])
    assert memory == {"frames": 4, "2 4": -1, "2 8": -1, "4 8": 1, "0 1": -1}


def test_a_sensor_without_limit_can_merge():
    """Oracle: scipy's log odds with the farthest landmark's range as the sensor's; two in one place and a third far."""
    near = Near([(10.0, 0.0), (10.0, 0.1), (40.0, 3.0)])
    near.max_range = np.inf
    found = suspect(Merging(), {"0 1": 3}, near, [1, 0, 0])
    near.max_range = np.hypot(40.0, 3.0)
    ((keep, drop, odds),) = found.merged
    assert (keep, drop) == (0, 1)
    np.testing.assert_allclose(odds, log_odds(near, [(0, 1)], [3]), atol=1e-6)
    found = suspect(Merging(), {"0 1": 3}, Near([(0.0, 0.0), (0.0, 0.0)]), [1, 0])
    assert len(found.merged) == 1


def test_the_memory_survives_messages():
    """Oracle: msgpack and back: the same dict."""
    memory = Merging().start()
    for seen in ([1, 0, 0], [1, 1, 0], [0, 1, 0]):
        Merging().settle(memory, suspect(Merging(odds=1e9), memory, [0.0, 1.0, 1.5], seen), SERIALS)
    assert memory == {"0 1": -1, "0 2": 2, "1 2": 2, "frames": 3}
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(memory)) == memory


def test_the_gate_is_a_chi_square_quantile():
    """Oracle: the quantile: just inside is suspected, just outside is not."""
    for probability in (0.5, 0.99):
        gap = np.sqrt(chi_square_2(probability))
        for factor, count in ((0.999, 1), (1.001, 0)):
            found = suspect(Merging(gate=probability), {}, [20.0, 20.0 + factor * gap], [1, 0])
            assert len(found.alike) == count
