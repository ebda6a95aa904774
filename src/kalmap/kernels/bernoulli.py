"""The Poisson multi-Bernoulli map of one particle: landmarks with identity and a probability of existence each.

Track-oriented marginal filter (Williams, Marginal multi-Bernoulli filters, 2015, TOMB/P): the probability of every
pair over all associations by belief propagation, each landmark's hypotheses merged into one Gaussian. Landmarks that
were never sighted are a Poisson process whose sightings come at a rate that `BIRTH` gives as a share of all sightings
that no landmark explains.
"""

import math

import numpy as np

from kalmap.kernels.association_sums import marginals
from kalmap.kernels.compiled import compiled
from kalmap.kernels.frame import (
    births,
    corrected,
    count_ring,
    look_around,
    write_back,
)
from kalmap.kernels.mixture import merged, reduce
from kalmap.kernels.set_layout import (
    BIRTH,
    CLUTTER,
    CLUTTER_RATE,
    COLUMNS,
    DETECTION,
    ID,
    PRUNE,
    RANGE,
    SEEN,
    SUREST,
    WEIGHT,
)


@compiled
def _after(prior, row, innovations, pairs, free, j, rows, members, out):
    """One landmark after the frame: its missed and sighted hypotheses as one. rows: scratch (M + 1, COLUMNS)."""
    missed = 1.0 - row[DETECTION]
    existence = prior[WEIGHT]
    rows[0] = prior
    rows[0, WEIGHT] = free[j] * existence * missed / (1.0 - existence * row[DETECTION])
    count = 1
    for i in range(len(pairs)):
        if pairs[i, j] > 0.0:
            corrected(prior, row, innovations[i, j], rows[count])
            rows[count, WEIGHT], rows[count, ID] = pairs[i, j], prior[ID]
            rows[count, SEEN] = prior[SEEN] + 1.0
            members[count] = count
            count += 1
    members[0] = 0
    if count == 1:
        out[:] = rows[0]
    else:
        merged(rows, members, count, out)
        out[ID] = prior[ID]
    out[WEIGHT] = min(out[WEIGHT], SUREST)


@compiled
def bernoulli_update(
    setup, rules, profile, beams, pose, root, noise, block, count, z, number, explained, tally
):
    """Update the map in place; returns (new count, ln p(Z | x)). Arguments as `phd_update`."""
    active, looks, innovations, densities = look_around(
        setup, rules, profile, beams, pose, root, noise, block, count, z
    )
    sightings, seen = densities.shape
    alone = rules[CLUTTER] / (1.0 - rules[BIRTH])
    log_sum = sightings * math.log(alone) - rules[CLUTTER_RATE]
    odds, pairs, free = np.empty((sightings, seen)), np.empty((sightings, seen)), np.empty(seen)
    for j in range(seen):
        existence, row = block[active[j], WEIGHT], looks[j]
        missed = 1.0 - existence * row[DETECTION]
        log_sum += math.log(missed)
        for i in range(sightings):
            odds[i, j] = existence * row[DETECTION] * densities[i, j] / (missed * alone)
    log_sum += marginals(odds, pairs, free)
    rows, scratch = np.empty((seen, COLUMNS)), np.empty((sightings + 1, COLUMNS))
    members = np.empty(sightings + 1, np.int64)
    total = np.int64(0)  # of a bare 0 numba would compile `reduce` once more, for that constant
    for j in range(seen):
        prior = block[active[j]]
        _after(prior, looks[j], innovations, pairs, free, j, scratch, members, rows[total])
        if prior[WEIGHT] >= 0.5:
            count_ring(rules, looks[j, RANGE], prior[WEIGHT], 1.0 - free[j], tally[0], tally[1])
        if rows[total, WEIGHT] >= rules[PRUNE]:
            total += 1
    for i in range(sightings):
        explained[i] = min(pairs[i].sum(), 1.0)
    kept = np.empty((total + sightings, COLUMNS))
    reduced = reduce(rules, rows, total, kept)
    for k in range(reduced):
        kept[k, WEIGHT] = min(kept[k, WEIGHT], SUREST)
    new = births(setup, rules, pose, root, z, noise, explained, number, kept, reduced)
    return write_back(block, count, active, kept, new), log_sum
