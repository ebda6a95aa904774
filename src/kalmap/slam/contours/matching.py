"""Laying one closed map over another: the places worth a look, and how well, and how surely, each of them fits."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import rotate
from kalmap.kernels import correlate
from kalmap.slam.contours.closed import CELL, ClosedMap

LIMITS = np.array([0.3, 0.08])  # m, how far apart two contours that are one may lie, at first and in the end
ROUNDS = 30
SIGMA = 0.02  # m, how far a chord between samples lies off the contour
PLACES = 6  # of the search that are looked at closely
LEAST = 0.12  # share of a perfect fit below which a place is none
APART = 1.0  # m between two answers of the search
USED = 80  # points at most that a relation is estimated from


class Overlay(msgspec.Struct, frozen=True):
    """One map laid over another.

    pose: (3,) T_first_second. covariance: (3, 3), from the joint covariances of both maps. matched: m of the second's
    contour that lies on the first's; agreement: the share of what lies beside the first's contours that lies on them.
    distance: squared Mahalanobis distance of the contours from each other, as it is left, and its degrees of freedom.
    """

    pose: np.ndarray
    covariance: np.ndarray
    matched: float
    agreement: float
    distance: float
    freedom: int


def overlay(
    first: ClosedMap, second: ClosedMap, guess: np.ndarray, least: tuple[float, float] = (2.0, 0.0)
) -> Overlay | None:
    """Lay `second` over `first` from where it is thought to be; None where they have nothing to be laid on.

    least: m of contour that must match, and the share that must agree: less is none, and costs no covariance.
    """
    a, b = first.shape, second.shape
    pose = np.array(guess, dtype=float)
    beside, offsets = np.full(len(b.points), -1, dtype=np.int64), np.zeros(len(b.points))
    matched, near, _ = correlate.align_points(
        pose, b.points, b.point_normals, a.segments, a.normals, a.nearest, a.low, CELL, LIMITS, ROUNDS, SIGMA,
        beside, offsets,
    )  # fmt: skip
    if matched < max(20, 10.0 * least[0]) or matched < least[1] * near:
        return None
    pose[2] = wrap(pose[2])
    rows = np.flatnonzero(beside >= 0)
    rows = rows[np.linspace(0, len(rows) - 1, min(USED, len(rows))).astype(int)]
    shift, covariance, distance = _relation(first, second, pose, rows, beside[rows])
    return Overlay(pose + shift, covariance, matched * 0.1, matched / near, distance, len(rows) - 3)


def _relation(
    first: ClosedMap, second: ClosedMap, pose: np.ndarray, rows: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Generalised least squares of the relation between two maps, from the points that lie on each other's contours.

    Every distance depends on four samples; their covariances, and through them what is uncertain about the inside of
    either map, make the covariance of the distances. Returns the correction (3,), its covariance and the distance.
    """
    a, b = first.shape, second.shape
    points, normals = b.points[rows], a.normals[beside]
    arms = rotate(pose[2], points)
    placed = arms + pose[:2]
    base, tip = a.segments[beside, :2], a.segments[beside, 2:]
    way = tip - base
    u = np.clip(((placed - base) * way).sum(axis=1) / (way * way).sum(axis=1), 0.0, 1.0)
    offsets = ((placed - base) * normals).sum(axis=1)
    design = np.column_stack([normals, normals[:, 1] * arms[:, 0] - normals[:, 0] * arms[:, 1]])
    spread = SIGMA**2 * np.eye(len(rows))
    spread += _of_segments(first, a.pairs[beside], u, normals)
    spread += _of_segments(second, b.pairs[b.segment[rows]], b.share[rows], rotate(-pose[2], normals))
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.column_stack([design, offsets]))
    information = white[:, :3].T @ white[:, :3] + np.diag(
        [1e-4, 1e-4, 1e-4]
    )  # 100 m and 57 deg: not held at all
    covariance = np.linalg.inv(information)
    shift = -covariance @ white[:, :3].T @ white[:, 3]
    left = white[:, 3] + white[:, :3] @ shift
    return shift, covariance, float(left @ left)


def _of_segments(closed: ClosedMap, pairs: np.ndarray, share: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(M, M) covariance of points along segments, in the direction of the normals, by the map's own covariance."""
    entries, inverse = np.unique(pairs, return_inverse=True)
    inverse = inverse.reshape(-1, 2)
    columns = (3 + 2 * entries[:, None] + np.arange(2)).ravel()
    block = closed.covariance[np.ix_(columns, columns)]
    rows = np.zeros((len(pairs), len(columns)))
    at = np.arange(len(pairs))
    for end, weight in ((0, 1.0 - share), (1, share)):
        rows[at, 2 * inverse[:, end]] = weight * normals[:, 0]
        rows[at, 2 * inverse[:, end] + 1] = weight * normals[:, 1]
    return np.asarray(rows @ block @ rows.T)


def search(
    first: ClosedMap, second: ClosedMap, guess: np.ndarray, half: float, turn: float
) -> list[np.ndarray]:
    """Places of `second` on `first`, best first, within `half` m and `turn` rad of where it is thought to be."""
    a, b = first.shape, second.shape
    if not len(a.points) or not len(b.points):
        return []
    points = b.points[::3] - b.centre
    centre = guess[:2] + rotate(guess[2], b.centre)
    step = min(0.03, 1.5 * CELL / max(1.0, b.radius))
    angles = guess[2] + step * np.arange(-math.ceil(turn / step), math.ceil(turn / step) + 1)
    values, places = np.zeros(PLACES), np.zeros((PLACES, 3), dtype=np.int64)
    count = correlate.search_places(
        a.levels, a.low, CELL, points, b.point_normals[::3], centre, angles, math.ceil(half / CELL), LEAST,
        APART / CELL, values, places,
    )  # fmt: skip
    found = []
    for angle, row, column in places[:count]:
        at = centre + CELL * np.array([column, row]) - rotate(angles[angle], b.centre)
        found.append(np.array([at[0], at[1], float(wrap(angles[angle]))]))
    return found
