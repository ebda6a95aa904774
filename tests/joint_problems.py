"""Problems of joint compatibility, and the best of all hypotheses by brute force, for the tests of the searches."""

from __future__ import annotations

import math

import numpy as np

from kalmap.association.joint import JointMatch
from slam_problems import random_covariance

NOISE = np.diag([0.1**2, np.deg2rad(1.5) ** 2])


def quantile(probability: float, degrees: int) -> float:
    """The chi-square quantile from scipy.stats; 0 for no degree of freedom."""
    from scipy.stats import chi2

    return float(chi2.ppf(probability, degrees)) if degrees else 0.0


def problem(
    rng,
    sightings: int,
    landmarks: int,
    *,
    shared: bool = True,
    strangers: float = 0.2,
    spread: tuple[float, float] = (0.7, 2.5),
) -> dict:
    """Range-bearing sightings of a map with a joint Gaussian error, drawn from it.

    spread: the bounds of half the side of the square that the landmarks stand in, m. shared: the pose is uncertain
    and the landmarks are correlated; else they err independently. strangers: share of the sightings that are of
    nothing in the map, near some landmark's expected place.
    """
    size = 3 + 2 * landmarks
    covariance = np.diag(np.full(size, 0.4**2))
    if shared:
        scale = np.r_[1.5, 1.5, 0.2, np.full(size - 3, 0.8)]
        covariance = covariance * 0.2 + random_covariance(rng, size, rank=4) * np.outer(scale, scale)
    place = np.array([6.0, 0.0]) + rng.uniform(*spread) * rng.uniform(-1.0, 1.0, (landmarks, 2))
    matrix = np.zeros((2 * landmarks, size))
    for c, (x, y) in enumerate(place):
        square, distance = x * x + y * y, math.hypot(x, y)
        gradient = np.array([[x / distance, y / distance], [-y / square, x / square]])
        matrix[2 * c : 2 * c + 2, :2] = -gradient
        matrix[2 * c + 1, 2] = -1.0
        matrix[2 * c : 2 * c + 2, 3 + 2 * c : 5 + 2 * c] = gradient
    if not shared:
        matrix[:, :3] = 0.0
    expected = np.column_stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0])])
    # by Cholesky: which root the default takes is rounding's, and so the problem would be another on every machine
    seen = expected + (
        matrix @ rng.multivariate_normal(np.zeros(size), covariance, method="cholesky")
    ).reshape(-1, 2)
    source = rng.permutation(max(sightings, landmarks))[:sightings] % landmarks
    z = seen[source] + rng.standard_normal((sightings, 2)) * np.sqrt(np.diag(NOISE))
    strange = rng.random(sightings) < strangers
    z[strange] += rng.standard_normal((int(strange.sum()), 2)) * [1.5, 0.25]
    cross = (matrix @ covariance @ matrix.T).reshape(landmarks, 2, landmarks, 2).transpose(0, 2, 1, 3)
    own = np.arange(landmarks)
    cross[own, own] += np.diag([1e-3, 1e-5])  # what the regression leaves over
    return given(z[:, None] - expected[None], cross, np.tile(NOISE, (sightings, 1, 1)))


def given(nu, cross, noises) -> dict:
    """The arguments, with the individual distances from numpy."""
    spreads = cross[np.arange(len(cross)), np.arange(len(cross))][None] + noises[:, None]
    squared = np.einsum("mci,mci->mc", nu, np.linalg.solve(spreads, nu[..., None])[..., 0])
    return {"nu": nu, "cross": np.ascontiguousarray(cross), "noises": noises, "squared": squared}


def hypotheses(possible: np.ndarray):
    """Every one-to-one set of possible pairs, by number of pairs: (sightings (N, k), candidates (N, k))."""
    sets: list[list[tuple[tuple[int, int], ...]]] = [[()]]
    for m in range(len(possible)):
        sets.append([])
        for k in range(m, -1, -1):
            for chosen in sets[k]:
                taken = [c for _, c in chosen]
                sets[k + 1] += [(*chosen, (m, c)) for c in np.flatnonzero(possible[m]) if c not in taken]
    for k, group in enumerate(sets):
        if k and group:
            pairs = np.array(group).reshape(len(group), k, 2)
            yield pairs[..., 0], pairs[..., 1]


def joint_distances(case: dict, m: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Joint distances squared of hypotheses with k pairs each, from their stacked matrices."""
    count, k = m.shape
    blocks = case["cross"][c[:, :, None], c[:, None, :]]
    own = np.arange(k)
    blocks[:, own, own] += case["noises"][m]
    stacked = blocks.transpose(0, 1, 3, 2, 4).reshape(count, 2 * k, 2 * k)
    nu = case["nu"][m, c].reshape(count, 2 * k)
    return np.einsum("ni,ni->n", nu, np.linalg.solve(stacked, nu[..., None])[..., 0])


def brute_force(case: dict, gate: float, joint_probability: float) -> tuple[np.ndarray, int, float]:
    """The best of all hypotheses, by the definition: (matched, pairs, joint distance squared)."""
    best = np.full(len(case["nu"]), -1), 0, 0.0
    for m, c in hypotheses(case["squared"] <= gate):
        squared = joint_distances(case, m, c)
        squared[squared > quantile(joint_probability, 2 * m.shape[1])] = np.inf
        first = int(np.argmin(squared))
        if np.isfinite(squared[first]):
            matched = np.full(len(case["nu"]), -1)
            matched[m[first]] = c[first]
            best = matched, m.shape[1], float(squared[first])
    return best


def assert_best(found: JointMatch, case: dict, gate: float, joint_probability: float) -> None:
    matched, pairs, squared = brute_force(case, gate, joint_probability)
    assert found.complete
    assert found.pairs == pairs
    np.testing.assert_array_equal(found.matched, matched)
    np.testing.assert_allclose(found.squared, squared, rtol=1e-8, atol=1e-9)


def distance_of(case: dict, found: JointMatch) -> float:
    """The joint distance squared of an answer, from the stacked matrices."""
    rows = np.flatnonzero(found.matched >= 0)
    return float(joint_distances(case, rows[None], found.matched[rows][None])[0]) if len(rows) else 0.0
