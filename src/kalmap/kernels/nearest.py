"""Nearest neighbour and the steps of dynamic joint nearest neighbour on tables of distances.

Zhou, Zhao & Zhang 2010, sections 2 and 3. M sightings, C candidate landmarks; `matched` (M,) holds a candidate or -1.
normalised = nu' S^-1 nu + ln det S + extra, equation (5); the gate is on the squared distance, equation (4).
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.regression import wrap

FREE = -1
CLEAN, CONTESTED, ALL_CONTESTED, NONE_MATCHED = 1, 2, 3, 4  # the paper's four cases
# what becomes of a sighting; from LOST on nobody knows which landmark it shows
MATCHED, TRIAL, NEW, LOST, BETWEEN, DOUBTFUL, LOST_TRIAL = 0, 1, 2, 3, 4, 5, 6


@compiled
def nearest(squared, normalised, gate, rows, open_columns, matched):
    """Give each sighting of `rows` (M,) bool the candidate of least normalised distance inside the gate, or none.

    open_columns: (C,) bool, candidates that may be taken. Sightings do not know of each other.
    """
    for m in range(len(rows)):
        if not rows[m]:
            continue
        matched[m] = FREE
        least = math.inf
        for c in range(len(open_columns)):
            if open_columns[c] and squared[m, c] <= gate and normalised[m, c] < least:
                least = normalised[m, c]
                matched[m] = c


@compiled
def interference(matched, candidates, contested):
    """contested (M,) bool: the sighting shares its candidate with another. Returns (good, contested) counts."""
    claims = np.zeros(candidates, dtype=np.int64)
    for m in range(len(matched)):
        if matched[m] != FREE:
            claims[matched[m]] += 1
    good = bad = 0
    for m in range(len(matched)):
        contested[m] = matched[m] != FREE and claims[matched[m]] > 1
        if contested[m]:
            bad += 1
        elif matched[m] != FREE:
            good += 1
    return good, bad


@compiled
def observation_offset(z, expected, matched, chosen, offset):
    """offset (2,): the mean innovation of the `chosen` (M,) bool pairs, equation (6); zero if there are none."""
    offset[0] = offset[1] = 0.0
    count = 0
    for m in range(len(matched)):
        if chosen[m]:
            offset[0] += z[m, 0] - expected[matched[m], 0]
            offset[1] += wrap(z[m, 1] - expected[matched[m], 1])
            count += 1
    if count:
        offset[0] /= count
        offset[1] /= count


@compiled
def shifted(z, noises, expected, spreads, extra, offset, rows, squared, normalised):
    """Write the distances of the sightings of `rows` (M,) bool less an offset; the other rows stay as they are."""
    for m in range(len(z)):
        if not rows[m]:
            continue
        for c in range(len(expected)):
            s00 = spreads[c, 0, 0] + noises[m, 0, 0]
            s01 = spreads[c, 0, 1] + noises[m, 0, 1]
            s11 = spreads[c, 1, 1] + noises[m, 1, 1]
            determinant = s00 * s11 - s01 * s01
            nu0 = z[m, 0] - offset[0] - expected[c, 0]
            nu1 = wrap(z[m, 1] - offset[1] - expected[c, 1])
            squared[m, c] = (s11 * nu0 * nu0 - 2.0 * s01 * nu0 * nu1 + s00 * nu1 * nu1) / determinant
            squared[m, c] += extra[m, c]
            normalised[m, c] = squared[m, c] + math.log(determinant)


@compiled
def nearest_claims(normalised, matched, contested, winners):
    """winners (M,) bool: for each contested candidate the nearest of the sightings that claim it."""
    for m in range(len(matched)):
        winners[m] = contested[m]
        if not contested[m]:
            continue
        own = normalised[m, matched[m]]
        for k in range(len(matched)):
            if k == m or not contested[k] or matched[k] != matched[m]:
                continue
            other = normalised[k, matched[m]]
            if other < own or (other == own and k < m):
                winners[m] = False
                break


@compiled
def settle(squared, normalised, gate, usable, matched, contested):
    """Repeat until clean: each contested candidate to its nearest sighting, the rest to unmatched candidates.

    usable: (C,) bool, candidates that take part at all.
    """
    count, candidates = normalised.shape
    winners, losers = np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.bool_)
    open_columns = np.empty(candidates, dtype=np.bool_)
    while True:
        _, bad = interference(matched, candidates, contested)
        if bad == 0:
            return
        nearest_claims(normalised, matched, contested, winners)
        open_columns[:] = usable
        for m in range(count):
            losers[m] = contested[m] and not winners[m]
            if matched[m] != FREE:
                open_columns[matched[m]] = False
        nearest(squared, normalised, gate, losers, open_columns, matched)


@compiled
def best_widened(squared, gate, inside, pair):
    """pair (2,): sighting and candidate of least distance, of those `inside` (C,) bool. False: none in the gate."""
    least = gate
    found = False
    for m in range(squared.shape[0]):
        for c in range(squared.shape[1]):
            if inside[c] and squared[m, c] <= least:
                least = squared[m, c]
                pair[0], pair[1] = m, c
                found = True
    return found


@compiled
def clear_interference(
    z, noises, expected, spreads, extra, usable, gate, squared, normalised, matched, offset
):
    """Cases 1 to 3: leave `matched` one-to-one. Returns the case; `offset` (2,) is what was taken off."""
    count, candidates = normalised.shape
    contested, chosen = np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.bool_)
    good, bad = interference(matched, candidates, contested)
    if bad == 0:
        return CLEAN
    if good > 0:
        for m in range(count):
            chosen[m] = matched[m] != FREE and not contested[m]
        observation_offset(z, expected, matched, chosen, offset)
        shifted(z, noises, expected, spreads, extra, offset, contested, squared, normalised)
        settle(squared, normalised, gate, usable, matched, contested)
        return CONTESTED
    nearest_claims(normalised, matched, contested, chosen)
    observation_offset(z, expected, matched, chosen, offset)
    chosen[:] = True
    shifted(z, noises, expected, spreads, extra, offset, chosen, squared, normalised)
    nearest(squared, normalised, gate, chosen, usable, matched)
    settle(squared, normalised, gate, usable, matched, contested)
    return ALL_CONTESTED


@compiled
def dynamic_joint(
    z,
    noises,
    expected,
    spreads,
    extra,
    usable,
    inside,
    gate,
    clear,
    widen,
    squared,
    normalised,
    matched,
    offset,
):
    """DJNN within one frame, one-to-one. Returns (case 1 to 4, whether the widened gate found a pair).

    usable: (C,) bool, candidates that take part. inside: (C,) bool, those of them in the shrunken field of view,
    equation (7). clear: whether interference is removed (cases 1 to 3). widen: equation (8)'s factor, case 4; 0: never.
    squared, normalised: (M, C), of the sightings as they are; rows that an offset was taken off are overwritten.
    """
    everyone = np.ones(len(z), dtype=np.bool_)
    offset[0] = offset[1] = 0.0
    nearest(squared, normalised, gate, everyone, usable, matched)
    for m in range(len(z)):
        if matched[m] != FREE:
            if not clear:
                return CLEAN, False
            case = clear_interference(
                z, noises, expected, spreads, extra, usable, gate, squared, normalised, matched, offset
            )
            return case, False
    pair = np.zeros(2, dtype=np.int64)
    if widen == 0.0 or not best_widened(squared, widen * gate, inside, pair):
        return NONE_MATCHED, False
    offset[0] = z[pair[0], 0] - expected[pair[1], 0]
    offset[1] = wrap(z[pair[0], 1] - expected[pair[1], 1])
    moved, second = z - offset, np.zeros(2)
    shifted(moved, noises, expected, spreads, extra, second, everyone, squared, normalised)
    nearest(squared, normalised, gate, everyone, usable, matched)
    if clear:
        clear_interference(
            moved, noises, expected, spreads, extra, usable, gate, squared, normalised, matched, second
        )
    offset[0] += second[0]
    offset[1] += second[1]
    return NONE_MATCHED, True


@compiled
def finish(squared, normalised, trial, gate, new_gate, matched, fate):
    """What becomes of the sightings that no confirmed landmark got. `matched` (M,) and `fate` (M,) are filled in.

    A sighting near a confirmed landmark is left unused. The others go one-to-one to landmarks on trial, trial (C,)
    bool, by least distance; what is left and near none founds a landmark. fate: MATCHED (by the associator), TRIAL,
    NEW, LOST (inside a confirmed landmark's gate, but not given to it), LOST_TRIAL (the same of one on trial) or
    BETWEEN (a gate and the wider gate for new ones).
    """
    count, candidates = squared.shape
    rows = np.zeros(count, dtype=np.bool_)
    waiting = False
    for m in range(count):
        fate[m] = MATCHED
        if matched[m] != FREE:
            continue
        fate[m] = NEW
        for c in range(candidates):
            if not trial[c] and squared[m, c] <= gate:
                fate[m] = LOST
            elif not trial[c] and squared[m, c] < new_gate and fate[m] == NEW:
                fate[m] = BETWEEN
        rows[m] = fate[m] == NEW
        waiting = waiting or rows[m]
    if not waiting:
        return
    contested, mine = np.empty(count, dtype=np.bool_), np.full(count, FREE, dtype=np.int64)
    nearest(squared, normalised, gate, rows, trial, mine)
    settle(squared, normalised, gate, trial, mine, contested)
    for m in range(count):
        if not rows[m]:
            continue
        if mine[m] != FREE:
            matched[m], fate[m] = mine[m], TRIAL
            continue
        for c in range(candidates):
            if trial[c] and squared[m, c] <= gate:
                fate[m] = LOST_TRIAL
            elif trial[c] and squared[m, c] < new_gate and fate[m] == NEW:
                fate[m] = BETWEEN


@compiled
def outcome(columns, fate, indices, matched, seen):
    """What a frame comes to. Returns how many sightings found a landmark.

    matched: (M,) index of the map, -1 new or -2 unused. seen: (C,) bool. columns: (M,) candidate of those matched;
    cleared where the fate is another. indices: (C,) the candidates' places in the map.
    """
    founded = 0
    for c in range(len(seen)):
        seen[c] = False
    for m in range(len(fate)):
        if fate[m] == MATCHED or fate[m] == TRIAL:
            matched[m] = indices[columns[m]]
            seen[columns[m]] = True
            continue
        columns[m] = FREE
        matched[m] = -2
        if fate[m] == NEW:
            matched[m] = -1
            founded += 1
    return founded
