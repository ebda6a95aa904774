"""Exact assignment over several frames by depth-first branch and bound on priced items.

With prices as in `relaxation`, a set of tuples costs the bound, plus the surplus (cost plus prices of its items,
>= 0) of each of its tuples, plus the price of each item it leaves out. The search adds these penalties item by
item and turns back where they reach what the best set known pays.
"""

import numpy as np

from kalmap.kernels.compiled import compiled

_ITEM, _NEXT, _END, _ALIVE = (
    0,
    1,
    2,
    3,
)  # a level: item branched on, next option, end of options, tuples alive
_ROUNDING = 1e-12  # share of the bound below which an improvement is rounding


@compiled
def _keep_possible(tuples, surplus, closed, rest, alive, count):
    """Move the tuples whose items are all open and whose surplus fits to the front of `alive`; how many."""
    kept = 0
    for k in range(count):
        t = alive[k]
        possible = surplus[t] < rest
        for s in range(tuples.shape[1]):
            possible = possible and (tuples[t, s] < 0 or not closed[tuples[t, s]])
        if possible:
            alive[k], alive[kept] = alive[kept], t
            kept += 1
    return kept


@compiled
def _survey(tuples, surplus, first, price, closed, rest, alive, count, uses, least):
    """What the open items must still pay at least, and the item to branch on (-1 if no tuple is left).

    An open item without tuples pays its price. Of the others, those of one side share no tuple, so each pays
    the cheaper of its price and its cheapest tuple; the side that pays most counts. uses, least: (items,) scratch.
    """
    uses[:] = 0
    least[:] = np.inf
    for k in range(count):
        for s in range(tuples.shape[1]):
            item = tuples[alive[k], s]
            if item >= 0:
                uses[item] += 1
                least[item] = min(least[item], surplus[alive[k]])
    forced, most, branch, fewest, dearest = 0.0, 0.0, -1, 0, 0.0
    for s in range(tuples.shape[1]):
        total = 0.0
        for item in range(first[s], first[s + 1]):
            if closed[item]:
                continue
            if uses[item] == 0:
                forced += price[item]
                continue
            cheapest = min(price[item], least[item])
            total += cheapest
            options = uses[item] + (price[item] < rest)
            if branch < 0 or options < fewest or (options == fewest and cheapest > dearest):
                branch, fewest, dearest = item, options, cheapest
        most = max(most, total)
    return forced, most, branch


@compiled
def _list_options(tuples, surplus, price, branch, alive, count, options, penalties, start):
    """Write the ways to settle an item from `start` on, cheapest first: its tuples, and -1 for none. The end."""
    end = start
    for k in range(-1, count):
        t, penalty = -1, price[branch]
        if k >= 0:
            t = alive[k]
            member = False
            for s in range(tuples.shape[1]):
                member = member or tuples[t, s] == branch
            if not member:
                continue
            penalty = surplus[t]
        place = end
        while place > start and penalties[place - 1] > penalty:
            options[place], penalties[place] = options[place - 1], penalties[place - 1]
            place -= 1
        options[place], penalties[place] = t, penalty
        end += 1
    return end


@compiled
def _set_closed(tuples, option, branch, closed, flag):
    """Close (or open again) the items that an option settles."""
    closed[branch] = flag
    if option >= 0:
        for s in range(tuples.shape[1]):
            if tuples[option, s] >= 0:
                closed[tuples[option, s]] = flag


@compiled
def _retreat(tuples, limit, options, penalties, stack, paid, closed, depth):
    """Go back to the deepest level with an option left that may pay; -1 if there is none."""
    while depth >= 0:
        place = stack[depth, _NEXT]
        if place < stack[depth, _END] and paid[depth] + penalties[place] < limit:
            break
        depth -= 1
        if depth >= 0:
            _set_closed(tuples, options[stack[depth, _NEXT] - 1], stack[depth, _ITEM], closed, False)
    return depth


@compiled
def _surplus(tuples, costs, price):
    """Cost of each tuple plus the prices of its items; below zero it is rounding and taken as zero."""
    surplus = costs.copy()
    for t in range(len(tuples)):
        for s in range(tuples.shape[1]):
            if tuples[t, s] >= 0:
                surplus[t] += price[tuples[t, s]]
        surplus[t] = max(0.0, surplus[t])
    return surplus


@compiled
def _record(options, stack, depth, taken):
    """Write the tuples on the way to this level into `taken`."""
    taken[:] = False
    for level in range(depth):
        option = options[stack[level, _NEXT] - 1]
        if option >= 0:
            taken[option] = True


@compiled
def branch_and_bound(tuples, costs, first, price, budget, taken, cost):
    """Find the cheapest set of tuples if it takes no more than `budget` nodes.

    price: (items,), prices that bound. taken (T,): a feasible set of cost `cost`, replaced by the best found.
    Returns (cost, whether it is proven least, nodes).
    """
    count, items = len(tuples), len(price)
    bound = -price.sum()
    rounding = -_ROUNDING * bound
    limit = cost - bound - rounding
    surplus = _surplus(tuples, costs, price)
    alive, closed = np.arange(count), np.zeros(items, np.bool_)
    options, penalties = np.empty(count + items, np.int64), np.empty(count + items)
    stack, paid = np.empty((items + 1, 4), np.int64), np.empty(items + 1)
    uses, least = np.empty(items, np.int64), np.empty(items)
    depth, nodes, start, living, sunk = 0, 0, 0, count, 0.0
    while nodes < budget:
        nodes += 1
        rest, end = limit - sunk, start
        living = _keep_possible(tuples, surplus, closed, rest, alive, living)
        forced, most, branch = _survey(
            tuples, surplus, first, price, closed, rest, alive, living, uses, least
        )
        if branch < 0 and forced < rest:
            limit = sunk + forced - rounding
            _record(options, stack, depth, taken)
        elif branch >= 0 and forced + most < rest:
            end = _list_options(tuples, surplus, price, branch, alive, living, options, penalties, start)
        stack[depth, _ITEM], stack[depth, _NEXT] = branch, start
        stack[depth, _END], stack[depth, _ALIVE] = end, living
        paid[depth] = sunk
        depth = _retreat(tuples, limit, options, penalties, stack, paid, closed, depth)
        if depth < 0:
            return costs[taken].sum(), True, nodes
        place = stack[depth, _NEXT]
        stack[depth, _NEXT] += 1
        sunk = paid[depth] + penalties[place]
        _set_closed(tuples, options[place], stack[depth, _ITEM], closed, True)
        start, living = stack[depth, _END], stack[depth, _ALIVE]
        depth += 1
    return costs[taken].sum(), False, nodes
