"""Which pairs can still be part of a better set: the bounds of the joint compatibility search.

Two facts hold for every set that goes on from the k pairs chosen so far:

- If it holds a pair p, its D^2 is at least that of the chosen pairs and p together: adding a pair never lowers D^2.
  Where that is beyond the gate for the largest number still in reach, p can be dropped; where that number only
  equals the best known, so it can if that is not below the best D^2.
- It has at most as many more pairs as a maximum matching of sightings and candidates over the pairs that are left.

A smaller number in reach has a tighter gate, which drops more pairs, and so on until nothing changes. When the
number only equals the best known this is the bottleneck bound: r more pairs cost at least the least t such that r
can be matched among the pairs that add no more than t. The sum of what they add one by one would be no bound: they
share the robot's error, and one pair can explain the next.
"""

from kalmap.kernels.compiled import compiled
from kalmap.kernels.conditional import added_distance
from kalmap.kernels.layout import INNOVATION_NOT_POSITIVE, OK

FAILED, EXHAUSTED = -2, -1
MATCHING_SIZE = 5  # rows of scratch for `most_pairs`

_GATE_SLACK = 1e-9  # a bound must not cut off by rounding what the exact test would take
_TIE = 1e-12  # sets whose D^2 differ by less than this share are equally good

_OF_SIGHTING, _OF_CANDIDATE, _FROM, _SEEN, _QUEUE = 0, 1, 2, 3, 4


@compiled
def bound(pairs, best_pairs, best_squared, joint_gate):
    """What D^2 of a set of so many pairs may be, if it is to be better than the best known."""
    if pairs > best_pairs:
        return joint_gate[pairs] * (1.0 + _GATE_SLACK)
    if pairs == best_pairs:
        return best_squared * (1.0 - _TIE) - 1e-300  # below it also where the best is 0
    return -1.0


@compiled
def reach(problem, state, rest, scratch, k, undecided, best_pairs, best_squared, joint_gate):
    """Most pairs that a better set around the k chosen ones can have, or EXHAUSTED; drops what no such set holds."""
    rows, _, live = rest[:3]
    distance, matching = scratch
    squared, top = state[1][k], k
    for r in range(undecided):
        top += live[rows[r]] > 0
    if top == k or not squared <= bound(top, best_pairs, best_squared, joint_gate):
        return EXHAUSTED
    if _measure(problem, state, rest, distance, k, undecided) != OK:
        return FAILED
    while True:
        most = bound(top, best_pairs, best_squared, joint_gate) - squared
        if not most >= 0.0:
            return EXHAUSTED
        found = k + _keep_near(rest, distance, undecided, most)
        if found >= best_pairs:
            found = k + most_pairs(rest, matching, undecided)
        if found == k:
            return EXHAUSTED
        if found == top:
            return top
        top = found


@compiled
def _measure(problem, state, rest, distance, k, undecided):
    """Drop the pairs whose candidate is taken; write what each other one adds to the k chosen. A status code."""
    nu, _, noises = problem
    given = state[0]
    rows, candidates, live, used = rest
    for r in range(undecided):
        m = rows[r]
        count, i = live[m], 0
        while i < count:
            c = candidates[m, i]
            if used[c]:
                count -= 1
                candidates[m, i], candidates[m, count] = candidates[m, count], c
                continue
            distance[m, c] = added_distance(nu, noises, given, k, m, c)
            if distance[m, c] < 0.0:
                return INNOVATION_NOT_POSITIVE
            i += 1
        live[m] = count
    return OK


@compiled
def _keep_near(rest, distance, undecided, most):
    """Drop the pairs that add more than `most`; how many sightings have candidates left."""
    rows, candidates, live = rest[:3]
    left = 0
    for r in range(undecided):
        m = rows[r]
        count, i = live[m], 0
        while i < count:
            c = candidates[m, i]
            if distance[m, c] <= most:
                i += 1
            else:
                count -= 1
                candidates[m, i], candidates[m, count] = candidates[m, count], c
        live[m] = count
        left += count > 0
    return left


@compiled
def most_pairs(rest, matching, undecided):
    """Size of a maximum matching of the undecided sightings and their candidates, by augmenting paths."""
    rows, candidates, live = rest[:3]
    matching[:_QUEUE] = -1
    size = 0
    for r in range(undecided):
        size += _augment(candidates, live, matching, rows[r])
    return size


@compiled
def _augment(candidates, live, matching, start):
    """Look, breadth first, for a candidate for sighting `start`, others moving over; whether there is one."""
    of_sighting, of_candidate, came_from = matching[_OF_SIGHTING], matching[_OF_CANDIDATE], matching[_FROM]
    seen, queue = matching[_SEEN], matching[_QUEUE]
    queue[0] = start
    first, last = 0, 1
    while first < last:
        m = queue[first]
        first += 1
        for c in candidates[m, : live[m]]:
            if seen[c] == start:
                continue
            seen[c], came_from[c] = start, m
            if of_candidate[c] >= 0:
                queue[last] = of_candidate[c]
                last += 1
                continue
            while c >= 0:
                m = came_from[c]
                before = of_sighting[m]
                of_sighting[m], of_candidate[c] = c, m
                c = before
            return True
    return False
