"""Assignment over several frames at once: which landmark and which sightings of each frame are one thing.

The problem of multidimensional assignment association (Wijesoma, Perera & Adams 2006, IEEE T-RO 22(2)): of
scored tuples (landmark, sighting of frame 1, ..., sighting of frame F), any of which may be absent, choose a
set of least total cost that uses no landmark and no sighting twice. Solved per connected component, by
branch and bound and by Lagrangian relaxation (Deb, Yeddanapudi, Pattipati & Bar-Shalom 1997), with the gap to
a lower bound reported.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from kalmap.kernels.assignment import components, solve_components
from kalmap.records import KalmapError

_LARGEST = 1e100  # costs beyond it would lose all others in their sum


class AssignmentError(KalmapError, ValueError):
    """An assignment problem that cannot be read: a shape, an index or a cost is wrong."""


class Assigned(msgspec.Struct, frozen=True):
    """A set of tuples, and how good it is known to be.

    chosen: (K,) rows of the problem's tuples, ascending. cost: theirs, plus the prices of what stays unused.
    bound: no set costs less. gap: cost - bound, >= 0. relative_gap: the gap as a share of what the set saves
    against using nothing. exact: the gap is within the tolerance. dropped: tuples that are no cheaper than
    leaving their parts unused. components: parts that were solved apart; unproven: those with a gap above
    their share of the tolerance. iterations, nodes: relaxation steps and search nodes, over all parts.
    """

    chosen: np.ndarray
    cost: float
    bound: float
    gap: float
    relative_gap: float
    exact: bool
    dropped: int
    components: int
    unproven: int
    iterations: int
    nodes: int


def solve_assignment(
    landmark: np.ndarray,
    sightings: np.ndarray,
    costs: np.ndarray,
    counts: Sequence[int],
    *,
    unused: Sequence[np.ndarray] | None = None,
    work: int = 300,
    nodes: int = 20_000,
    tolerance: float = 1e-6,
) -> Assigned:
    """Choose the tuples of least total cost that use no landmark and no sighting twice.

    landmark: (T,) index of each tuple's landmark, -1 for none. sightings: (T, F) index of its sighting in
    each frame, -1 for none. costs: (T,), negative log-likelihood ratios of any sign; inf: not possible.
    counts: (1 + F,) how many landmarks there are, and sightings in each frame. unused: for each frame (M_f,)
    what a sighting costs that no chosen tuple uses; 0 if not given. work, nodes: limits on relaxation steps
    and on search nodes in each connected part. tolerance: absolute gap that counts as none.

    Among equally cheap sets any may be chosen; which one can depend on the order of the tuples.
    Raises AssignmentError for NaN or -inf, for an index out of range and for lengths that do not fit.
    """
    items, first, costs = _checked(landmark, sightings, costs, counts)
    if not (work >= 0 and nodes >= 0 and tolerance >= 0.0):
        raise AssignmentError(f"limits of 0 or more are needed, not {work}, {nodes} and {tolerance}")
    base = 0.0
    if unused is not None:
        prices = _checked_prices(unused, counts)
        costs = costs - prices[items].sum(axis=1)
        base = float(prices.sum())
    total, kept = len(costs), np.flatnonzero(costs < 0.0)
    items, costs, chosen = items[kept], costs[kept], np.zeros(len(kept), dtype=np.bool_)
    if items.shape[1] == 2:
        saved, parts = _solve_frame(items, costs, int(first[-1]), chosen)
        bound, unproven, iterations, searched = saved, 0, 0, 0
    else:
        saved, bound, parts, unproven, iterations, searched = solve_components(
            items, costs, int(first[-1]), int(work), int(nodes), float(tolerance), chosen
        )
    gap = max(0.0, saved - bound)
    return Assigned(
        chosen=kept[chosen],
        cost=base + saved,
        bound=base + saved - gap,
        gap=gap,
        relative_gap=gap / -saved if gap > 0.0 else 0.0,
        exact=unproven == 0,
        dropped=total - len(kept),
        components=parts,
        unproven=unproven,
        iterations=iterations,
        nodes=searched,
    )


def _checked(
    landmark: np.ndarray, sightings: np.ndarray, costs: np.ndarray, counts: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Item numbers (T, 1 + F), where each side's items begin (2 + F,), and costs.

    A problem without frames gets an empty one. Raises AssignmentError.
    """
    sides = np.asarray(counts)
    if sides.ndim != 1 or len(sides) == 0 or sides.dtype.kind not in "iu" or np.any(sides < 0):
        raise AssignmentError(f"counts of landmarks and of each frame's sightings are needed, not {counts}")
    landmark, sightings = np.asarray(landmark), np.asarray(sightings)
    costs = np.asarray(costs, dtype=np.float64)
    count, frames = costs.size, len(sides) - 1
    if sightings.size == 0 and count * frames == 0:
        sightings = np.zeros((count, frames), dtype=np.int64)
    if costs.ndim != 1 or landmark.shape != costs.shape or sightings.shape != (count, frames):
        raise AssignmentError(
            f"landmarks {landmark.shape}, sightings {sightings.shape} and costs {costs.shape} do not fit"
            f" each other and {frames} frames"
        )
    parts = np.concatenate([landmark[:, None], sightings], axis=1)
    if count and (parts.dtype.kind not in "iu" or np.any(parts < -1) or np.any(parts >= sides)):
        raise AssignmentError(
            "an index of a landmark or sighting is not an integer from -1 to its count less 1"
        )
    bad = np.flatnonzero(~(costs >= -_LARGEST))  # NaN compares false and is caught too
    if len(bad):
        raise AssignmentError(
            f"tuple {bad[0]} costs {costs[bad[0]]}; a number, or inf for impossible, is needed"
        )
    if len(sides) == 1:
        sides, parts = np.append(sides, 0), np.insert(parts, 1, -1, axis=1)
    first = np.concatenate([[0], np.cumsum(sides)]).astype(np.int64)
    return np.where(parts < 0, -1, parts + first[:-1]).astype(np.int64), first, costs


def _checked_prices(unused: Sequence[np.ndarray], counts: Sequence[int]) -> np.ndarray:
    """What each item costs unused, landmarks 0, in the order of the item numbers, and a 0 for item -1.

    Raises AssignmentError.
    """
    frames = [np.asarray(each, dtype=np.float64).reshape(-1) for each in unused]
    lengths = [len(each) for each in frames]
    if lengths != list(counts)[1:]:
        raise AssignmentError(f"unused prices of {lengths} sightings do not fit the counts {counts}")
    prices = np.concatenate([np.zeros(counts[0]), *frames, [0.0]])
    if not np.all(np.abs(prices) <= _LARGEST):
        raise AssignmentError("a price of leaving a sighting unused is not finite")
    return prices


def _solve_frame(items: np.ndarray, costs: np.ndarray, count: int, chosen: np.ndarray) -> tuple[float, int]:
    """One frame: lone tuples are taken, the rest is a two-dimensional assignment. Cost and components."""
    order, starts = components(items, count)
    sizes = np.diff(starts)
    crowded = np.repeat(sizes > 1, sizes)
    chosen[order[~crowded]] = True
    if np.any(crowded):
        chosen[_match_frame(items, costs, order[crowded])] = True
    return float(costs[chosen].sum()), len(sizes)


def _match_frame(items: np.ndarray, costs: np.ndarray, members: np.ndarray) -> np.ndarray:
    """The cheapest set among the members, tuples of a landmark and a sighting or of one of them."""
    from scipy.optimize import linear_sum_assignment

    members = members[np.argsort(-costs[members], kind="stable")]
    sides = [np.unique(items[members, s][items[members, s] >= 0]) for s in (0, 1)]
    place = [
        np.where(items[members, s] < 0, len(each), np.searchsorted(each, items[members, s]))
        for s, each in enumerate(sides)
    ]
    # Of tuples in the same place the last one written stays: the cheapest.
    cheapest = np.full((len(sides[0]) + 1, len(sides[1]) + 1), -1, dtype=np.int64)
    cheapest[place[0], place[1]] = members
    value = np.where(cheapest >= 0, costs[cheapest], 0.0)
    gain = np.minimum(value[:-1, :-1] - value[:-1, -1:] - value[-1:, :-1], 0.0)
    gain[cheapest[:-1, :-1] < 0] = 0.0
    rows, columns = linear_sum_assignment(gain)
    pairs = gain[rows, columns] < 0.0
    rows, columns = rows[pairs], columns[pairs]
    together = cheapest[rows, columns]
    alone = np.concatenate([np.delete(cheapest[:-1, -1], rows), np.delete(cheapest[-1, :-1], columns)])
    return np.concatenate([together, alone[alone >= 0]])
