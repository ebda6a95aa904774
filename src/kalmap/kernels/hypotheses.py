"""Multi-hypothesis FastSLAM: a particle's map is a list of landmarks, a frame is explained by one-to-one associations.

Montemerlo, Thrun, Koller & Wegbreit, FastSLAM (2002), with the probability of existence that its maps keep of every
landmark; with several branches, each particle goes on as its K most probable associations (Leung, Inostroza & Adams,
Multi-hypothesis FastSLAM). With one branch it is maximum-likelihood FastSLAM. All associations together are what the
multi-Bernoulli map of `bernoulli` sums over: the likelihoods of all hypotheses add up to its normaliser.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.frame import (
    births,
    corrected,
    count_ring,
    look_around,
    write_back,
)
from kalmap.kernels.particles import set_out
from kalmap.kernels.ranking import best_associations
from kalmap.kernels.set_layout import (
    BIRTH,
    BRANCHES,
    CLUTTER,
    CLUTTER_RATE,
    COLUMNS,
    DETECTION,
    PRUNE,
    RANGE,
    SEEN,
    SUREST,
    WEIGHT,
)


@compiled
def existence_if_missed(existence, detection):
    """P(exists | not sighted) by Bayes: r (1 - P_D) / (1 - r P_D)."""
    return existence * (1.0 - detection) / (1.0 - existence * detection)


@compiled
def existence_if_given(existence, detection, density, alone):
    """P(exists | it was given a sighting of that density): odds r / (1 - r) times 1 - P_D + P_D N(z) / alone.

    FastSLAM does not take the association for proof. If the landmark exists, a sighting at z is its own, P_D N(z), or
    it was missed and something else was sighted there, (1 - P_D) alone; if not, something else was, alone. `alone` is
    the density of sightings that no landmark explains. The ratio of the two is the factor on the odds; it is exact
    where no other sighting and no other landmark is near.
    """
    odds = existence * (1.0 - detection + detection * density / alone)
    return min(odds / (1.0 - existence + odds), SUREST)


@compiled
def _odds(rules, block, active, looks, densities, odds):
    """Odds (M, C) of every pair against both being alone; returns ln of the likelihood if all are."""
    sightings, seen = odds.shape
    alone = rules[CLUTTER] / (1.0 - rules[BIRTH])
    total = sightings * math.log(alone) - rules[CLUTTER_RATE]
    for j in range(seen):
        sighted = min(block[active[j], WEIGHT], SUREST) * looks[j, DETECTION]
        total += math.log(1.0 - sighted)
        for i in range(sightings):
            odds[i, j] = sighted * densities[i, j] / ((1.0 - sighted) * alone)
    return total


@compiled
def _landmarks(rules, block, active, looks, innovations, densities, given, rows):
    """The landmarks in view after the frame under one hypothesis, given (M,), in `rows`; returns how many stay."""
    alone = rules[CLUTTER] / (1.0 - rules[BIRTH])
    seen = len(active)
    sighting = np.full(seen, -1, np.int64)
    for i in range(len(given)):
        if given[i] >= 0:
            sighting[given[i]] = i
    total = 0
    for j in range(seen):
        prior, row, i = block[active[j]], rows[total], sighting[j]
        existence, detection = min(prior[WEIGHT], SUREST), looks[j, DETECTION]
        row[:] = prior
        if i < 0:
            row[WEIGHT] = existence_if_missed(existence, detection)
        else:
            corrected(prior, looks[j], innovations[i, j], row)
            row[WEIGHT] = existence_if_given(existence, detection, densities[i, j], alone)
            row[SEEN] = prior[SEEN] + 1.0
        if row[WEIGHT] >= rules[PRUNE]:
            total += 1
    return total


@compiled
def _count(rules, block, active, looks, given, logs, made, tally):
    """Add the frame's features and hits to `tally`, each hypothesis with its share of the probability of those made."""
    seen = len(active)
    hits, whole = np.zeros(seen), 0.0
    for k in range(made):
        share = math.exp(logs[k] - logs[0])
        whole += share
        for i in range(given.shape[1]):
            if given[k, i] >= 0:
                hits[given[k, i]] += share
    for j in range(seen):
        weight = min(block[active[j], WEIGHT], 1.0)
        if weight >= 0.5:
            count_ring(rules, looks[j, RANGE], weight, hits[j] / whole, tally[0], tally[1])


@compiled
def hypotheses_update(
    setup,
    rules,
    profile,
    beams,
    pose,
    root,
    noise,
    block,
    count,
    z,
    number,
    out_blocks,
    out_counts,
    out_logs,
    explained,
    tally,
):
    """The map (block's first `count` rows) under each of the K best hypotheses, best first; returns how many, 1 to K.

    Arguments as `phd_update`; `block` stays as it is. out_blocks (K, capacity, COLUMNS) and out_counts (K,): the maps;
    a birth beyond the capacity is left out. out_logs (K,): ln of the likelihood of the frame under the hypothesis.
    explained (K, M): 1 for a sighting given to a landmark, 0 for one that founds a landmark or is clutter.
    """
    active, looks, innovations, densities = look_around(
        setup, rules, profile, beams, pose, root, noise, block, count, z
    )
    sightings, seen = densities.shape
    odds, given = np.empty((sightings, seen)), np.empty((len(out_logs), sightings), np.int64)
    log_alone = _odds(rules, block, active, looks, densities, odds)
    made = best_associations(odds, given, out_logs)
    rows = np.empty((seen + sightings, COLUMNS))
    for k in range(made):
        out_logs[k] += log_alone
        for i in range(sightings):
            explained[k, i] = 1.0 if given[k, i] >= 0 else 0.0
        total = _landmarks(rules, block, active, looks, innovations, densities, given[k], rows)
        new = births(setup, rules, pose, root, z, noise, explained[k], number, rows, total)
        out_blocks[k, :count] = block[:count]
        out_counts[k] = write_back(out_blocks[k], count, active, rows, new)
    _count(rules, block, active, looks, given, out_logs, made, tally)
    return made


@compiled
def step_hypotheses(
    setup,
    rules,
    profile,
    beams,
    noise,
    blocks,
    counts,
    slots,
    poses,
    root,
    delta,
    z,
    number,
    proposal,
    known_pose,
    spread_by,
    normals,
    first,
    last,
    left,
    ways,
    child_blocks,
    child_counts,
    child_logs,
    children,
    explained,
    tallies,
):
    """Carry particles first to last through a frame: each moves, and its map becomes up to K = BRANCHES maps.

    Arguments as `step_particles`, but that `blocks` and `counts` stay as they are and may be shared. Particle p's
    children stand from p K on, best first: child_blocks (N K, capacity, COLUMNS), child_counts (N K,), child_logs
    (N K,), ln of the factor on the particle's weight, explained (N K, M); children (N,): how many. They share its pose.
    """
    branches = int(rules[BRANCHES])
    within = np.empty((3, 3))
    for p in range(first, last):
        block, count = blocks[slots[p]], counts[slots[p]]
        log_factor = set_out(
            setup,
            rules,
            profile,
            beams,
            noise,
            block,
            count,
            poses[p],
            root,
            delta,
            z,
            proposal,
            known_pose,
            spread_by,
            normals[p],
            left[p],
            ways[p],
            within,
        )
        low, high = p * branches, (p + 1) * branches
        what = setup, rules, profile, beams, poses[p], within, noise, block, count, z, number
        out = child_blocks[low:high], child_counts[low:high], child_logs[low:high], explained[low:high]
        children[p] = hypotheses_update(*what, *out, tallies[p])
        child_logs[low : low + children[p]] += log_factor
