"""Lagrangian relaxation of an assignment over several frames (Deb, Yeddanapudi, Pattipati & Bar-Shalom 1997).

A tuple is a row of item numbers, one a side (side 0 landmarks, side f the sightings of frame f), -1 where it
has none; items are numbered side by side, `first[s]` to `first[s + 1]`. A set of tuples is feasible if no item
is in two of them. Every item has a price >= 0; where the prices of a tuple's items add up to at least minus
its cost, for every tuple, minus the sum of all prices is a lower bound of the least cost.
"""

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.matching import match_or_leave

_PATIENCE = 10  # iterations without a better bound before the step is halved
_PROGRESS = 0.01  # share of the gap by which a bound has to be better to count
_PASSES = 50  # over all tuples by an exchange; a handful is usual
_ROUNDING = 1e-12  # share of a cost below which a change is rounding
_SMALLEST_STEP = 1e-3  # share of the Polyak step at which the multipliers are taken to have converged


@compiled
def share_prices(tuples, costs, price):
    """Prices that bound, at once: every tuple shares its gain evenly, then each side in turn gives slack back."""
    count, sides = tuples.shape
    price[:] = 0.0
    for t in range(count):
        items = 0
        for s in range(sides):
            items += tuples[t, s] >= 0
        for s in range(sides):
            if tuples[t, s] >= 0:
                price[tuples[t, s]] = max(price[tuples[t, s]], -costs[t] / items)
    slack = np.full(len(price), np.inf)
    for side in range(sides):
        for t in range(count):
            if tuples[t, side] >= 0:
                total = costs[t]
                for s in range(sides):
                    if tuples[t, s] >= 0:
                        total += price[tuples[t, s]]
                slack[tuples[t, side]] = min(slack[tuples[t, side]], total)
        for t in range(count):
            item = tuples[t, side]
            if item >= 0 and slack[item] > 0.0:
                price[item], slack[item] = max(0.0, price[item] - slack[item]), 0.0


@compiled
def _lift(tuples, costs, price):
    """Raise the prices in each tuple without landmark and first sighting, evenly, until it pays.

    A raise costs the bound what the tuple gives back, so the bound does not fall; and it is the projection on
    the prices that this tuple allows, so the multipliers still converge.
    """
    for t in range(len(tuples)):
        if tuples[t, 0] >= 0 or tuples[t, 1] >= 0:
            continue
        total, items = costs[t], 0
        for s in range(2, tuples.shape[1]):
            if tuples[t, s] >= 0:
                total += price[tuples[t, s]]
                items += 1
        if total < 0.0:
            for s in range(2, tuples.shape[1]):
                if tuples[t, s] >= 0:
                    price[tuples[t, s]] -= total / items


@compiled
def _fill_values(tuples, costs, first, price, group, groups, side, values, cheapest):
    """Cost of each group of earlier items with each item of this side: the cheapest tuple inside the two.

    values, cheapest: (groups + 1, items of this side + 1). A tuple may use a part of its group. Items of
    later sides count with their prices.
    """
    for r in range(groups + 1):
        for c in range(values.shape[1]):
            alone = r == groups or c == values.shape[1] - 1
            values[r, c], cheapest[r, c] = 0.0 if alone else np.inf, -1
    for t in range(len(tuples)):
        row, together = groups, True
        for s in range(side):
            item = tuples[t, s]
            if item >= 0:
                together = together and (row == groups or row == group[item])
                row = group[item]
        if not together:
            continue
        item = tuples[t, side]
        column = values.shape[1] - 1 if item < 0 else item - first[side]
        if row == groups and item < 0:
            continue
        total = costs[t]
        for s in range(side + 1, tuples.shape[1]):
            if tuples[t, s] >= 0:
                total += price[tuples[t, s]]
        if total < values[row, column]:
            values[row, column], cheapest[row, column] = total, t


@compiled
def _join_side(tuples, costs, first, price, group, groups, side, taken):
    """Match the groups of earlier items with the items of one side, exactly; `taken` gets the tuples that do.

    Groups grow by their matches and new ones are opened by items left alone. Prices of the groups' items
    are written where a group is one item (side 1). Returns the number of groups.
    """
    width = first[side + 1] - first[side]
    values = np.empty((groups + 1, width + 1))
    cheapest = np.empty((groups + 1, width + 1), np.int64)
    _fill_values(tuples, costs, first, price, group, groups, side, values, cheapest)
    partner, row_price, column_price = np.empty(groups, np.int64), np.empty(groups), np.empty(width)
    match_or_leave(values, partner, row_price, column_price)
    if side == 1:
        price[: first[1]] = row_price
        price[first[1] : first[2]] = column_price
    taken[:] = False
    group[first[side] : first[side + 1]] = -1
    for r in range(groups):
        c = width if partner[r] < 0 else partner[r]
        if cheapest[r, c] >= 0:
            taken[cheapest[r, c]] = True
        if c < width:
            group[first[side] + c] = r
    for c in range(width):
        if group[first[side] + c] < 0:
            if cheapest[groups, c] >= 0:
                taken[cheapest[groups, c]] = True
            group[first[side] + c] = groups + c
    return groups + width


@compiled
def exchange(tuples, costs, taken):
    """Take any tuple that is cheaper than those it pushes out, until there is none. Returns the cost."""
    owner = np.full(tuples.max() + 1, -1, np.int64)
    total = 0.0
    for t in range(len(tuples)):
        if taken[t]:
            total += costs[t]
            _set_owner(tuples, owner, t, t)
    for _ in range(_PASSES):
        changed = False
        for t in range(len(tuples)):
            if taken[t]:
                continue
            change = costs[t]
            for s in range(tuples.shape[1]):
                other = owner[tuples[t, s]] if tuples[t, s] >= 0 else -1
                for earlier in range(s):  # one that shares several items is pushed out once
                    if tuples[t, earlier] >= 0 and owner[tuples[t, earlier]] == other:
                        other = -1
                if other >= 0:
                    change -= costs[other]
            if change < _ROUNDING * total:
                for s in range(tuples.shape[1]):
                    other = owner[tuples[t, s]] if tuples[t, s] >= 0 else -1
                    if other >= 0:
                        taken[other] = False
                        _set_owner(tuples, owner, other, -1)
                taken[t] = True
                _set_owner(tuples, owner, t, t)
                total += change
                changed = True
        if not changed:
            break
    return costs[taken].sum()


@compiled
def _set_owner(tuples, owner, t, holder):
    """Write who holds the items of tuple t: itself, or -1 for nobody."""
    for s in range(tuples.shape[1]):
        if tuples[t, s] >= 0:
            owner[tuples[t, s]] = holder


@compiled
def _slopes(tuples, first, taken, price, slope):
    """How the bound changes with each multiplier: uses by the relaxed solution minus one. Returns the square.

    A multiplier at zero that would fall stands still.
    """
    slope[:] = -1.0
    for t in range(len(tuples)):
        if taken[t]:
            for s in range(2, tuples.shape[1]):
                if tuples[t, s] >= 0:
                    slope[tuples[t, s]] += 1.0
    square = 0.0
    for item in range(first[2], len(price)):
        if price[item] <= 0.0 and slope[item] < 0.0:
            slope[item] = 0.0
        square += slope[item] ** 2
    return square


@compiled
def relax(tuples, costs, first, work, tolerance, best_price, best_taken, best_cost):
    """Bound and improve a set of tuples by at most `work` subgradient steps with Polyak's length.

    best_price (items,) must hold prices that bound, best_taken (T,) a feasible set of cost `best_cost`; both
    are replaced by better ones. Returns (bound, cost, iterations).
    """
    items = len(best_price)
    bound, step, stale, iterations = -best_price.sum(), 1.0, 0, 0
    price, slope = best_price.copy(), np.empty(items)
    relaxed, taken = np.empty(len(tuples), np.bool_), np.empty(len(tuples), np.bool_)
    group = np.empty(items, np.int64)
    group[: first[1]] = np.arange(first[1])
    while iterations < work and best_cost - bound > tolerance and step > _SMALLEST_STEP:
        iterations += 1
        stale += 1
        _lift(tuples, costs, price)
        groups = _join_side(tuples, costs, first, price, group, first[1], 1, relaxed)
        value = -price.sum()
        if value > bound + _PROGRESS * (best_cost - bound):
            stale = 0
        if value > bound:
            bound = value
            best_price[:] = price
        taken[:] = relaxed
        for side in range(2, tuples.shape[1]):
            groups = _join_side(tuples, costs, first, price, group, groups, side, taken)
        cost = exchange(tuples, costs, taken)
        if cost < best_cost:
            best_cost = cost
            best_taken[:] = taken
        square = _slopes(tuples, first, relaxed, price, slope)
        if square == 0.0:
            break
        if stale >= _PATIENCE:
            step, stale = 0.5 * step, 0
        length = step * max(best_cost - value, 0.0) / square
        for item in range(first[2], items):
            price[item] = max(0.0, price[item] + length * slope[item])
    return bound, best_cost, iterations
