"""One frame from one particle: who may be seen, how likely each pair is, and what is written back to the map."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import MOUNT_X, MOUNT_Y
from kalmap.kernels.looks import detection, found, look, sight
from kalmap.kernels.regression import wrap
from kalmap.kernels.set_layout import (
    BEARING,
    BIRTH,
    DETECTION,
    GATE,
    HALF_VIEW,
    ID,
    K11,
    K12,
    K21,
    K22,
    L11,
    L21,
    L22,
    LOOK,
    MAX_RANGE,
    NORM,
    PRUNE,
    RANGE,
    RINGS,
    SEEN,
    U11,
    U21,
    U22,
    W11,
    W21,
    W22,
    WEIGHT,
    X,
    Y,
)

FRAME_IDS = 4096  # ids of one frame's births

_UNSEEN = 1e-6  # below this probability of detection a component takes no part
_MARGIN = 0.5  # rad beside the view that is looked at more closely
_SIGMAS = 6.0


@compiled
def in_view(setup, rules, profile, beams, pose, root, noise, block, count, active, looks):
    """Which components of a map may be sighted: indices (C,) and how they look (C, LOOK). Returns C."""
    scratch = np.empty((4, 12))
    seen = 0
    mount = math.hypot(setup[MOUNT_X], setup[MOUNT_Y])
    for c in range(count):
        component = block[c]
        size = _SIGMAS * (component[L11] + abs(component[L21]) + component[L22])
        dx, dy = component[X] - pose[0], component[Y] - pose[1]
        far = rules[MAX_RANGE] + mount + size + 1.0
        squared = dx * dx + dy * dy
        if squared > far * far:
            continue
        distance, bearing = sight(setup, pose[0], pose[1], pose[2], component[X], component[Y])
        if abs(bearing) > rules[HALF_VIEW] + _MARGIN and distance > size:
            continue
        look(setup, pose, root, component, noise, scratch, looks[seen])
        probability = detection(rules, profile, beams, looks[seen])
        if probability < _UNSEEN:
            continue
        looks[seen, DETECTION] = probability
        active[seen] = c
        seen += 1
    return seen


@compiled
def likelihood(row, squared):
    """Density of a sighting at that squared distance."""
    return math.exp(-0.5 * squared - row[NORM])


@compiled
def _densities(rules, looks, z, innovations, densities):
    """Innovations (M, C, 2) and densities N(nu; 0, S) (M, C) of every pair; zero beyond the gate."""
    for i in range(len(z)):
        for j in range(len(looks)):
            row = looks[j]
            a = (z[i, 0] - row[RANGE]) / row[W11]
            densities[i, j] = 0.0
            if a * a > rules[GATE]:
                continue
            nu = wrap(z[i, 1] - row[BEARING])
            b = (nu - row[W21] * a) / row[W22]
            squared = a * a + b * b
            if squared <= rules[GATE]:
                densities[i, j] = likelihood(row, squared)
                innovations[i, j, 0], innovations[i, j, 1] = z[i, 0] - row[RANGE], nu


@compiled
def look_around(setup, rules, profile, beams, pose, root, noise, block, count, z):
    """What every update of a map begins with: who may be seen, and how well each sighting fits.

    Returns the components in view, indices (C,), how they look (C, LOOK), and of every pair the innovation (M, C, 2)
    and its density (M, C), zero beyond the gate.
    """
    active, looks = np.empty(count, np.int64), np.empty((count + 1, LOOK))
    seen = in_view(setup, rules, profile, beams, pose, root, noise, block, count, active, looks)
    active, looks = active[:seen], looks[:seen]
    innovations, densities = np.empty((len(z), seen, 2)), np.empty((len(z), seen))
    _densities(rules, looks, z, innovations, densities)
    return active, looks, innovations, densities


@compiled
def corrected(component, row, nu, out):
    """The component after the sighting with innovation nu (2,); weight, id and count are the caller's."""
    out[X] = component[X] + row[K11] * nu[0] + row[K12] * nu[1]
    out[Y] = component[Y] + row[K21] * nu[0] + row[K22] * nu[1]
    out[L11], out[L21], out[L22] = row[U11], row[U21], row[U22]


@compiled
def births(setup, rules, pose, root, z, noise, explained, number, rows, count):
    """Append a component for every sighting that the map does not explain; returns how many there are then."""
    scratch = np.empty((2, 12))
    for i in range(len(z)):
        weight = rules[BIRTH] * (1.0 - explained[i])
        if weight < rules[PRUNE] or count == len(rows):
            continue
        found(setup, pose, root, z[i], noise, scratch, rows[count])
        rows[count, WEIGHT], rows[count, SEEN] = weight, 1.0
        rows[count, ID] = number * FRAME_IDS + min(i, FRAME_IDS - 1)
        count += 1
    return count


@compiled
def write_back(block, count, active, rows, new):
    """Put `new` rows in the place of the active components; holes are filled from the end. Returns the new count.

    What does not fit into the block is left out: its capacity is the cap.
    """
    seen = len(active)
    for k in range(min(new, seen)):
        block[active[k]] = rows[k]
    for k in range(seen, new):
        if count == len(block):
            break
        block[count] = rows[k]
        count += 1
    for k in range(seen - 1, new - 1, -1):  # active is ascending: fill the last hole first
        count -= 1
        block[active[k]] = block[count]
    return count


@compiled
def count_ring(rules, distance, weight, hits, seen, found_):
    """Add to the tallies of a ring: features that could be seen (RINGS,), and those that were (RINGS,)."""
    ring = min(int(distance / rules[MAX_RANGE] * rules[RINGS]), int(rules[RINGS]) - 1)
    seen[ring] += weight
    found_[ring] += hits
