"""Ground plans: what is free is carved out of solid ground, and walls are where the two meet."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

Box = tuple[float, float, float, float]
"""x low, y low, x high, y high in m."""

Point = tuple[float, float]

_MILLIMETRES = 1000.0


def outline(free: list[Box], solid: list[Box] | None = None, replaced: list[Box] | None = None) -> np.ndarray:
    """(S, 4) m: the walls around what the boxes `free` leave open together, minus the boxes `solid`.

    Walls inside a box of `replaced` are left out: a curve takes their place. Coordinates are taken to the
    millimetre. Walls in line with each other come as one.
    """
    solid, replaced = solid or [], replaced or []
    edges = np.rint(np.array([*free, *solid, *replaced]).reshape(-1, 4) * _MILLIMETRES).astype(np.int64)
    xs, ys = np.unique(edges[:, [0, 2]]), np.unique(edges[:, [1, 3]])
    open_, curved = (np.zeros((len(xs) + 1, len(ys) + 1), dtype=bool) for _ in range(2))
    for number, (x0, y0, x1, y1) in enumerate(edges):
        cells = (
            slice(np.searchsorted(xs, x0) + 1, np.searchsorted(xs, x1) + 1),
            slice(np.searchsorted(ys, y0) + 1, np.searchsorted(ys, y1) + 1),
        )
        if number < len(free) + len(solid):
            open_[cells] = number < len(free)
        else:
            curved[cells] = True
    walls = [*_runs(open_, curved, xs, ys)]
    walls += [(a, b, c, d) for b, a, d, c in _runs(open_.T, curved.T, ys, xs)]
    return np.array(walls, dtype=float).reshape(-1, 4) / _MILLIMETRES


def _runs(
    open_: np.ndarray, curved: np.ndarray, xs: np.ndarray, ys: np.ndarray
) -> list[tuple[int, int, int, int]]:
    """Walls along x: stretches in which a free cell lies above a solid one, or the other way round."""
    kept = open_ & ~curved
    wall = (kept[:, 1:] & ~open_[:, :-1]) | (kept[:, :-1] & ~open_[:, 1:])
    found = []
    for row in range(wall.shape[1]):
        steps = np.diff(np.concatenate([wall[:, row].astype(np.int8), [0]]), prepend=np.int8(0))
        for first, last in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)):
            found.append((int(xs[first - 1]), int(ys[row]), int(xs[last - 1]), int(ys[row])))
    return found


def arc(
    x: float, y: float, radius: float, first_deg: float, last_deg: float, sagitta: float = 1e-4
) -> np.ndarray:
    """(n, 4) m: a circular wall as a chain of chords that are nowhere farther than `sagitta` m from it."""
    angle = math.radians(last_deg - first_deg)
    count = max(3, math.ceil(abs(angle) / (2.0 * math.acos(max(0.0, 1.0 - sagitta / radius)))))
    angles = math.radians(first_deg) + angle * np.arange(count + 1) / count
    points = np.array([x, y]) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.column_stack([points[:-1], points[1:]])


def box_walls(x: float, y: float, width: float, depth: float, heading: float) -> np.ndarray:
    """(4, 4) m: the sides of a box about (x, y), `width` along `heading` rad and `depth` across."""
    c, s = math.cos(heading), math.sin(heading)
    corners = 0.5 * np.array([[width, depth], [-width, depth], [-width, -depth], [width, -depth]])
    corners = np.array([x, y]) + corners @ np.array([[c, s], [-s, c]])
    return np.column_stack([corners, np.roll(corners, -1, axis=0)])


def corridor(points: list[Point], width: float, closed: bool = True) -> list[Box]:
    """One box a leg of an axis-parallel way along the middle of a corridor; corners belong to both legs."""
    legs = pairwise([*points, points[0]] if closed else points)
    half = 0.5 * width
    return [
        (min(a, c) - half, min(b, d) - half, max(a, c) + half, max(b, d) + half) for (a, b), (c, d) in legs
    ]


def meets(box: Box, others: list[Box], margin: float = 0.0) -> bool:
    """Whether a box comes nearer than `margin` m to any other."""
    x0, y0, x1, y1 = box
    return any(
        x0 < c + margin and a - margin < x1 and y0 < d + margin and b - margin < y1 for a, b, c, d in others
    )


def along(points: np.ndarray, step: float, closed: bool = False) -> np.ndarray:
    """(n, 2): places on the way through points (K, 2), at most `step` m apart, every point among them."""
    points = np.asarray(points, dtype=float)
    ends = np.concatenate([points, points[:1]]) if closed else points
    pieces = [
        start + (end - start) * (np.arange(count) / count)[:, None]
        for start, end in pairwise(ends)
        if (count := math.ceil(math.hypot(*(end - start)) / step))
    ]
    return np.concatenate([*pieces, ends[-1:]])
