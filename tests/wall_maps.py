"""Closed maps of straight walls with honest errors: what a drive along them would have left, without the drive."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.se2 import compose, inverse, quarter_turn, rotate
from kalmap.slam.contours.closed import ClosedMap

ROOM = np.array([[0, 0, 6, 0], [6, 0, 6, 4], [6, 4, 0, 4], [0, 4, 0, 0]], dtype=float)
"""(4, 4): walls seen from inside, anticlockwise."""


def wall_samples(walls: np.ndarray, spacing: float, offset: float, low: float, high: float):
    """Points and normals (towards the left of each wall) of walls between two values of x, every `spacing` m."""
    points, normals = [], []
    for ax, ay, bx, by in walls:
        way = np.array([bx - ax, by - ay])
        length = np.hypot(*way)
        at = np.arange(offset, length - 0.05, spacing)
        on = np.array([ax, ay]) + at[:, None] * way / length
        on = on[(on[:, 0] >= low) & (on[:, 0] <= high)]
        points.append(on)
        normals.append(np.tile(quarter_turn(way / length), (len(on), 1)))
    return np.concatenate(points), np.concatenate(normals)


def wall_map(
    rng: np.random.Generator | None,
    start: np.ndarray,
    end: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    drift=(0.03, 0.03, 0.004),
    noise: float = 0.005,
    knots: int = 4,
    spacing: float = 0.3,
) -> ClosedMap:
    """The map of a drive from pose `start` to `end` that saw `points` (world): errors grow along the way.

    The way has `knots` parts, each adding an error of deviations `drift`; a sample has the pose's error of the part in
    which it was founded (by its order along the way), and noise across its wall. Mean off by a draw of exactly that
    covariance; rng None: no error.
    """
    T_start_end = compose(inverse(start), end)
    own = compose(inverse(start), np.column_stack([points, np.zeros(len(points))]))[:, :2]
    facing = rotate(-start[2], normals)
    mean = np.concatenate([T_start_end, own.ravel()])
    way = T_start_end[:2] / max(1e-9, np.hypot(*T_start_end[:2]))
    share = np.clip((own @ way) / max(1e-9, np.hypot(*T_start_end[:2])), 0.0, 1.0)
    part = np.minimum((share * knots).astype(int), knots - 1)
    root = np.zeros((len(mean), 3 * knots + len(points)))
    for k in range(knots):
        pivot = T_start_end[:2] * k / knots
        columns = slice(3 * k, 3 * k + 3)
        root[:3, columns] = np.diag(drift)
        root[:2, 3 * k + 2] = quarter_turn(T_start_end[:2] - pivot) * drift[2]
        for i in np.flatnonzero(part >= k):
            root[3 + 2 * i : 5 + 2 * i, 3 * k : 3 * k + 2] = np.diag(drift[:2])
            root[3 + 2 * i : 5 + 2 * i, 3 * k + 2] = quarter_turn(own[i] - pivot) * drift[2]
    for i in range(len(points)):
        root[3 + 2 * i : 5 + 2 * i, 3 * knots + i] = noise * facing[i]
    if rng is not None:
        mean = mean + root @ rng.standard_normal(root.shape[1])
    return ClosedMap(mean, root @ root.T, facing, np.full(len(points), 5), spacing)


MIDDLE = np.array([3.0, 2.1, 0.1])
"""Where the first map of `room_pair` ends and the second begins."""
LAST = np.array([4.9, 1.7, 0.5])


def room_pair(rng: np.random.Generator | None, **settings) -> tuple[ClosedMap, ClosedMap]:
    """Two maps of a room, both of which show its middle; the first starts at the world's origin's own axes."""
    start = np.array([0.8, 2.0, 0.0])
    first = wall_map(rng, start, MIDDLE, *wall_samples(ROOM, 0.3, 0.1, -1.0, 4.4), **settings)
    second = wall_map(rng, MIDDLE, LAST, *wall_samples(ROOM, 0.3, 0.23, 1.4, 7.0), **settings)
    return first, second
