"""Least-cost sets of tuples that share no item: connected components, and each solved as well as it needs."""

import numpy as np

from kalmap.kernels.branching import branch_and_bound
from kalmap.kernels.compiled import compiled
from kalmap.kernels.relaxation import exchange, relax, share_prices

_SMALL = 32  # tuples up to which a component is searched before it is relaxed
_STEPS = (0, 20)  # relaxation steps of the first rounds, in all
_NODES = (300, 300)  # search nodes of each
_ROUNDING = 1e-12  # share of the bound below which a gap is rounding


@compiled
def _root(parent, item):
    """The item that stands for a component; halves the path on the way."""
    while parent[item] != item:
        parent[item] = parent[parent[item]]
        item = parent[item]
    return item


@compiled
def components(tuples, items):
    """Group tuples (T, S) of item numbers (-1 none) that share an item, directly or through others.

    Returns order (T,), the tuples component by component, and starts (C + 1,) where each begins in it.
    """
    count, sides = tuples.shape
    parent = np.arange(items + count)  # the last ones stand for the tuples, which may have no item
    for t in range(count):
        for s in range(sides):
            if tuples[t, s] >= 0:
                parent[_root(parent, tuples[t, s])] = _root(parent, items + t)
    number, label = np.full(items + count, -1, np.int64), np.empty(count, np.int64)
    found = 0
    for t in range(count):
        root = _root(parent, items + t)
        if number[root] < 0:
            number[root] = found
            found += 1
        label[t] = number[root]
    starts, order = np.zeros(found + 1, np.int64), np.empty(count, np.int64)
    for t in range(count):
        starts[label[t] + 1] += 1
    for c in range(found):
        starts[c + 1] += starts[c]
    place = starts.copy()
    for t in range(count):
        order[place[label[t]]] = t
        place[label[t]] += 1
    return order, starts


@compiled
def _renumber(tuples, members, number, local, first):
    """Write the members' items, numbered side by side from 0, into local (k, S) and first (S + 1,).

    number: (items,) all -1, and left so.
    """
    fresh = 0
    for s in range(tuples.shape[1]):
        first[s] = fresh
        for k in range(len(members)):
            item = tuples[members[k], s]
            if item >= 0 and number[item] < 0:
                number[item] = fresh
                fresh += 1
            local[k, s] = -1 if item < 0 else number[item]
    first[tuples.shape[1]] = fresh
    for k in range(len(members)):
        for s in range(tuples.shape[1]):
            if tuples[members[k], s] >= 0:
                number[tuples[members[k], s]] = -1


@compiled
def _solve_one(tuples, costs, first, work, budget, tolerance, taken):
    """One component: relaxation and search in rounds of growing effort, the first without relaxation.

    Returns (cost, bound, iterations, nodes); taken (k,) gets the set.
    """
    taken[:] = False
    price = np.empty(first[-1])
    share_prices(tuples, costs, price)
    rounding = _ROUNDING * price.sum()
    cost, bound, iterations, nodes = exchange(tuples, costs, taken), -price.sum(), 0, 0
    for effort in range(0 if len(tuples) <= _SMALL else 1, 3):
        steps = work if effort == 2 else min(work, _STEPS[effort])
        bound, cost, more = relax(
            tuples, costs, first, steps - iterations, max(tolerance, rounding), price, taken, cost
        )
        iterations += more
        if cost - bound <= max(tolerance, rounding):
            break
        spend = min(budget - nodes, budget if effort == 2 else _NODES[effort])
        if spend > 0:
            cost, proven, more = branch_and_bound(tuples, costs, first, price, spend, taken, cost)
            nodes += more
            if proven:
                return cost, cost, iterations, nodes
    return cost, cost if cost - bound <= rounding else bound, iterations, nodes


@compiled
def solve_components(tuples, costs, items, work, budget, tolerance, chosen):
    """Choose tuples (T, S) of item numbers (-1 none) and negative costs (T,) that share no item; chosen (T,).

    Returns (cost, bound, components, open components, iterations, nodes).
    """
    order, starts = components(tuples, items)
    found, sides = len(starts) - 1, tuples.shape[1]
    number, first = np.full(items, -1, np.int64), np.empty(sides + 1, np.int64)
    total, total_bound, open_ones, iterations, nodes = 0.0, 0.0, 0, 0, 0
    for c in range(found):
        members = order[starts[c] : starts[c + 1]]
        if len(members) == 1:
            chosen[members[0]] = True
            total += costs[members[0]]
            total_bound += costs[members[0]]
            continue
        local, taken = np.empty((len(members), sides), np.int64), np.empty(len(members), np.bool_)
        _renumber(tuples, members, number, local, first)
        cost, bound, steps, searched = _solve_one(
            local, costs[members], first, work, budget, tolerance / found, taken
        )
        for k in range(len(members)):
            chosen[members[k]] = taken[k]
        total += cost
        total_bound += bound
        open_ones += cost - bound > tolerance / found
        iterations += steps
        nodes += searched
    return total, total_bound, found, open_ones, iterations, nodes
