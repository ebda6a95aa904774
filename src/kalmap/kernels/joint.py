"""Joint compatibility branch and bound (Neira & Tardos 2001): the largest jointly compatible set of pairs.

The answer does not depend on the order of the tests: of all one-to-one sets of individually compatible pairs whose
joint distance squared D^2 is within the gate for their number, it is the one with the most pairs, and of those the
one of least D^2. Adding a pair never lowers D^2, but the gate grows with the number of pairs: a set outside its
own gate may be part of one inside, so only what `reach` proves impossible is left out.

The sighting with the fewest candidates left is decided next; of equals, the one whose nearest candidate adds most.
Its candidates are tried nearest first, each given the pairs so far, and at last none. A dive that begins with a wrong
pair may take long to climb out of; so a search that takes long is handed, once, the best of greedy sets that begin
with other pairs. The optimum is what it is, but it is proven sooner, and the best set known at the end of the work is
a good one.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.conditional import add_pair, added_distance, unconditioned
from kalmap.kernels.layout import INNOVATION_NOT_POSITIVE, OK
from kalmap.kernels.reach import EXHAUSTED, FAILED, MATCHING_SIZE, bound, reach

_PATIENCE, _BEGINNINGS = 500, 32  # nodes before other beginnings are tried, and how many

_SIGHTING, _UNDECIDED, _PAIRS, _NEXT, _COUNT, _TOP, _LEVEL_SIZE = 0, 1, 2, 3, 4, 5, 6


@compiled
def joint_compatibility(nu, cross, noises, squared, gate, joint_gate, work, matched):
    """Write the candidate of each sighting, or -1, into `matched` (M,).

    nu: (M, C, 2) innovations; a pair whose nu or `squared` is not finite is impossible. cross: (C, C, 2, 2)
    covariances of the candidates' predicted sightings. noises: (M, 2, 2). squared: (M, C) individual distances
    squared, `gate` their bound; a gate of 0 lets nothing in. joint_gate: (M + 1,) bounds of the joint distance
    squared of k pairs, not falling. work: how many sets to look beyond, at most.

    Returns (status, pairs, joint distance squared, sets looked beyond, whether none was left out). If some were,
    the answer is the best set found, never worse than the greedy one of `_in_turn`.
    """
    problem, state = (nu, cross, noises), unconditioned(cross, min(squared.shape))
    rest = _remaining(nu, squared, gate)
    matched[:] = -1
    pairs = _in_turn(problem, state, rest, joint_gate, matched)
    if pairs == FAILED:
        return INNOVATION_NOT_POSITIVE, 0, 0.0, 0, False
    rest[3][:] = False
    return _search(problem, state, rest, squared, gate, joint_gate, work, pairs, matched)


@compiled
def extend_jointly(nu, cross, noises, squared, gate, joint_gate, matched):
    """Add pairs to those in `matched` (M,): of all free ones the nearest given the pairs so far, then the next.

    That is the one which adds least to the joint distance; the end is where it would leave the gate of the set.
    Arguments as for `joint_compatibility`. Returns (status, pairs, joint distance squared).
    """
    given, total = unconditioned(cross, min(squared.shape))
    rows, candidates, live, used = _remaining(nu, squared, gate)
    k = 0
    for m in range(len(matched)):
        if matched[m] >= 0:
            if add_pair(nu, cross, noises, given, total, k, m, matched[m]) != OK:
                return INNOVATION_NOT_POSITIVE, 0, 0.0
            used[matched[m]] = True
            k += 1
    while k + 1 < len(total):
        least, chosen, best = np.inf, -1, -1
        for m in rows:
            if matched[m] >= 0:
                continue
            added, c = _nearest(nu, noises, given, k, m, candidates[m, : live[m]], used)
            if c == FAILED:
                return INNOVATION_NOT_POSITIVE, 0, 0.0
            if added < least:
                least, chosen, best = added, m, c
        if chosen < 0 or not total[k] + least <= joint_gate[k + 1]:
            break
        add_pair(nu, cross, noises, given, total, k, chosen, best)
        used[best], matched[chosen] = True, best
        k += 1
    return OK, k, total[k]


@compiled
def _remaining(nu, squared, gate):
    """(rows, candidates, live, used): what is still to be decided, and (C,) bool, which candidates are taken.

    rows: the sightings with candidates, fewest first. candidates: (M, C), of which the first live[m] of row m
    count. One is dropped by a swap with the last of them, so that putting the old number back into `live` restores
    what was there, whatever happened in between.
    """
    sightings, count = squared.shape
    rows, candidates = np.empty(sightings, np.int64), np.empty((sightings, count), np.int64)
    live, undecided = np.zeros(sightings, np.int64), 0
    for m in range(sightings):
        for c in range(count):
            finite = math.isfinite(squared[m, c] + nu[m, c, 0] + nu[m, c, 1])
            if finite and squared[m, c] <= gate and gate > 0.0:
                candidates[m, live[m]] = c
                live[m] += 1
        if live[m] > 0:
            i = undecided
            while i > 0 and live[rows[i - 1]] > live[m]:
                rows[i] = rows[i - 1]
                i -= 1
            rows[i] = m
            undecided += 1
    return rows[:undecided], candidates, live, np.zeros(count, np.bool_)


@compiled
def _nearest(nu, noises, given, k, m, candidates, used):
    """(what it adds to k pairs, which) of sighting m's nearest free candidate; (inf, -1): none; (inf, FAILED)."""
    least, best = np.inf, -1
    for c in candidates:
        if used[c]:
            continue
        added = added_distance(nu, noises, given, k, m, c)
        if added < 0.0:
            return np.inf, FAILED
        if added < least:
            least, best = added, c
    return least, best


@compiled
def _in_turn(problem, state, rest, joint_gate, matched):
    """Sequential compatibility: the sightings take turns, those with the fewest candidates first.

    Each gets the free candidate that adds least to the joint distance, if the set stays inside its gate. Writes
    `matched`; returns the number of pairs, or FAILED.
    """
    nu, cross, noises = problem
    given, total = state
    rows, candidates, live, used = rest
    k = 0
    for m in rows:
        if k + 1 == len(total):
            break
        least, best = _nearest(nu, noises, given, k, m, candidates[m, : live[m]], used)
        if best == FAILED:
            return FAILED
        if best >= 0 and total[k] + least <= joint_gate[k + 1]:
            add_pair(nu, cross, noises, given, total, k, m, best)
            k += 1
            used[best], matched[m] = True, best
    return k


@compiled
def _begin_anew(problem, squared, gate, joint_gate, best_pairs, best_squared, matched):
    """Look for a better set than `matched` by `extend_jointly` from one pair, those of the choosiest sightings first.

    Returns the best number of pairs and distance squared. A beginning whose covariance has no root is passed over.
    """
    nu, cross, noises = problem
    rows, candidates, live, _ = _remaining(nu, squared, gate)
    trial, tried = np.empty_like(matched), 0
    for m in rows:
        for c in candidates[m, : live[m]]:
            if tried == _BEGINNINGS:
                return best_pairs, best_squared
            tried += 1
            trial[:] = -1
            trial[m] = c
            status, pairs, distance = extend_jointly(nu, cross, noises, squared, gate, joint_gate, trial)
            more = pairs > best_pairs or (pairs == best_pairs and distance < best_squared)
            if status == OK and more and distance <= joint_gate[pairs]:
                best_pairs, best_squared = pairs, distance
                matched[:] = trial
    return best_pairs, best_squared


@compiled
def _search(problem, state, rest, squared, gate, joint_gate, work, best_pairs, matched):
    """Depth first from no pairs; `matched` holds a set of best_pairs pairs, which the state holds too."""
    sightings, count = rest[1].shape
    levels, saved = np.empty((sightings, _LEVEL_SIZE), np.int64), np.empty((sightings, sightings), np.int64)
    children, added = np.empty((sightings, count), np.int64), np.empty((sightings, count))
    stack = levels, children, added, saved
    scratch = np.empty((sightings, count)), np.empty((MATCHING_SIZE, max(sightings, count)), np.int64)
    current, total = np.full(sightings, -1), state[1]
    best_squared, nodes, level, pairs, undecided = total[best_pairs], 0, -1, 0, len(rest[0])
    while undecided > 0 or level >= 0:
        if nodes >= work:
            return OK, best_pairs, best_squared, nodes, False
        if nodes == _PATIENCE:
            best_pairs, best_squared = _begin_anew(
                problem, squared, gate, joint_gate, best_pairs, best_squared, matched
            )
        nodes += 1
        top = reach(problem, state, rest, scratch, pairs, undecided, best_pairs, best_squared, joint_gate)
        if top == FAILED:
            return INNOVATION_NOT_POSITIVE, 0, 0.0, nodes, False
        if top != EXHAUSTED:
            level += 1
            _branch(rest, stack, scratch[0], level, pairs, undecided, top)
        pairs = EXHAUSTED
        while level >= 0 and pairs == EXHAUSTED:
            most = bound(levels[level, _TOP], best_pairs, best_squared, joint_gate)
            pairs = _advance(problem, state, rest, stack, current, level, most)
            level -= pairs == EXHAUSTED
        if level < 0:
            break
        if pairs == FAILED:
            return INNOVATION_NOT_POSITIVE, 0, 0.0, nodes, False
        undecided = levels[level, _UNDECIDED]
        more = pairs > best_pairs or (pairs == best_pairs and total[pairs] < best_squared)
        if more and total[pairs] <= joint_gate[pairs]:
            best_pairs, best_squared = pairs, total[pairs]
            matched[:] = current
    return OK, best_pairs, best_squared, nodes, True


@compiled
def _branch(rest, stack, distance, level, pairs, undecided, top):
    """Open a level: choose the sighting to decide, move it to the end of the undecided, sort its candidates."""
    rows, candidates, live = rest[:3]
    levels, children, added, saved = stack
    chosen, fewest, farthest = -1, 0, 0.0
    for r in range(undecided):
        m = rows[r]
        saved[level, m] = live[m]
        if live[m] == 0 or (chosen >= 0 and live[m] > fewest):
            continue
        nearest = np.inf
        for c in candidates[m, : live[m]]:
            nearest = min(nearest, distance[m, c])
        if chosen < 0 or live[m] < fewest or nearest > farthest:
            chosen, fewest, farthest = r, live[m], nearest
    m = rows[chosen]
    rows[chosen], rows[undecided - 1] = rows[undecided - 1], m
    levels[level, _SIGHTING], levels[level, _UNDECIDED], levels[level, _PAIRS] = m, undecided - 1, pairs
    levels[level, _NEXT], levels[level, _COUNT], levels[level, _TOP] = 0, fewest, top
    for i in range(fewest):
        c = candidates[m, i]
        while i > 0 and added[level, i - 1] > distance[m, c]:
            added[level, i], children[level, i] = added[level, i - 1], children[level, i - 1]
            i -= 1
        added[level, i], children[level, i] = distance[m, c], c


@compiled
def _advance(problem, state, rest, stack, current, level, most):
    """Go to a level's next set: its sighting with the next nearest candidate, at last with none.

    most: bound on D^2 with the candidate. Returns the number of pairs, EXHAUSTED or FAILED.
    """
    nu, cross, noises = problem
    given, total = state
    rows, _, live, used = rest
    levels, children, added, saved = stack
    m, k = levels[level, _SIGHTING], levels[level, _PAIRS]
    i, count = levels[level, _NEXT], levels[level, _COUNT]
    if current[m] >= 0:
        used[current[m]] = False
        current[m] = -1
    if i > count:
        return EXHAUSTED
    if i < count and not total[k] + added[level, i] <= most:
        i = count  # those that follow add more
    levels[level, _NEXT] = i + 1
    for r in range(levels[level, _UNDECIDED]):
        live[rows[r]] = saved[level, rows[r]]
    if i == count:
        return k
    c = children[level, i]
    if add_pair(nu, cross, noises, given, total, k, m, c) != OK:
        return FAILED
    used[c], current[m] = True, c
    return k + 1
