"""What the particles say together: pose, map with existence, and how far the particles differ."""

from __future__ import annotations

import math

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.kernels import set_layout as layout
from kalmap.records import Landmarks
from kalmap.slam.particles import Particles

_TINY = 1e-15  # m^2 and rad^2: a pose that is known exactly has a root all the same
_KNOWN = 3.0  # sightings


def mean_pose(particles: Particles) -> np.ndarray:
    """(3,) weighted; the heading by its mean direction."""
    weights, poses = particles.weights, particles.poses
    heading = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    return np.array([weights @ poses[:, 0], weights @ poses[:, 1], heading])


def pose_spread(particles: Particles, mean: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(3, 3): between the particles, and what the sightings leave of each one's pose; left (N, 3, 3), roots."""
    weights = particles.weights
    off = particles.poses - mean
    off[:, 2] = wrap(off[:, 2])
    between = (weights[:, None] * off).T @ off
    within = np.einsum("n,nij,nkj->ik", weights, left, left)
    return np.asarray(between + within)


def rotated(roots: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(N, 3, 3) roots of pose covariances in axes turned by the angles (N,)."""
    turned = roots.copy()
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    turned[:, 0] = cosine * roots[:, 0] - sine * roots[:, 1]
    turned[:, 1] = sine * roots[:, 0] + cosine * roots[:, 1]
    return turned


def features(rows: np.ndarray, threshold: float, least: float) -> np.ndarray:
    """Which rows (C, COLUMNS) of a map are landmarks of the result, oldest first: (K,) indices.

    Those of a weight of `threshold`, and of those that were sighted `_KNOWN` times the ones of `least`: a density has
    no memory, so what was well known falls to 1 - P_D of its weight at one miss and stays there once out of view.
    """
    weight = rows[:, layout.WEIGHT]
    known = (rows[:, layout.SEEN] >= _KNOWN) & (weight >= least)
    chosen = np.flatnonzero((weight >= threshold) | known)
    return chosen[np.argsort(rows[chosen, layout.ID], kind="stable")]


def covariances(rows: np.ndarray) -> np.ndarray:
    """(C, 2, 2) from the roots."""
    l11, l21, l22 = rows[:, layout.L11], rows[:, layout.L21], rows[:, layout.L22]
    return np.stack(
        [np.stack([l11 * l11, l11 * l21], -1), np.stack([l11 * l21, l21 * l21 + l22 * l22], -1)], -2
    )


def deviations(particles: Particles, best: np.ndarray, means: np.ndarray) -> np.ndarray:
    """(N, K, 2) m: where each particle has the K landmarks of the best map, as differences from it.

    best (K, COLUMNS); means (K, 2) their places. A landmark is the one founded by the same sighting; a particle that
    has none of it differs by nothing.
    """
    off = np.zeros((len(particles), len(best), 2))
    known: dict[int, np.ndarray] = {}
    for n, slot in enumerate(particles.slots.tolist()):
        if slot not in known:
            rows = particles.map_of(n)
            order = np.lexsort((-rows[:, layout.WEIGHT], rows[:, layout.ID]))
            ids = rows[order, layout.ID]
            at = np.searchsorted(ids, best[:, layout.ID])
            found = at < len(ids)
            found[found] = ids[at[found]] == best[found, layout.ID]
            here = np.zeros((len(best), 2))
            here[found] = rows[order[at[found]]][:, [layout.X, layout.Y]] - means[found]
            known[slot] = here
        off[n] = known[slot]
    return off


def landmarks_of(particles: Particles, best: np.ndarray, numbers: np.ndarray) -> tuple[Landmarks, np.ndarray]:
    """The map of the best particle, with what the others differ by in its covariances; and these differences.

    best (K, COLUMNS): its landmarks; numbers (K,): their lasting numbers.
    """
    places = best[:, [layout.X, layout.Y]]
    off = deviations(particles, best, places)
    weights = particles.weights
    between = np.einsum("n,nki,nkj->kij", weights, off, off)
    landmarks = Landmarks(
        ids=numbers,
        positions=places.copy(),
        covariances=covariances(best) + between,
        sightings=np.rint(best[:, layout.SEEN]).astype(np.int64),
        existence=np.minimum(best[:, layout.WEIGHT], 1.0),
    )
    return landmarks, off


def joint_of(
    particles: Particles,
    pose: np.ndarray,
    pose_covariance: np.ndarray,
    bias_covariance: np.ndarray,
    landmarks: Landmarks,
    off: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and covariance (n, n) of pose, biases and landmarks: each one's own, and between the particles.

    bias_covariance (nb, nb): what each particle is unsure of by itself. pose_covariance (3, 3): as it was said of the
    weighted particles; where resampling has spread them since, what links pose and landmarks is that much weaker.
    """
    weights = particles.weights
    poses = particles.poses - mean_pose(particles)
    poses[:, 2] = wrap(poses[:, 2])
    poses *= _share(pose_covariance, (weights[:, None] * poses).T @ poses)
    mean = weights @ particles.biases
    whole = np.concatenate([poses, particles.biases - mean, off.reshape(len(weights), -1)], axis=1)
    covariance = (weights[:, None] * whole).T @ whole
    covariance[:3, :3] = pose_covariance
    first = 3 + len(mean)
    covariance[3:first, 3:first] += bias_covariance
    for k, block in enumerate(landmarks.covariances):
        part = slice(first + 2 * k, first + 2 * k + 2)
        covariance[part, part] = block
    return np.concatenate([pose, mean, landmarks.positions.ravel()]), covariance


def _share(whole: np.ndarray, part: np.ndarray) -> float:
    """The largest s up to 1 for which whole - s^2 part, (3, 3) each, is positive semi-definite."""
    root = np.linalg.cholesky(whole + (1e-12 * np.trace(whole) + _TINY) * np.eye(3))
    half = np.linalg.solve(root, part)
    largest = float(np.linalg.eigvalsh(np.linalg.solve(root, half.T))[-1])
    return 1.0 / math.sqrt(max(largest, 1.0))
