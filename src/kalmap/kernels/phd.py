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

from kalmap.kernels.association_sums import log_sum_of_associations
from kalmap.kernels.compiled import compiled
from kalmap.kernels.frame import (
    births,
    corrected,
    count_ring,
    likelihood,
    look_around,
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


@compiled
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


@compiled
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


@compiled
def _by_cubature(rules, looks, prior, masses, updated):
    """Equations (25) to (27): the heaviest component alone, its place integrated out by the lineariser's rule."""
    whole = len(masses) * math.log(rules[CLUTTER]) - rules[CLUTTER_RATE]
    if not len(prior):
        return whole
    best = np.argmax(prior[:, WEIGHT])
    inside = 1.0 - looks[best, DETECTION] + masses[:, best].sum() / rules[CLUTTER]
    return whole + math.log(inside) - math.log(max(updated[best], 1e-300))


@compiled
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


@compiled
def _updated(rules, prior, looks, innovations, masses, rows, updated, explained, tally, cluster):
    """The updated intensity, one row a hypothesis, in `rows`; returns how many there are.

    masses (M, C): P_D w N of every pair. updated (C,): each component's weight afterwards, all its hypotheses together.
    cluster (1,): ln p(Z | x) of a Poisson map in closed form. The rest as `phd_update`.
    """
    sightings, seen = masses.shape
    total, cluster[0] = 0, -rules[CLUTTER_RATE]
    for j in range(seen):
        updated[j] = prior[j, WEIGHT] * (1.0 - looks[j, DETECTION])
        cluster[0] -= prior[j, WEIGHT] * looks[j, DETECTION]
        if updated[j] >= rules[PRUNE]:
            rows[total] = prior[j]
            rows[total, WEIGHT] = updated[j]
            total += 1
    hits = np.zeros(seen)
    for i in range(sightings):
        mapped = masses[i].sum()
        whole = rules[CLUTTER] + mapped
        explained[i] = mapped / whole
        cluster[0] += math.log(whole)
        for j in range(seen):
            if masses[i, j] == 0.0:
                continue
            weight = masses[i, j] / whole
            hits[j] += weight
            if weight >= rules[PRUNE]:
                corrected(prior[j], looks[j], innovations[i, j], rows[total])
                rows[total, WEIGHT], rows[total, ID] = weight, prior[j, ID]
                rows[total, SEEN] = prior[j, SEEN] + 1.0
                total += 1
    for j in range(seen):
        updated[j] += hits[j]
        # whatever its weight: those that were not missed lately would bias the share
        if prior[j, SEEN] >= _KNOWN:
            count_ring(rules, looks[j, RANGE], 1.0, min(hits[j], 1.0), tally[0], tally[1])
    return total


@compiled
def phd_update(setup, rules, profile, beams, pose, root, noise, block, count, z, number, explained, tally):
    """Update the map (block's first `count` rows) in place; returns (new count, ln of the particle's weight factor).

    explained (M,): on return the share of each sighting that the map explains. tally (2, RINGS): adds the features
    that could be seen and those that were. number: of the frame, for the ids of births.
    """
    active, looks, innovations, densities = look_around(
        setup, rules, profile, beams, pose, root, noise, block, count, z
    )
    sightings, seen = densities.shape
    prior = block[active]
    masses = densities  # P_D w N of every pair, in place
    for j in range(seen):
        masses[:, j] *= looks[j, DETECTION] * prior[j, WEIGHT]
    rows = np.empty((seen + (masses > 0.0).sum(), COLUMNS))
    updated, cluster = np.empty(seen), np.empty(1)
    total = _updated(rules, prior, looks, innovations, masses, rows, updated, explained, tally, cluster)
    kept = np.empty((total + sightings, COLUMNS))
    reduced = reduce(rules, rows, total, kept)
    gained = updated.sum() - prior[:, WEIGHT].sum()
    strategy = int(rules[WEIGHTING])
    if strategy == SINGLE_CLUSTER:
        log_weight = cluster[0]
    elif strategy == CUBATURE_FEATURE:
        log_weight = gained + _by_cubature(rules, looks, prior, masses, updated)
    else:
        places = np.empty((reduced, COLUMNS))
        features = _chosen(rules, kept, reduced, places)
        log_weight = gained
        log_weight += set_likelihood(setup, rules, profile, beams, pose, root, noise, places, features, z)
        for k in range(features):
            x, y = places[k, X], places[k, Y]
            log_weight += math.log(max(intensity(prior, seen, x, y), 1e-300))
            log_weight -= math.log(max(intensity(rows, total, x, y), 1e-300))
    new = births(setup, rules, pose, root, z, noise, explained, number, kept, reduced)
    return write_back(block, count, active, kept, new), log_weight
