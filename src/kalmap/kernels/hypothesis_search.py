"""Whole-frame associations under a joint Gaussian: the likely ones, with what each of them explains.

The innovations of all pairs hang together through the robot: taking one pair moves what is expected of all others, and
narrows it. A hypothesis is grown pair by pair, always the one of greatest gain
ln(P_D r N(nu; S)) - ln(1 - P_D r) - ln(c) given those before it; ln of its likelihood against "no pair at all" is the
sum of the gains. Every beginning of such a growth is a hypothesis too, so that a pair which adds little is never sure.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

_TWO_PI = 2.0 * math.pi
_LEAST = 40.0  # ln of the ratio to the likeliest from which a hypothesis does not count


@compiled
def _gain(shift, joint, nu, noise, j, worth):
    """Gain of a pair with innovation nu (2,) against landmark j, given what is known by now."""
    s00 = joint[2 * j, 2 * j] + noise[0, 0]
    s01 = joint[2 * j, 2 * j + 1] + noise[0, 1]
    s11 = joint[2 * j + 1, 2 * j + 1] + noise[1, 1]
    determinant = s00 * s11 - s01 * s01
    if not determinant > 0.0:
        return -math.inf
    a, b = nu[0] - shift[2 * j], nu[1] - shift[2 * j + 1]
    squared = (s11 * a * a - 2.0 * s01 * a * b + s00 * b * b) / determinant
    return worth - 0.5 * squared - math.log(_TWO_PI) - 0.5 * math.log(determinant)


@compiled
def _take(shift, joint, nu, noise, j):
    """Condition what is expected of all landmarks on a pair, in place."""
    n = len(shift)
    s00 = joint[2 * j, 2 * j] + noise[0, 0]
    s01 = joint[2 * j, 2 * j + 1] + noise[0, 1]
    s11 = joint[2 * j + 1, 2 * j + 1] + noise[1, 1]
    determinant = s00 * s11 - s01 * s01
    i00, i01, i11 = s11 / determinant, -s01 / determinant, s00 / determinant
    a, b = nu[0] - shift[2 * j], nu[1] - shift[2 * j + 1]
    first, second = joint[:, 2 * j].copy(), joint[:, 2 * j + 1].copy()
    for r in range(n):
        k0 = first[r] * i00 + second[r] * i01
        k1 = first[r] * i01 + second[r] * i11
        shift[r] += k0 * a + k1 * b
        for c in range(n):
            joint[r, c] -= k0 * first[c] + k1 * second[c]


@compiled
def _grow(nu, joint, noises, possible, worth, seed, sets, logs, made):
    """Grow one hypothesis from `seed` (sighting, candidate); files every beginning of it. Returns how many."""
    count, candidates = possible.shape
    shift, known = np.zeros(2 * candidates), joint.copy()
    matched = np.full(count, -1, np.int64)
    used = np.zeros(candidates, np.bool_)
    i, j, total = seed[0], seed[1], 0.0
    gain = _gain(shift, known, nu[i, j], noises[i], j, worth[j])
    while True:
        _take(shift, known, nu[i, j], noises[i], j)
        matched[i], used[j] = j, True
        total += gain
        if made < len(logs):
            sets[made], logs[made] = matched, total
            made += 1
        gain, at_i, at_j = 0.0, -1, -1
        for a in range(count):
            if matched[a] >= 0:
                continue
            for b in range(candidates):
                if possible[a, b] and not used[b]:
                    value = _gain(shift, known, nu[a, b], noises[a], b, worth[b])
                    if value > gain:
                        gain, at_i, at_j = value, a, b
        if at_i < 0:
            return made
        i, j = at_i, at_j


@compiled
def frame_hypotheses(nu, joint, noises, possible, worth, seeds, sets, logs):
    """Write the hypotheses found, sets (H, M) candidate or -1 and logs (H,), the likeliest first; returns how many.

    nu (M, C, 2): innovations, bearing wrapped. joint (2 C, 2 C): covariance of what is expected of the candidates,
    the sensor's noise left out; noises (M, 2, 2) that noise. possible (M, C) bool. worth (C,): ln(P_D r / ((1 - P_D r)
    c)), c the density of sightings that no candidate explains. seeds: pairs of greatest gain that a hypothesis is
    grown from. "No pair at all", of log 0, is among them; H has to be at least seeds min(M, C) + 1.
    """
    count, candidates = possible.shape
    gains = np.full(count * candidates, -math.inf)
    zero = np.zeros(2 * candidates)
    for i in range(count):
        for j in range(candidates):
            if possible[i, j]:
                gains[i * candidates + j] = _gain(zero, joint, nu[i, j], noises[i], j, worth[j])
    order = np.argsort(-gains, kind="mergesort")
    sets[0], logs[0] = -1, 0.0
    made, seed = 1, np.empty(2, np.int64)
    for k in range(min(seeds, len(order))):
        if gains[order[k]] == -math.inf:
            break
        seed[0], seed[1] = order[k] // candidates, order[k] % candidates
        made = _grow(nu, joint, noises, possible, worth, seed, sets, logs, made)
    return _sorted(sets, logs, made)


@compiled
def _sorted(sets, logs, made):
    """Bring the different ones of the first `made` hypotheses to the front, the likeliest first."""
    order = np.argsort(-logs[:made], kind="mergesort")
    from_sets, from_logs = sets[:made].copy(), logs[:made].copy()
    kept = 0
    for k in range(made):
        h = order[k]
        if from_logs[h] < from_logs[order[0]] - _LEAST:
            break
        twice = False
        for g in range(kept):
            if (sets[g] == from_sets[h]).all():
                twice = True
                break
        if not twice:
            sets[kept], logs[kept] = from_sets[h], from_logs[h]
            kept += 1
    return kept


@compiled
def view_shares(z, spreads, min_range, max_range, half_view, out):
    """out (C,): probability that what is expected at z (C, 2), with covariance spreads (C, 2, 2), is in view.

    Of the view's two sides the nearer alone counts.
    """
    for c in range(len(z)):
        share = 1.0
        if max_range < math.inf:
            share = _below(max_range - z[c, 0], spreads[c, 0, 0])
        if min_range > 0.0:
            share = max(share - _below(min_range - z[c, 0], spreads[c, 0, 0]), 0.0)
        if half_view < math.pi:
            share *= _below(half_view - abs(z[c, 1]), spreads[c, 1, 1])
        out[c] = share


@compiled
def _below(distance, variance):
    """Probability that a Gaussian of that variance lies below an edge at that distance."""
    if variance <= 0.0:
        return 1.0 if distance > 0.0 else 0.0
    return 0.5 * math.erfc(-distance / math.sqrt(2.0 * variance))
