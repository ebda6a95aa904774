"""Nearest neighbour and the steps of dynamic joint nearest neighbour, each on its own and all together."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
import pytest

from djnn_paper import FREE, Paper, Problem, random_problem
from kalmap.geometry.ellipses import chi_square_2
from kalmap.kernels import nearest as kernel
from kalmap.records import NEW, SPURIOUS

GATE = chi_square_2(0.95)


def dynamic_joint(problem: Problem, gate=GATE, clear=True, widen=3.0):
    """(case, widened, matched, offset, squared, normalised) of the kernel."""
    squared, normalised = problem.tables()
    matched, offset = np.full(problem.shape[0], FREE), np.zeros(2)
    case, widened = kernel.dynamic_joint(
        problem.z, problem.noises, problem.expected, problem.spreads, problem.extra, problem.usable,
        problem.inside, gate, clear, widen, squared, normalised, matched, offset,
    )  # fmt: skip
    return case, widened, matched.tolist(), offset, squared, normalised


def is_one_to_one(matched) -> bool:
    taken = [c for c in matched if c != FREE]
    return len(set(taken)) == len(taken)


# --- all steps together ---------------------------------------------------------------


@pytest.mark.parametrize("clear", [True, False], ids=["clear", "as they are"])
@pytest.mark.parametrize("widen", [3.0, 0.0])
def test_the_whole_equals_the_paper(clear, widen):
    """Oracle: the paper in plain Python, on 300 random frames: pairs, case, offset and the distances left behind."""
    seen = Counter()
    for seed in range(300):
        problem = random_problem(np.random.default_rng(seed))
        case, widened, matched, offset, squared, normalised = dynamic_joint(problem, GATE, clear, widen)
        paper = Paper(problem, GATE)
        expected_offset = paper.decide(widen, clear)
        assert matched == paper.answer(), seed
        assert case == paper.case, seed
        np.testing.assert_allclose(offset, expected_offset, atol=1e-12, err_msg=str(seed))
        for m, c in itertools.product(*map(range, problem.shape)):
            np.testing.assert_allclose((squared[m, c], normalised[m, c]), paper.distance(m, c), rtol=1e-9)
        assert is_one_to_one(matched) or not clear, seed
        seen[case, bool(widened)] += 1
    if clear:
        wanted = [(1, False), (2, False), (3, False), (4, False)] + [(4, True)] * (widen > 0)
        assert all(seen[each] >= 8 for each in wanted), seen
    assert widen > 0 or not any(widened for _, widened in seen)


HAND_WORKED = {
    # name: (expected ranges, seen ranges, gate, matched, case, offset m); noise and spread together are 1 m^2
    "case 1: nobody shares": ((10, 20), (10.5, 20.2), 4.0, [0, 1], 1, 0.0),
    "case 1: one unmatched": ((10, 20), (10.5, 15.0), 4.0, [0, FREE], 1, 0.0),
    # 11 is good and 1 m too far; 21.2 and 23 both claim 22; less 1 m they are 20.2 and 22.0
    "case 2: offset tells them apart": ((10, 20, 22), (11, 21.2, 23), 4.0, [0, 1, 2], 2, 1.0),
    # less 1 m: 22.1 keeps 22, the other at 22.4 finds nothing else inside the gate
    "case 2: the loser goes without": ((10, 22), (11, 23.1, 23.4), 4.0, [0, 1, FREE], 2, 1.0),
    # 12.4 is nearest to 12: offset 0.4, and 11.1 - 0.4 is nearer to 10
    "case 3: offset tells them apart": ((10, 12), (11.1, 12.4), 4.0, [0, 1], 3, 0.4),
    # 21.2 is nearest to 22: offset -0.8, 23.8 still claims 22 and 20 is too far
    "case 3: still contested": ((20, 22), (21.2, 23), 4.0, [1, FREE], 3, -0.8),
    # best pair of the widened gate 12: 13 with 10, offset 3
    "case 4: everything is displaced": ((10, 20), (13, 23.2), 4.0, [0, 1], 4, 3.0),
    # best pair: 13.5 with 12, offset 1.5; 14.1 - 1.5 claims 12 as well and loses
    "case 4: contested afterwards": ((10, 12), (13.5, 14.1), 1.0, [1, FREE], 4, 1.5),
    "case 4: too far even so": ((10, 20), (13.5, 23.6), 4.0, [FREE, FREE], 4, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", HAND_WORKED)
def test_cases_by_hand(name):
    """Oracle: worked out with pencil and paper, see the comments."""
    expected, seen, gate, matched, case, offset = HAND_WORKED[name]
    problem = Problem(np.c_[seen, np.zeros(len(seen))], np.c_[expected, np.zeros(len(expected))])
    got = dynamic_joint(problem, gate)
    assert got[2] == matched and got[0] == case
    np.testing.assert_allclose(got[3], [offset, 0.0], atol=1e-12)


def test_switches_by_hand():
    """Oracle: with `clear` off it is nearest neighbour; with `widen` 0, or nothing inside the view, case 4
    does nothing."""
    shared = Problem([[11, 0], [21.2, 0], [23, 0]], [[10, 0], [20, 0], [22, 0]])
    assert dynamic_joint(shared, 4.0, clear=False)[2] == [0, 2, 2]
    displaced = Problem([[13, 0], [23.2, 0]], [[10, 0], [20, 0]])
    assert dynamic_joint(displaced, 4.0, widen=0.0)[1:3] == (False, [FREE, FREE])
    assert dynamic_joint(displaced, 4.0, widen=2.0)[1:3] == (False, [FREE, FREE])
    assert dynamic_joint(displaced, 4.0, widen=2.3)[1:3] == (True, [0, 1])
    displaced.inside = np.zeros(2, bool)
    assert dynamic_joint(displaced, 4.0)[1:3] == (False, [FREE, FREE])
    displaced.inside = np.array([False, True])
    assert dynamic_joint(displaced, 4.0)[2] == [0, 1]
    np.testing.assert_allclose(dynamic_joint(displaced, 4.0)[3], [3.2, 0.0])


def test_offset_across_the_seam_of_the_angle():
    """Oracle: the same frame turned by pi, where bearings wrap."""
    z, expected = np.array([[10, 0.02], [20, 0.02], [20, 0.05]]), np.array([[10, 0.0], [20, 0.0], [20, 0.03]])
    noises, spreads = np.tile(np.diag([0.01, 4e-4]), (3, 1, 1)), np.zeros((3, 2, 2))
    plain = dynamic_joint(Problem(z, expected, noises, spreads))
    z[:, 1] -= math.pi  # now just above -pi
    expected[:, 1] = math.pi - np.array([1e-9, 1e-9, 2 * math.pi - 0.03])
    turned = dynamic_joint(Problem(z, expected, noises, spreads))
    assert turned[2] == plain[2]
    np.testing.assert_allclose(turned[3], plain[3], atol=1e-8)


# --- the steps one by one ---------------------------------------------------------------


def random_matching(rng):
    m, c = int(rng.integers(1, 9)), int(rng.integers(1, 6))
    return rng.integers(-1, c, m), c


def test_nearest_equals_the_definition():
    """Oracle: equations (4) and (5) with min() over the open candidates; rows not asked for stay as they are."""
    for seed in range(300):
        rng = np.random.default_rng(seed)
        m, c = rng.integers(0, 7, 2)
        squared = rng.exponential(5.0, (m, c))
        normalised = squared + rng.normal(-4, 4, (m, c))
        rows, open_columns, matched = rng.random(m) < 0.7, rng.random(c) < 0.7, np.full(m, 77)
        kernel.nearest(squared, normalised, GATE, rows, open_columns, matched)
        for k in range(m):
            possible = [j for j in range(c) if open_columns[j] and squared[k, j] <= GATE]
            best = min(possible, key=lambda j: normalised[k, j], default=FREE)
            assert matched[k] == (best if rows[k] else 77), seed


def test_interference_counts():
    """Oracle: collections.Counter."""
    for seed in range(200):
        matched, c = random_matching(np.random.default_rng(seed))
        claims = Counter(matched[matched != FREE].tolist())
        contested = np.empty(len(matched), bool)
        good, bad = kernel.interference(matched, c, contested)
        assert contested.tolist() == [k != FREE and claims[k] > 1 for k in matched.tolist()]
        assert good == sum(n == 1 for n in claims.values()) and bad == sum(
            n for n in claims.values() if n > 1
        )


def test_observation_offset_is_the_mean_innovation():
    """Oracle: equation (6) with numpy's mean, bearings as complex numbers; zero without a pair."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        problem = random_problem(rng)
        m, c = problem.shape
        matched = rng.integers(-1, c, m) if c else np.full(m, FREE)
        chosen, offset = (matched != FREE) & (rng.random(m) < 0.6), np.full(2, 9.0)
        kernel.observation_offset(problem.z, problem.expected, matched, chosen, offset)
        if not chosen.any():
            np.testing.assert_array_equal(offset, 0.0)
            continue
        z, expected = problem.z[chosen], problem.expected[matched[chosen]]
        np.testing.assert_allclose(offset[0], (z[:, 0] - expected[:, 0]).mean(), atol=1e-12)
        np.testing.assert_allclose(offset[1], np.angle(np.exp(1j * (z[:, 1] - expected[:, 1]))).mean())


def test_shifted_distances_and_rows_left_alone():
    """Oracle: numpy.linalg.solve and det, one pair at a time; other rows bit for bit as before."""
    for seed in range(100):
        rng = np.random.default_rng(seed)
        problem = random_problem(rng)
        m, _ = problem.shape
        squared, normalised = rng.random(problem.shape), rng.random(problem.shape)
        before, rows, offset = (squared.copy(), normalised.copy()), rng.random(m) < 0.5, rng.normal(0, 0.5, 2)
        kernel.shifted(
            problem.z, problem.noises, problem.expected, problem.spreads, problem.extra, offset, rows,
            squared, normalised,
        )  # fmt: skip
        expected = problem.tables(offset)
        for got, kept, wanted in zip((squared, normalised), before, expected, strict=True):
            np.testing.assert_array_equal(got[~rows], kept[~rows])
            np.testing.assert_allclose(got[rows], wanted[rows], rtol=1e-9, atol=1e-9)


def test_nearest_claims_leave_one_winner_a_candidate():
    """Oracle: min() over the claims of every contested candidate."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        matched, c = random_matching(rng)
        normalised, winners = rng.normal(0, 3, (len(matched), c)), np.empty(len(matched), bool)
        contested = np.empty(len(matched), bool)
        kernel.interference(matched, c, contested)
        kernel.nearest_claims(normalised, matched, contested, winners)
        best = {
            min(np.flatnonzero(matched == j).tolist(), key=lambda m: normalised[m, j])
            for j in set(matched[contested].tolist())
        }
        assert set(np.flatnonzero(winners).tolist()) == best


def settle(squared, normalised, gate, usable, matched):
    kernel.settle(squared, normalised, gate, usable, matched, np.empty(len(matched), bool))


def test_settling_ends_clean_and_keeps_winners():
    """Oracle: the paper's loop in plain Python, on random tables and starts."""
    for seed in range(300):
        rng = np.random.default_rng(seed)
        matched, c = random_matching(rng)
        m = len(matched)
        squared = rng.exponential(4.0, (m, c))
        normalised, usable = squared + rng.normal(0, 2, c), rng.random(c) < 0.8
        paper = Paper(Problem(np.zeros((m, 2)), np.zeros((c, 2)), usable=usable), GATE)
        paper.distance = lambda k, j, a=squared, b=normalised: (a[k, j], b[k, j])
        paper.h = {k: j for k, j in enumerate(matched.tolist()) if j != FREE}
        paper.until_clean()
        settle(squared, normalised, GATE, usable, matched)
        assert matched.tolist() == paper.answer(), seed
        assert is_one_to_one(matched.tolist())


def test_best_widened_pair():
    """Oracle: numpy's argmin over the candidates inside the view, equation (8)."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        m, c = rng.integers(0, 5, 2)
        squared, inside, pair = rng.exponential(20.0, (m, c)), rng.random(c) < 0.6, np.full(2, 9)
        found = kernel.best_widened(squared, 3 * GATE, inside, pair)
        masked = np.where(inside[None], squared, np.inf)
        assert found == bool(masked.size and masked.min() <= 3 * GATE)
        if found:
            assert masked[tuple(pair)] == masked.min()


ADVERSARIES = {
    "all equal": lambda m, c: np.ones((m, c)),
    "all zero": lambda m, c: np.zeros((m, c)),
    "all infinite": lambda m, c: np.full((m, c), np.inf),
    "one column finite": lambda m, c: np.where(np.arange(c) == 0, 1.0, np.inf) + np.zeros((m, c)),
    "infinities and zeros": lambda m, c: np.where((np.arange(m)[:, None] + np.arange(c)) % 2, np.inf, 0.0),
    "a cycle of envy": lambda m, c: (np.arange(m)[:, None] - np.arange(c)) % max(m, c, 1) + 0.0,
}


@pytest.mark.parametrize("name", ADVERSARIES)
@pytest.mark.parametrize("gate", [0.0, 5.99, math.inf])
def test_settling_terminates_on_adversaries(name, gate):
    """Oracle: it ends, one-to-one, and gives nothing outside the gate but what winners held before."""
    for m, c in itertools.product((1, 2, 5, 12), (1, 2, 5, 12)):
        table = ADVERSARIES[name](m, c).astype(float)
        for start in (np.zeros(m, int), np.arange(m) % c, np.full(m, FREE), np.arange(m) // 2 % c):
            matched = start.copy()
            settle(table, table, gate, np.ones(c, bool), matched)
            assert is_one_to_one(matched.tolist())
            kept = (matched == FREE) | (matched == start)
            assert (kept | (table[np.arange(m), matched] <= gate)).all()


@pytest.mark.parametrize("gate", [0.0, GATE, math.inf])
@pytest.mark.parametrize("m", [1, 2, 30])
@pytest.mark.parametrize("c", [0, 1, 2, 30])
def test_all_sightings_and_all_landmarks_in_one_place(gate, m, c):
    """Oracle: it ends; as many pairs as there are of the fewer, as all distances are zero."""
    problem = Problem(np.tile([10.0, 0.3], (m, 1)), np.tile([10.0, 0.3], (c, 1)))
    case, _, matched, offset, _, _ = dynamic_joint(problem, gate)
    assert is_one_to_one(matched) and sum(k != FREE for k in matched) == min(m, c)
    np.testing.assert_array_equal(offset, 0.0)
    assert case == (4 if c == 0 else 1 if m == 1 else 3)


# --- what becomes of the rest ---------------------------------------------------------------


def plain_finish(squared, normalised, trial, gate, new_gate, matched):
    """Fates by the docstring of `finish`, with the paper's loop for the landmarks on trial."""
    m, c = squared.shape
    sure, tried = np.flatnonzero(~trial), np.flatnonzero(trial)
    fate: dict[int, int] = {k: kernel.MATCHED for k in range(m) if matched[k] != FREE}

    def near(k, columns, lost=kernel.LOST):
        least = min(squared[k, columns], default=np.inf)
        return lost if least <= gate else kernel.BETWEEN if least < new_gate else None

    left = [k for k in range(m) if k not in fate]
    fate |= {k: near(k, sure) for k in left if near(k, sure) is not None}
    left = [k for k in left if k not in fate]
    paper = Paper(Problem(np.zeros((m, 2)), np.zeros((c, 2)), usable=trial), gate)
    paper.distance = lambda k, j: (squared[k, j], normalised[k, j])
    paper.nn(left, paper.features())
    paper.until_clean()
    for k in left:
        fate[k] = kernel.TRIAL if k in paper.h else near(k, tried, kernel.LOST_TRIAL) or kernel.NEW
    return [fate[k] for k in range(m)], [paper.h.get(k, matched[k]) for k in range(m)]


def test_fates_equal_the_definition():
    """Oracle: the docstring in plain Python, on 400 random tables; every fate occurs."""
    seen = Counter()
    for seed in range(400):
        rng = np.random.default_rng(seed)
        m, c = int(rng.integers(0, 7)), int(rng.integers(0, 7))
        squared = rng.exponential(30.0, (m, c))
        normalised, trial = squared + rng.normal(0, 3, c), rng.random(c) < 0.5
        matched, fate = np.full(m, FREE), np.empty(m, dtype=np.int64)
        kernel.nearest(squared, normalised, GATE, rng.random(m) < 0.5, ~trial, matched)
        fates, after = plain_finish(squared, normalised, trial, GATE, 13.8, matched.tolist())
        kernel.finish(squared, normalised, trial, GATE, 13.8, matched, fate)
        assert fate.tolist() == fates and matched.tolist() == after, seed
        seen.update(fates)
    assert min(seen[each] for each in range(5)) > 20, seen


def test_fates_by_hand():
    """Oracle: by hand. Column 0 is believed in, column 1 on trial; gate 4, gate for new ones 10."""
    squared = np.array([[1, 1], [2, 90], [7, 1], [90, 2], [90, 3], [90, 7], [90, 10], [90, 90]], float)
    matched, fate = np.full(8, FREE), np.empty(8, dtype=np.int64)
    matched[0] = 0
    kernel.finish(squared, squared, np.array([False, True]), 4.0, 10.0, matched, fate)
    assert fate.tolist() == [
        kernel.MATCHED, kernel.LOST, kernel.BETWEEN, kernel.TRIAL,
        kernel.LOST_TRIAL, kernel.BETWEEN, kernel.NEW, kernel.NEW,
    ]  # fmt: skip
    assert matched.tolist() == [0, FREE, FREE, 1, FREE, FREE, FREE, FREE]


def test_what_a_frame_comes_to():
    """Oracle: a dictionary by fate: matched and tried take their candidate's place in the map, the rest none."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        m, c = int(rng.integers(0, 8)), int(rng.integers(1, 8))
        indices, fate = rng.choice(100, c, replace=False), rng.integers(0, 6, m)
        columns, matched, seen = rng.integers(0, c, m), np.full(m, 77), rng.random(c) < 0.5
        before = columns.copy()
        founded = kernel.outcome(columns, fate, indices, matched, seen)
        given = np.isin(fate, [kernel.MATCHED, kernel.TRIAL])
        assert founded == (fate == kernel.NEW).sum()
        assert matched.tolist() == [
            indices[b] if g else NEW if f == kernel.NEW else SPURIOUS
            for b, g, f in zip(before, given, fate, strict=True)
        ]
        assert columns.tolist() == np.where(given, before, FREE).tolist()
        assert np.flatnonzero(seen).tolist() == sorted(set(before[given].tolist()))
