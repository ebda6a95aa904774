"""Drives for tests of map joining: a plain filter with known heading, and random local maps with all of SE(2)."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.slam.submaps.local_map import LocalMap, local_map

ODOMETRY, SIGHTING = 0.05, 0.1  # m


class LinearDrive:
    """A drive whose headings are known exactly, so that everything is linear-Gaussian.

    Steps of (increment, heading after it, sightings) in the frame of the whole drive; `maps` cuts it into pieces.
    """

    def __init__(self, rng: np.random.Generator, steps: int, landmarks: int = 30) -> None:
        self.landmarks = rng.uniform(-8.0, 8.0, (landmarks, 2))
        self.steps = []
        pose = np.zeros(3)
        for number in range(steps):
            move, turn = rng.uniform(0.2, 1.0, 2) * [1.0, 0.3], 0.2 * np.sin(number)
            pose = compose(pose, np.array([*move, turn]))
            noisy = move + ODOMETRY * rng.standard_normal(2)
            seen = np.flatnonzero(np.linalg.norm(self.landmarks - pose[:2], axis=1) < 5.0)
            local = rotate(-pose[2], self.landmarks[seen] - pose[:2])
            self.steps.append(
                (noisy, turn, seen, local + SIGHTING * rng.standard_normal(local.shape), pose.copy())
            )

    def filtered(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean, covariance, ids of a textbook Kalman filter over steps first..last, from its own start."""
        heading, mean, cov, ids = 0.0, np.zeros(2), np.zeros((2, 2)), []
        for move, turn, seen, z, _ in self.steps[first:last]:
            mean[:2] += rotate(heading, move)
            cov[:2, :2] += ODOMETRY**2 * np.eye(2)
            heading += turn
            for number, value in zip(seen.tolist(), rotate(heading, z)):
                n = len(mean)
                if number not in ids:
                    ids.append(number)
                    grow = np.eye(n + 2, n)
                    grow[n:, :2] = np.eye(2)
                    mean, cov = grow @ mean, grow @ cov @ grow.T
                    mean[n:] += value
                    cov[n:, n:] += SIGHTING**2 * np.eye(2)
                    continue
                at = 2 + 2 * ids.index(number)
                h = np.zeros((2, n))
                h[:, :2], h[:, at : at + 2] = -np.eye(2), np.eye(2)
                gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + SIGHTING**2 * np.eye(2))
                mean = mean + gain @ (value - h @ mean)
                cov = cov - gain @ h @ cov
        order = np.concatenate([[0, 1], np.arange(2, len(mean))])
        whole = np.zeros((len(mean) + 1, len(mean) + 1))
        kept = np.concatenate([[0, 1], np.arange(3, len(mean) + 1)])
        whole[np.ix_(kept, kept)] = cov[np.ix_(order, order)]
        return np.concatenate([mean[:2], [heading], mean[2:]]), whole, np.array(ids)

    def maps(self, length: int, heading_variance: float = 0.0) -> list[LocalMap]:
        """The drive as local maps of so many steps each."""
        closed = []
        for first in range(0, len(self.steps), length):
            mean, cov, ids = self.filtered(first, first + length)
            cov[2, 2] = heading_variance
            closed.append(local_map(mean, cov, ids))
        return closed


def random_maps(rng: np.random.Generator, count: int, noise: float = 0.05) -> list[LocalMap]:
    """Consecutive local maps of one world with full random covariances, about `noise` m and rad large."""
    world = rng.uniform(-4.0, 4.0, (14, 2)) + rng.uniform(-1.0, 1.0, 2)
    pose, closed = np.zeros(3), []
    for _ in range(count):
        end = compose(pose, np.array([*rng.uniform(-1.0, 3.0, 2), rng.uniform(-1.0, 1.0)]))
        ids = np.sort(rng.choice(len(world), 8, replace=False))
        local = rotate(-pose[2], world[ids] - pose[:2])
        mean = np.concatenate([compose(inverse(pose), end), local.ravel()])
        root = noise * (np.eye(len(mean)) + 0.3 * rng.standard_normal((len(mean), len(mean))))
        cov = root @ root.T
        closed.append(local_map(mean + root @ rng.standard_normal(len(mean)), cov, ids))
        pose = end
    return closed


def rows_by_id(found: LocalMap, ids: np.ndarray) -> np.ndarray:
    """Rows of the landmarks with these numbers."""
    return np.array([int(np.flatnonzero(found.ids == number)[0]) for number in ids])
