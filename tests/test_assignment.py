"""Assignment over several frames, against brute force, HiGHS, scipy's assignment and known optima."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, linear_sum_assignment, linprog, milp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from kalmap.association.assignment import AssignmentError, solve_assignment
from kalmap.kernels.assignment import components
from kalmap.kernels.branching import branch_and_bound
from kalmap.kernels.matching import match_or_leave
from kalmap.kernels.relaxation import relax, share_prices
from kalmap.records import KalmapError

# --- problems -------------------------------------------------------------------------------------


def random_problem(rng, counts, size, mean=-1.0, whole=False):
    """Tuples of random parts, any of them absent; `whole` costs make many sets equally cheap."""
    parts = np.stack([rng.integers(-1, n, size) for n in counts], axis=1)
    costs = rng.normal(mean, 2.0, size)
    return parts[:, 0], parts[:, 1:], np.round(costs) if whole else costs, list(counts)


def gated_problem(rng, landmarks, sightings, candidates=3):
    """Each landmark has some candidates in each frame and a tuple for every combination of them."""
    rows, costs = [], []
    for j in range(landmarks):
        near = [[-1, *rng.choice(m, candidates, replace=False)] for m in sightings]
        score = [[0.0, *rng.normal(-2.0, 3.0, candidates)] for _ in sightings]
        for choice in np.ndindex(*(len(each) for each in near)):
            if any(choice):
                rows.append([j, *(n[c] for n, c in zip(near, choice, strict=True))])
                costs.append(sum(s[c] for s, c in zip(score, choice, strict=True)) + rng.normal())
    parts = np.array(rows)
    return parts[:, 0], parts[:, 1:], np.array(costs), [landmarks, *sightings]


def dense_problem(rng, side, frames=2):
    """Every combination of a landmark and a sighting of each frame, at uniform cost: the hard kind."""
    parts = np.indices((side,) * (frames + 1)).reshape(frames + 1, -1)
    return parts[0], parts[1:].T, rng.uniform(-10.0, 0.0, parts.shape[1]), [side] * (frames + 1)


# --- oracles --------------------------------------------------------------------------------------


def brute_force(landmark, sightings, costs):
    """Least cost over every set of tuples that uses nothing twice."""
    parts = np.c_[landmark, sightings]
    used = [frozenset((s, i) for s, i in enumerate(row) if i >= 0) for row in parts.tolist()]

    def best(start, taken):
        least = 0.0
        for t in range(start, len(used)):
            if not used[t] & taken:
                least = min(least, costs[t] + best(t + 1, taken | used[t]))
        return least

    return best(0, frozenset())


def rows_of(landmark, sightings, counts):
    """The constraints: for each landmark and sighting, which tuples use it."""
    parts, first = np.c_[landmark, sightings], np.concatenate([[0], np.cumsum(counts)])
    tuples, sides = np.nonzero(parts >= 0)
    numbers = first[sides] + parts[tuples, sides]
    return coo_matrix((np.ones(len(tuples)), (numbers, tuples)), shape=(first[-1], len(parts))).tocsr()


def highs(landmark, sightings, costs, counts):
    """Least cost by mixed-integer programming."""
    answer = milp(
        costs,
        constraints=LinearConstraint(rows_of(landmark, sightings, counts), -np.inf, 1.0),
        integrality=np.ones(len(costs)),
        bounds=Bounds(0.0, 1.0),
        options={"mip_rel_gap": 0.0},
    )
    assert answer.success
    return answer.fun


def check_set(problem, answer):
    """The chosen tuples use nothing twice, cost what is said, and the bound is consistent."""
    landmark, sightings, costs, _ = problem
    parts = np.c_[landmark, sightings][answer.chosen]
    for side in parts.T:
        used = side[side >= 0]
        assert len(used) == len(set(used.tolist()))
    assert np.all(np.diff(answer.chosen) > 0)
    assert answer.cost == pytest.approx(costs[answer.chosen].sum(), abs=1e-9)
    assert answer.bound <= answer.cost
    assert answer.gap == pytest.approx(answer.cost - answer.bound, abs=1e-12)


# --- exact ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("frames", [1, 2, 3])
@pytest.mark.parametrize("block", range(4))
def test_equals_brute_force(frames, block, whole):
    """Oracle: every feasible set tried; 40 problems in each of 24 blocks, a few of them without any tuple."""
    for seed in range(40):
        rng = np.random.default_rng([frames, block, whole, seed])
        counts = rng.integers(1, 5, frames + 1)
        problem = random_problem(rng, counts, int(rng.integers(0, 14)), whole=whole)
        answer = solve_assignment(*problem)
        check_set(problem, answer)
        assert answer.exact and answer.unproven == 0
        assert answer.cost == pytest.approx(brute_force(*problem[:3]), abs=1e-9)


@pytest.mark.parametrize(
    "limits", [{"nodes": 0}, {"work": 0}, {"work": 3, "nodes": 5}, {"work": 0, "nodes": 0}]
)
@pytest.mark.parametrize("frames", [2, 3, 4])
def test_bounds_hold_however_little_work_is_allowed(frames, limits):
    """Oracle: brute force lies between bound and cost, and is the cost where that claims to be exact."""
    proven = 0
    for seed in range(40):
        rng = np.random.default_rng([frames, seed])
        problem = random_problem(rng, rng.integers(2, 4, frames + 1), 14, mean=-2.0)
        answer = solve_assignment(*problem, **limits)
        check_set(problem, answer)
        least = brute_force(*problem[:3])
        assert answer.bound <= least + 1e-9 and least <= answer.cost + 1e-9
        assert answer.exact == (answer.unproven == 0)
        if answer.exact:
            assert answer.cost == pytest.approx(least, abs=2e-6)
        proven += answer.exact
    assert proven > 0


@pytest.mark.parametrize("seed", range(10))
def test_medium_problems_equal_mixed_integer_programming(seed):
    """Oracle: scipy.optimize.milp (HiGHS) on gated and on random problems of two to four frames."""
    rng = np.random.default_rng([7, seed])
    for problem in (
        gated_problem(rng, 20, (15, 15)),
        gated_problem(rng, 8, (7, 8, 6), 2),
        random_problem(rng, [8, 8, 8], 200),
        random_problem(rng, [6, 6, 6, 6, 6], 120),
    ):
        answer = solve_assignment(*problem)
        check_set(problem, answer)
        assert answer.exact
        assert answer.cost == pytest.approx(highs(*problem), abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_one_frame_equals_two_dimensional_assignment(seed):
    """Oracle: linear_sum_assignment on the square problem in which everybody has a partner of their own
    for staying alone. The same tuples with an empty second frame take the compiled way and must agree."""
    rng = np.random.default_rng([8, seed])
    landmarks, sightings = (int(n) for n in rng.integers(1, 12, 2))
    value = rng.normal(0.0, 2.0, (landmarks, sightings))
    alone = rng.normal(0.0, 1.0, landmarks), rng.normal(0.0, 1.0, sightings)
    full = np.full((landmarks + sightings, landmarks + sightings), 1e6)
    full[:landmarks, :sightings] = value
    full[:landmarks, sightings:][np.diag_indices(landmarks)] = np.minimum(alone[0], 0.0)
    full[landmarks:, :sightings][np.diag_indices(sightings)] = np.minimum(alone[1], 0.0)
    full[landmarks:, sightings:] = 0.0
    least = full[linear_sum_assignment(full)].sum()
    j, i = np.indices(value.shape).reshape(2, -1)
    lone = np.full(landmarks, -1), np.full(sightings, -1)
    landmark = np.concatenate([j, np.arange(landmarks), lone[1]])
    sighting = np.concatenate([i, lone[0], np.arange(sightings)])[:, None]
    costs = np.concatenate([value.ravel(), *alone])
    answer = solve_assignment(landmark, sighting, costs, [landmarks, sightings])
    check_set((landmark, sighting, costs, None), answer)
    assert answer.exact and answer.cost == pytest.approx(least, abs=1e-9)
    padded = np.c_[sighting, np.full(len(costs), -1)]
    other = solve_assignment(landmark, padded, costs, [landmarks, sightings, 0])
    assert other.exact and other.cost == pytest.approx(least, abs=1e-9)


def test_unused_prices_are_paid_for_what_is_left():
    """Oracle: the same problem with the prices subtracted from the tuples by hand, and brute force."""
    for seed in range(40):
        rng = np.random.default_rng([9, seed])
        counts = rng.integers(1, 5, 3)
        landmark, sightings, costs, counts = random_problem(rng, counts, 12, mean=1.0)
        unused = [rng.normal(1.0, 1.0, n) for n in counts[1:]]
        answer = solve_assignment(landmark, sightings, costs, counts, unused=unused)
        saved = [sum(unused[f][i] for f, i in enumerate(row) if i >= 0) for row in sightings.tolist()]
        least = brute_force(landmark, sightings, costs - np.array(saved)) + sum(u.sum() for u in unused)
        assert answer.cost == pytest.approx(least, abs=1e-9) and answer.exact
        left = [
            np.delete(u, sightings[answer.chosen, f].clip(0)[sightings[answer.chosen, f] >= 0])
            for f, u in enumerate(unused)
        ]
        assert answer.cost == pytest.approx(costs[answer.chosen].sum() + sum(u.sum() for u in left), abs=1e-9)


# --- large ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_dense_problem_reports_its_gap(seed):
    """Oracle: HiGHS between bound and cost of the relaxation alone; the search closes the gap to it."""
    problem = dense_problem(np.random.default_rng([10, seed]), 9)
    least = highs(*problem)
    answer = solve_assignment(*problem, nodes=0)
    check_set(problem, answer)
    assert answer.bound <= least + 1e-9 <= answer.cost + 2e-9
    assert answer.relative_gap == pytest.approx(answer.gap / -answer.cost)
    assert answer.exact == (answer.gap <= 1e-6)
    closed = solve_assignment(*problem)
    assert closed.exact and closed.cost == pytest.approx(least, abs=1e-6)


def test_large_dense_problem_ends_within_its_work():
    """Oracle: a planted optimum: prices of all things, and surpluses that are zero on one perfect set."""
    rng = np.random.default_rng(11)
    side = 50
    landmark, sightings, costs, counts = dense_problem(rng, side)
    prices = rng.uniform(0.5, 5.0, (3, side))
    surplus = rng.exponential(1.0, len(costs))
    partner = rng.permutation(side), rng.permutation(side)
    surplus[(sightings[:, 0] == partner[0][landmark]) & (sightings[:, 1] == partner[1][landmark])] = 0.0
    total = prices[0][landmark] + prices[1][sightings[:, 0]] + prices[2][sightings[:, 1]]
    problem = landmark, sightings, surplus - total, counts
    answer = solve_assignment(*problem, work=15, nodes=200)
    check_set(problem, answer)
    assert answer.iterations <= 15 and answer.nodes <= 200
    least = -prices.sum()
    assert answer.bound <= least + 1e-9 <= answer.cost + 2e-9
    assert answer.relative_gap < 0.01


def test_relaxation_reaches_the_linear_programme():
    """Oracle: the Lagrangian dual equals the linear programme (scipy.optimize.linprog): from below, and near."""
    for seed in range(6):
        rng = np.random.default_rng([12, seed])
        for problem in (gated_problem(rng, 20, (15, 15)), random_problem(rng, [8, 8, 8, 8], 250)):
            landmark, sightings, costs, counts = problem
            named = np.c_[landmark, sightings].max(axis=1) >= 0
            landmark, sightings, costs = landmark[named], sightings[named], costs[named]
            rows = rows_of(landmark, sightings, counts)
            programme = linprog(costs, A_ub=rows, b_ub=np.ones(rows.shape[0]), method="highs").fun
            answer = solve_assignment(landmark, sightings, costs, counts, nodes=0)
            assert answer.bound <= programme + 1e-9
            assert answer.bound >= 1.005 * programme


# --- invariance and structure ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_order_and_names_do_not_matter(seed):
    """Oracle: the same problem with its tuples shuffled, its things renamed and its later frames swapped."""
    rng = np.random.default_rng([13, seed])
    landmark, sightings, costs, counts = random_problem(rng, [7, 6, 8], 90, whole=seed % 2 == 0)
    cost = solve_assignment(landmark, sightings, costs, counts).cost
    order = rng.permutation(len(costs))
    names = [np.append(rng.permutation(n), -1) for n in counts]
    renamed = np.stack([names[1 + f][sightings[order, f]] for f in (1, 0)], axis=1)
    other = solve_assignment(
        names[0][landmark[order]], renamed, costs[order], [counts[0], counts[2], counts[1]]
    )
    assert other.exact and other.cost == pytest.approx(cost, abs=1e-9)


def test_problems_that_share_nothing_add_up():
    """Oracle: two problems side by side cost their sum, and so do their components and gaps."""
    for seed in range(10):
        rng = np.random.default_rng([14, seed])
        one, two = (random_problem(rng, [5, 5, 5], 40) for _ in range(2))
        moved = [np.where(part < 0, -1, part + 5) for part in two[:2]]
        both = solve_assignment(
            np.r_[one[0], moved[0]], np.r_[one[1], moved[1]], np.r_[one[2], two[2]], [10, 10, 10], nodes=0
        )
        apart = [solve_assignment(*each, nodes=0) for each in (one, two)]
        assert both.components == sum(each.components for each in apart)
        assert both.cost == pytest.approx(sum(each.cost for each in apart), abs=3e-6)
        assert both.bound == pytest.approx(sum(each.bound for each in apart), abs=3e-6)


@pytest.mark.parametrize("seed", range(5))
def test_components_are_the_connected_ones(seed):
    """Oracle: scipy's connected components of the graph of tuples and things."""
    rng = np.random.default_rng([15, seed])
    landmark, sightings, _, counts = random_problem(rng, [20, 20, 20], 25)
    first = np.concatenate([[0], np.cumsum(counts)])
    parts = np.c_[landmark, sightings]
    numbers = np.where(parts < 0, -1, parts + first[:-1])
    order, starts = components(numbers, int(first[-1]))
    shared = rows_of(landmark, sightings, counts)
    count, label = connected_components(shared.T @ shared, directed=False)
    assert len(starts) - 1 == count
    assert sorted(order.tolist()) == list(range(len(landmark)))
    groups = {frozenset(order[a:b].tolist()) for a, b in itertools.pairwise(starts)}
    assert groups == {frozenset(np.flatnonzero(label == c).tolist()) for c in range(count)}


# --- the parts ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4, 7), (7, 4), (5, 5), (1, 6), (6, 1), (0, 3), (3, 0)])
def test_matching_and_its_prices(shape):
    """Oracle: linear_sum_assignment on the gains of pairing, and duality: feasible prices with the same sum."""
    for seed in range(20):
        rng = np.random.default_rng([16, *shape, seed])
        values = np.zeros((shape[0] + 1, shape[1] + 1))
        values[:-1, :-1] = rng.normal(-1.0, 2.0, shape)
        values[:-1, :-1][rng.random(shape) < 0.4] = np.inf
        values[:-1, -1], values[-1, :-1] = -rng.random(shape[0]), -rng.random(shape[1])
        partner, row, column = np.empty(shape[0], np.int64), np.empty(shape[0]), np.empty(shape[1])
        match_or_leave(values, partner, row, column)
        gain = np.minimum(values[:-1, :-1] - values[:-1, -1:] - values[-1:, :-1], 0.0)
        least = gain[linear_sum_assignment(gain)].sum() + values[:-1, -1].sum() + values[-1, :-1].sum()
        pairs = np.flatnonzero(partner >= 0)
        assert len(set(partner[pairs].tolist())) == len(pairs)
        cost = values[pairs, partner[pairs]].sum() + np.delete(values[:-1, -1], pairs).sum()
        cost += np.delete(values[-1, :-1], partner[pairs]).sum()
        assert cost == pytest.approx(least, abs=1e-9)
        assert -(row.sum() + column.sum()) == pytest.approx(least, abs=1e-9)
        assert np.all(row[:, None] + column >= -values[:-1, :-1] - 1e-9)
        assert np.all(row >= -values[:-1, -1] - 1e-9) and np.all(column >= -values[-1, :-1] - 1e-9)


@pytest.mark.parametrize("frames", [2, 3, 4])
def test_prices_pay_for_every_tuple(frames):
    """Oracle: the definition of a bound: prices >= 0 that add up to at least minus the cost of each tuple."""
    for seed in range(20):
        rng = np.random.default_rng([17, frames, seed])
        landmark, sightings, costs, counts = random_problem(rng, [5] * (frames + 1), 60)
        parts = np.c_[landmark, sightings]
        kept = (costs < 0.0) & (parts.max(axis=1) >= 0)
        parts, costs = parts[kept], costs[kept]
        first = np.concatenate([[0], np.cumsum(counts)])
        tuples = np.where(parts < 0, -1, parts + first[:-1])
        price, taken = np.empty(first[-1]), np.zeros(len(costs), bool)
        share_prices(tuples, costs, price)
        early = price.copy()
        bound, cost, _ = relax(tuples, costs, first, 30, 0.0, price, taken, 0.0)
        for prices in (early, price):
            paid = np.append(prices, 0.0)[tuples].sum(axis=1)
            assert np.all(prices >= 0.0) and np.all(paid >= -costs - 1e-9)
        assert bound == pytest.approx(-price.sum()) and bound >= -early.sum()
        assert cost == pytest.approx(costs[taken].sum())


def test_search_without_budget_keeps_what_it_had():
    """Oracle: by hand: one node can prove nothing about three tuples that exclude each other pairwise."""
    tuples, first = np.array([[0, 1, -1], [0, -1, 2], [-1, 1, 2]]), np.arange(4)
    costs, price = np.array([-3.0, -2.0, -2.0]), np.array([1.5, 1.5, 0.5])
    taken = np.array([False, True, False])
    cost, proven, nodes = branch_and_bound(tuples, costs, first, price, 1, taken, -2.0)
    assert (cost, proven, nodes) == (-2.0, False, 1) and taken.tolist() == [False, True, False]
    cost, proven, _ = branch_and_bound(tuples, costs, first, price, 100, taken, -2.0)
    assert (cost, proven) == (-3.0, True) and taken.tolist() == [True, False, False]


def test_odd_cycle_has_a_gap_that_only_the_search_closes():
    """Oracle: by hand: of three tuples that exclude each other pairwise one can be taken (-2); half of each
    (-3) is the best of the linear programme, and so of the relaxation."""
    landmark, sightings = np.array([0, 0, -1]), np.array([[0, -1], [-1, 0], [0, 0]])
    answer = solve_assignment(landmark, sightings, np.full(3, -2.0), [1, 1, 1], nodes=0)
    assert not answer.exact and answer.unproven == 1
    assert (answer.cost, answer.bound) == (-2.0, pytest.approx(-3.0))
    assert answer.relative_gap == pytest.approx(0.5)
    closed = solve_assignment(landmark, sightings, np.full(3, -2.0), [1, 1, 1])
    assert closed.exact and closed.cost == closed.bound == -2.0 and closed.gap == 0.0


# --- degenerate and bad ---------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [[0], [3], [0, 0], [3, 2], [0, 0, 0], [4, 0, 2], [2, 2, 2, 2]])
def test_no_tuples(counts):
    """Oracle: nothing costs nothing, or what the unused sightings cost."""
    frames = len(counts) - 1
    answer = solve_assignment(np.array([]), np.empty((0, frames)), np.array([]), counts)
    assert (answer.cost, answer.bound, answer.gap, answer.exact) == (0.0, 0.0, 0.0, True)
    assert answer.chosen.dtype == np.int64 and answer.chosen.shape == (0,) and answer.components == 0
    unused = [np.full(n, 1.5) for n in counts[1:]]
    answer = solve_assignment([], [], [], counts, unused=unused)
    assert answer.cost == answer.bound == 1.5 * sum(counts[1:])


def test_zero_frames():
    """Oracle: by hand: each landmark takes its cheapest tuple that is worth it."""
    answer = solve_assignment([0, 0, 1, 2], np.empty((4, 0)), [-1.0, -2.0, 3.0, -0.5], [3])
    assert answer.chosen.tolist() == [1, 3] and answer.cost == -2.5 and answer.exact


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_one_sighting_in_all_tuples(frames):
    """Oracle: only the cheapest can be taken."""
    sightings = np.stack([np.zeros(30, int), *(np.arange(30) for _ in range(frames - 1))], axis=1)
    costs = np.random.default_rng(18).uniform(-5.0, -1.0, 30)
    answer = solve_assignment(np.arange(30), sightings, costs, [30, 1, *[30] * (frames - 1)])
    assert answer.chosen.tolist() == [costs.argmin()] and answer.exact


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_equal_costs_take_as_many_as_fit(frames):
    """Oracle: by hand: with every combination at -1, as many tuples as the shortest side has things."""
    parts = np.indices((4, *[3] * frames)).reshape(frames + 1, -1)
    answer = solve_assignment(parts[0], parts[1:].T, np.full(parts.shape[1], -1.0), [4, *[3] * frames])
    assert answer.exact and answer.cost == pytest.approx(-3.0) and len(answer.chosen) == 3


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_what_does_not_pay_is_dropped(frames):
    """Oracle: by hand: positive, zero and infinite costs are never better than leaving all unused."""
    sightings = np.zeros((4, frames), int)
    for costs in ([1.0, 2.0, 0.0, np.inf], [np.inf] * 4):
        answer = solve_assignment([0, 1, 2, -1], sightings, costs, [3, *[1] * frames])
        assert len(answer.chosen) == 0 and answer.cost == answer.bound == 0.0 and answer.dropped == 4
        assert answer.exact and answer.relative_gap == 0.0


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12, 1e80])
def test_scale_of_the_costs(scale):
    """Oracle: the same problem at its own scale: the same set, with the cost scaled."""
    for seed in range(10):
        rng = np.random.default_rng([19, seed])
        landmark, sightings, costs, counts = random_problem(rng, [6, 6, 6], 60)
        plain = solve_assignment(landmark, sightings, costs, counts)
        answer = solve_assignment(landmark, sightings, costs * scale, counts, tolerance=1e-6 * scale)
        assert answer.exact and answer.cost == pytest.approx(plain.cost * scale, rel=1e-6)


def test_same_tuple_many_times_is_taken_once():
    """Oracle: by hand: the cheapest copy wins, whatever lies beside it."""
    landmark, sightings = np.zeros(200, int), np.zeros((200, 2), int)
    costs = -1.0 - np.random.default_rng(20).permutation(200) / 200.0
    answer = solve_assignment(landmark, sightings, costs, [1, 1, 1])
    assert answer.chosen.tolist() == [costs.argmin()] and answer.exact


@pytest.mark.parametrize(
    "change",
    [
        {"costs": [-1.0, np.nan]},
        {"costs": [-np.inf, 1.0]},
        {"costs": [-1e101, 1.0]},
        {"costs": [-1.0]},
        {"costs": [[-1.0, 1.0]]},
        {"landmark": [0, 2]},
        {"landmark": [-2, 0]},
        {"landmark": [0]},
        {"landmark": [0.0, 1.5]},
        {"sightings": [[0, 0], [0, 3]]},
        {"sightings": [[0, 0], [-2, 0]]},
        {"sightings": [[0], [0]]},
        {"sightings": np.empty((0, 2))},
        {"sightings": [0, 0]},
        {"counts": [2, 3]},
        {"counts": []},
        {"counts": 2},
        {"counts": [2.0, 3.0, 3.0]},
        {"counts": [2, -3, 3]},
        {"unused": [[0.0] * 3]},
        {"unused": [[0.0] * 3, [0.0] * 2]},
        {"unused": [[0.0] * 3, [0.0, np.nan, 0.0]]},
        {"unused": [[0.0] * 3, [0.0, np.inf, 0.0]]},
        {"work": -1},
        {"nodes": -1},
        {"tolerance": -1.0},
        {"tolerance": np.nan},
    ],
)
def test_bad_problems_are_refused(change):
    """Oracle: an error that is both a KalmapError and a ValueError; the unchanged problem is fine."""
    problem = {"landmark": [0, 1], "sightings": [[0, 1], [1, -1]], "costs": [-1.0, -2.0], "counts": [2, 3, 3]}
    assert solve_assignment(**problem).cost == -3.0
    with pytest.raises(AssignmentError) as caught:
        solve_assignment(**(problem | change))
    assert isinstance(caught.value, KalmapError) and isinstance(caught.value, ValueError)
