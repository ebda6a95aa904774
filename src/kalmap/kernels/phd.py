"""The Gaussian-mixture PHD of one particle's map, and the particle's weight.

Update: equations (30) to (32) of the SRCKF-PHD-SLAM paper; weights: Mullane, Vo & Adams, A random-finite-set approach
to Bayesian SLAM (2011), Leung, Inostroza & Adams, An improved weighting strategy for RB-PHD-SLAM (2013), and Lee,
Clark & Salvi, SLAM with single cluster PHD filters (2012). All in logarithms.

With the predicted intensity v, the updated v+ and their integrals N, N+, every strategy but the single cluster is
ln p(Z | x) = ln g(Z | M, x) + sum over M (ln v - ln v+) + N+ - N for a set M of features: none, one, or all that the
updated map holds in view.
"""

import math

import numpy as np
from numba import njit

from kalmap.kernels.association_sums import log_sum_of_associations
from kalmap.kernels.frame import (
    births,
    corrected,
    count_ring,
    in_view,
    likelihood,
    pair_distances,
    write_back,
)
from kalmap.kernels.looks import detection, look
from kalmap.kernels.mixture import reduce
from kalmap.kernels.regression import wrap
from kalmap.kernels.set_layout import (
    BEARING,
    CLUTTER,
    CLUTTER_RATE,
    COLUMNS,
    CUBATURE_FEATURE,
    DETECTION,
    EMPTY,
    FEATURE,
    ID,
    L11,
    L21,
    L22,
    LOOK,
    MULTI_FEATURE,
    PRUNE,
    RANGE,
    SEEN,
    SINGLE_CLUSTER,
    W11,
    W21,
    W22,
    WEIGHT,
    WEIGHTING,
    X,
    Y,
)

_KNOWN = 3.0  # sightings from which on a component tells how often features are sighted
_FAR = 60.0  # squared distance beyond which a component adds nothing to the intensity at a place


@njit(cache=True, nogil=True, error_model="numpy")
def intensity(rows, count, x, y):
    """The mixture's value at a place, 1 / m^2."""
    total = 0.0
    for k in range(count):
        row = rows[k]
        a = (x - row[X]) / row[L11]
        if a * a > _FAR:
            continue
        b = (y - row[Y] - row[L21] * a) / row[L22]
        squared = a * a + b * b
        if squared < _FAR:
            total += row[WEIGHT] * math.exp(-0.5 * squared) / (2.0 * math.pi * row[L11] * row[L22])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def set_likelihood(setup, rules, profile, beams, pose, root, noise, places, count, z):
    """ln g(Z | M, x): features M (count, COLUMNS) at known places (X, Y), summed over all associations."""
    looks, scratch, point = np.empty(LOOK), np.empty((4, 12)), np.zeros(COLUMNS)
    odds = np.zeros((len(z), count))
    total = len(z) * math.log(rules[CLUTTER]) - rules[CLUTTER_RATE]
    for j in range(count):
        point[X], point[Y] = places[j, X], places[j, Y]
        look(setup, pose, root, point, noise, scratch, looks)
        seen = detection(rules, profile, beams, looks)
        total += math.log(1.0 - seen)
        for i in range(len(z)):
            a = (z[i, 0] - looks[RANGE]) / looks[W11]
            b = (wrap(z[i, 1] - looks[BEARING]) - looks[W21] * a) / looks[W22]
            if a * a + b * b < _FAR:
                odds[i, j] = seen * likelihood(looks, a * a + b * b) / (rules[CLUTTER] * (1.0 - seen))
    return total + log_sum_of_associations(odds)


@njit(cache=True, nogil=True, error_model="numpy")
def _by_cubature(rules, looks, block, active, seen, squared, updated, before, after):
    """Equations (25) to (27): the heaviest component alone, its place integrated out by the lineariser's rule."""
    best = -1
    for j in range(seen):
        if best < 0 or block[active[j], WEIGHT] > block[active[best], WEIGHT]:
            best = j
    log_clutter = math.log(rules[CLUTTER])
    count = len(squared)
    if best < 0:
        return count * log_clutter + after - before - rules[CLUTTER_RATE]
    weight, row = block[active[best], WEIGHT], looks[best]
    total = 0.0
    for i in range(count):
        if squared[i, best] < math.inf:
            total += likelihood(row, squared[i, best])
    inside = 1.0 - row[DETECTION] + row[DETECTION] * weight * total / rules[CLUTTER]
    ratio = math.log(inside) - math.log(max(updated[best], 1e-300))
    return count * log_clutter + ratio + after - before - rules[CLUTTER_RATE]


@njit(cache=True, nogil=True, error_model="numpy")
def _chosen(rules, kept, total, places):
    """The features M that a strategy weighs with, from the reduced map (heaviest first); returns how many."""
    if int(rules[WEIGHTING]) == EMPTY:
        return 0
    count = 0
    for k in range(total):
        if kept[k, WEIGHT] >= rules[FEATURE] and count < len(places):
            places[count] = kept[k]
            count += 1
            if int(rules[WEIGHTING]) != MULTI_FEATURE:
                break
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def phd_update(setup, rules, profile, beams, pose, root, noise, block, count, z, number, explained, tally):
    """Update the map (block's first `count` rows) in place; returns (new count, ln of the particle's weight factor).

    explained (M,): on return the share of each sighting that the map explains. tally (2, RINGS): adds the features
    that could be seen and those that were. number: of the frame, for the ids of births.
    """
    active, looks = np.empty(count, np.int64), np.empty((count + 1, LOOK))
    seen = in_view(setup, rules, profile, beams, pose, root, noise, block, count, active, looks)
    sightings = len(z)
    innovations, squared = np.empty((sightings, seen, 2)), np.empty((sightings, seen))
    pair_distances(rules, looks, seen, z, innovations, squared)
    prior = np.empty((seen, COLUMNS))
    updated = np.empty(seen)
    rows_most = seen + sightings
    before, pairs, cluster = 0.0, 0, -rules[CLUTTER_RATE]
    for j in range(seen):
        prior[j] = block[active[j]]
        before += prior[j, WEIGHT]
        updated[j] = prior[j, WEIGHT] * (1.0 - looks[j, DETECTION])
        cluster -= prior[j, WEIGHT] * looks[j, DETECTION]
        for i in range(sightings):
            pairs += squared[i, j] < math.inf
    rows = np.empty((rows_most + pairs, COLUMNS))
    total = 0
    for j in range(seen):
        if updated[j] >= rules[PRUNE]:
            rows[total] = prior[j]
            rows[total, WEIGHT] = updated[j]
            total += 1
    hits = np.zeros(seen)
    for i in range(sightings):
        sum_ = 0.0
        for j in range(seen):
            if squared[i, j] < math.inf:
                squared_ij = squared[i, j]
                sum_ += looks[j, DETECTION] * prior[j, WEIGHT] * likelihood(looks[j], squared_ij)
        whole = rules[CLUTTER] + sum_
        explained[i] = sum_ / whole
        cluster += math.log(whole)
        for j in range(seen):
            if squared[i, j] < math.inf:
                weight = looks[j, DETECTION] * prior[j, WEIGHT] * likelihood(looks[j], squared[i, j]) / whole
                updated[j] += weight
                hits[j] += weight
                if weight >= rules[PRUNE]:
                    corrected(prior[j], looks[j], innovations[i, j], rows[total])
                    rows[total, WEIGHT], rows[total, ID] = weight, prior[j, ID]
                    rows[total, SEEN] = prior[j, SEEN] + 1.0
                    total += 1
    after = 0.0
    for j in range(seen):
        after += updated[j]
        # whatever its weight: those that were not missed lately would bias the share
        if prior[j, SEEN] >= _KNOWN:
            count_ring(rules, looks[j, RANGE], 1.0, min(hits[j], 1.0), tally[0], tally[1])
    kept = np.empty((total + sightings, COLUMNS))
    reduced = reduce(rules, rows, total, kept)
    strategy = int(rules[WEIGHTING])
    if strategy == SINGLE_CLUSTER:
        log_weight = cluster
    elif strategy == CUBATURE_FEATURE:
        log_weight = _by_cubature(rules, looks, block, active, seen, squared, updated, before, after)
    else:
        places = np.empty((reduced, COLUMNS))
        features = _chosen(rules, kept, reduced, places)
        log_weight = after - before
        log_weight += set_likelihood(setup, rules, profile, beams, pose, root, noise, places, features, z)
        for k in range(features):
            x, y = places[k, X], places[k, Y]
            log_weight += math.log(max(intensity(prior, seen, x, y), 1e-300))
            log_weight -= math.log(max(intensity(rows, total, x, y), 1e-300))
    new = births(setup, rules, pose, root, z, noise, explained, number, kept, reduced)
    return write_back(block, count, active, seen, kept, new), log_weight
