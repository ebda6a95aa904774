"""Closed maps made of known walls, with errors drawn from their own covariances, for the tests of loops."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.slam.contours.closed import ClosedMap

SPACING = 0.3


def sampled(walls, spacing=SPACING, phase=0.0):
    """Samples and normals along walls (S, 4); the free side is to the left of each."""
    samples, normals = [], []
    for x1, y1, x2, y2 in np.asarray(walls, dtype=float):
        way = np.array([x2 - x1, y2 - y1])
        length = np.hypot(*way)
        at = np.arange(0.05 + phase, length, spacing)
        samples.append([x1, y1] + at[:, None] * way / length)
        normals.append(np.tile([-way[1] / length, way[0] / length], (len(at), 1)))
    return np.vstack(samples), np.vstack(normals)


def room(left, bottom, right, top):
    """Four walls (4, 4), free inside."""
    return [
        [left, bottom, right, bottom], [right, bottom, right, top], [right, top, left, top], [left, top, left, bottom],
    ]  # fmt: skip


def made_map(walls, frame, end, *, rng=None, sigma=0.01, warp=0.0, phase=0.0, sightings=9):
    """The map of walls (S, 4), given in the plan, in the frame (3,) of a vehicle that ends at `end` (3,).

    Its samples have errors of their own, sigma m, and errors that they share: a turn, `warp` rad, and a shift, warp m
    of the whole about the frame's origin, which the end has too. rng: draws both; None: the map is right.
    """
    samples, normals = sampled(walls, phase=phase)
    T_frame_plan = inverse(np.asarray(frame, dtype=float))
    placed = T_frame_plan[:2] + rotate(T_frame_plan[2], samples)
    mean = np.concatenate([compose(T_frame_plan, np.asarray(end, dtype=float)), placed.ravel()])
    shared = np.zeros((len(mean), 3))
    shared[0, 0] = shared[1, 1] = shared[2, 2] = 1.0
    shared[0, 2], shared[1, 2] = -mean[1], mean[0]
    shared[3::2, 0] = shared[4::2, 1] = 1.0
    shared[3::2, 2], shared[4::2, 2] = -placed[:, 1], placed[:, 0]
    covariance = sigma**2 * np.eye(len(mean)) + warp**2 * shared @ shared.T
    if rng is not None:
        mean = mean + np.linalg.cholesky(covariance) @ rng.standard_normal(len(mean))
    return ClosedMap(
        mean, covariance, rotate(T_frame_plan[2], normals), np.full(len(placed), sightings), SPACING
    )
