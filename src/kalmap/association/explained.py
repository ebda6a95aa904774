"""The hypotheses of a frame as a multi-Bernoulli map weighs them, and what they say together."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.association.gated import Table
from kalmap.geometry.angles import wrap
from kalmap.kernels import nearest as kernel

_DOUBLE = 25.0  # squared distance by the sensor's noise within which two landmarks look like one


class Rates(msgspec.Struct, frozen=True):
    """detection (C,): probability that each candidate is sighted if it exists; odds (C,): ln odds that it does.

    seen, missed (C,): probability that it is sighted, and that it is not: 1 for what may be hidden. density: of
    sightings that nothing explains, 1 / (m rad). rings (C,): of range.
    """

    detection: np.ndarray
    odds: np.ndarray
    seen: np.ndarray
    missed: np.ndarray
    density: float
    rings: np.ndarray


class Found(Rates, frozen=True):
    """The hypotheses of a frame: sets (H, M) candidate or -1, weights (H,) summing to one, logs (H,), best first."""

    sets: np.ndarray
    weights: np.ndarray
    logs: np.ndarray


def probability(odds: np.ndarray) -> np.ndarray:
    """The probability behind ln odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * odds)))


def pair_probabilities(found: Found, candidates: int) -> np.ndarray:
    """(M, C) over the hypotheses."""
    pairs = np.zeros((found.sets.shape[1], candidates))
    rows = np.arange(len(pairs))
    for columns, weight in zip(found.sets, found.weights.tolist()):
        taken = columns >= 0
        pairs[rows[taken], columns[taken]] += weight
    return pairs


def of_trials(found: Found, table: Table, columns: np.ndarray, fate: np.ndarray) -> float:
    """ln of what sightings that go to landmarks on trial add to the frame's likelihood, each by itself."""
    total = 0.0
    for m in np.flatnonzero(fate == kernel.TRIAL).tolist():
        c = int(columns[m])
        density = -0.5 * float(table.normalised[m, c]) - math.log(2.0 * math.pi)
        total += math.log(found.seen[c] / found.missed[c]) + density - math.log(found.density)
    return total


def excused(found: Found, table: Table, columns: np.ndarray) -> float:
    """ln of what the misses of doubles had cost: of two landmarks in one place, only one can have the sighting."""
    z, total = table.expected.z, 0.0
    taken = columns[columns >= 0]
    free = np.ones(len(z), dtype=bool)
    free[taken] = False
    for m in np.flatnonzero(columns >= 0).tolist():
        off = z - z[columns[m]]
        off[:, 1] = wrap(off[:, 1])
        squared = np.einsum("ci,ij,cj->c", off, np.linalg.inv(table.noises[m]), off)
        double = free & (squared < _DOUBLE)
        total -= float(np.log(found.missed[double]).sum())
        free &= ~double
    return total


def as_matrix(blocks: np.ndarray) -> np.ndarray:
    """(C, C, 2, 2) blocks as one matrix (2 C, 2 C)."""
    count = len(blocks)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(2 * count, 2 * count)
