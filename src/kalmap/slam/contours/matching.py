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
LEAST_SLOPE = 0.005  # rad, how far contours are straight from one sample to the next at best
CHANCE = 2.0  # standard deviations by which noise of the normals may hold a map more than it does on average
LEAST_KEPT = 0.05  # of the information in any direction, however much of it is noise of the normals
USED = 80  # points at most that a relation is estimated from


class Overlay(msgspec.Struct, frozen=True):
    """One map laid over another.

    pose: (3,) T_first_second. covariance: (3, 3), from the joint covariances of both maps. matched: m of the second's
    contour that lies on the first's; agreement: the share of what lies beside the first's contours that lies on them.
    with_end: (3, 3), covariance of the pose's error (rows) with that of the first map's end, both being of one map.
    distance: squared Mahalanobis distance of the contours from each other, as it is left, and its degrees of freedom.
    Of places by points (`sketch`), points stand for contour, a decimetre each, and the degrees of freedom are 0.
    """

    pose: np.ndarray
    covariance: np.ndarray
    with_end: np.ndarray
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
    shift, covariance, with_end, distance = _relation(first, second, pose, rows, beside[rows])
    return Overlay(pose + shift, covariance, with_end, matched * 0.1, matched / near, distance, len(rows) - 3)


def _relation(
    first: ClosedMap, second: ClosedMap, pose: np.ndarray, rows: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Generalised least squares of the relation between two maps, from the points that lie on each other's contours.

    Every distance depends on four samples; their covariances, and through them what is uncertain about the inside of
    either map, make the covariance of the distances. Returns the correction (3,), its covariance, that with the first
    map's end, and the distance.
    """
    a, b = first.shape, second.shape
    lines, pieces = a.segments[beside], b.segment[rows]
    arms = rotate(pose[2], b.points[rows])
    placed, base = arms + pose[:2], lines[:, :2]
    way = lines[:, 2:] - base
    normals, slopes = _shared_normals(
        (a.normals[beside], rotate(pose[2], b.normals[pieces])),
        (_of_directions(first, beside), _of_directions(second, pieces)),
    )
    u = np.clip(((placed - base) * way).sum(axis=1) / (way * way).sum(axis=1), 0.0, 1.0)
    offsets = ((placed - base - u[:, None] * way) * normals).sum(axis=1)
    design = np.column_stack([normals, normals[:, 1] * arms[:, 0] - normals[:, 0] * arms[:, 1]])
    spread = SIGMA**2 * np.eye(len(rows))
    on_first = _points(first, beside, np.column_stack([1.0 - u, u]), normals)
    share = b.share[rows]
    on_second = _points(second, pieces, np.column_stack([1.0 - share, share]), rotate(-pose[2], normals))
    spread += on_first.covariance() + on_second.covariance()
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.column_stack([design, offsets]))
    information = white[:, :3].T @ white[:, :3] + np.diag(
        [1e-4, 1e-4, 1e-4]
    )  # 100 m and 57 deg: not held at all
    covariance = np.linalg.inv(information)
    shift = -covariance @ white[:, :3].T @ white[:, 3]
    left = white[:, 3] + white[:, :3] @ shift
    with_end = covariance @ white[:, :3].T @ np.linalg.solve(root, on_first.with_end())
    loosened = _loosened(
        design, slopes * (1.0 + CHANCE * math.sqrt(2.0 / len(np.unique(beside)))), normals, arms
    )
    return shift, loosened @ covariance @ loosened.T, with_end, float(left @ left)


def _shared_normals(
    normals: tuple[np.ndarray, np.ndarray], slopes: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Normals (M, 2) of contours that both maps know, by what each knows of them, and variances (M,) of their angles.

    normals: (M, 2) and slopes: (M,) rad^2 of either map, which are independent.
    """
    share = slopes[0] / (slopes[0] + slopes[1])
    mean = normals[0] + share[:, None] * (normals[1] - normals[0])
    return mean / np.hypot(*mean.T)[:, None], share * slopes[1]


def _loosened(design: np.ndarray, slopes: np.ndarray, normals: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """(3, 3), by which errors of a relation grow as its design (M, 3) is itself measured.

    Normals that err by an angle, slopes (M,) rad^2, seem to hold a map along its walls. Their noise makes up `false` of
    what the distances say of the pose, and an estimate goes only as much of its way as is left (Fuller 1987,
    Measurement Error Models, section 1.1).
    """
    turned = np.column_stack([-normals[:, 1], normals[:, 0]])
    derivative = np.column_stack([turned, turned[:, 1] * arms[:, 0] - turned[:, 0] * arms[:, 1]])
    false = derivative.T @ (slopes[:, None] * derivative)
    half = np.linalg.cholesky(design.T @ design + 1e-9 * np.eye(3))
    share, axes = np.linalg.eigh(np.linalg.solve(half, np.linalg.solve(half, false).T))
    kept = np.maximum(LEAST_KEPT, 1.0 - share)
    return np.asarray(np.linalg.solve(half.T, (axes / kept) @ axes.T @ half.T))


def _of_directions(closed: ClosedMap, segments: np.ndarray) -> np.ndarray:
    """(M,) rad^2, variances of the directions of segments (M,), by the map's own covariance."""
    ends = closed.shape.segments[segments]
    length = np.hypot(*(ends[:, 2:] - ends[:, :2]).T)
    across = closed.shape.normals[segments] / length[:, None]
    entries = (3 + 2 * closed.shape.pairs[segments][:, :, None] + np.arange(2)).reshape(-1, 4)
    own = closed.covariance[entries[:, :, None], entries[:, None, :]]
    rows = np.column_stack([-across, across])
    return np.asarray(np.maximum(LEAST_SLOPE**2, np.einsum("mi,mij,mj->m", rows, own, rows)))


class _Read(msgspec.Struct, frozen=True):
    """M numbers that are linear in a map's samples. rows: (M, K) by the entries (K,) of its mean."""

    closed: ClosedMap
    rows: np.ndarray
    entries: np.ndarray

    def covariance(self) -> np.ndarray:
        """(M, M)."""
        return np.asarray(
            self.rows @ self.closed.covariance[np.ix_(self.entries, self.entries)] @ self.rows.T
        )

    def with_end(self) -> np.ndarray:
        """(M, 3) covariance with the map's end."""
        return np.asarray(self.rows @ self.closed.covariance[self.entries, :3])


def _points(closed: ClosedMap, segments: np.ndarray, weights: np.ndarray, normals: np.ndarray) -> _Read:
    """Weighed sums of the two samples of each segment (M,), in the direction of normals (M, 2). weights: (M, 2)."""
    samples, inverse = np.unique(closed.shape.pairs[segments], return_inverse=True)
    inverse = inverse.reshape(-1, 2)
    entries = (3 + 2 * samples[:, None] + np.arange(2)).ravel()
    rows, at = np.zeros((len(segments), len(entries))), np.arange(len(segments))
    for end in (0, 1):
        rows[at, 2 * inverse[:, end]] = weights[:, end] * normals[:, 0]
        rows[at, 2 * inverse[:, end] + 1] = weights[:, end] * normals[:, 1]
    return _Read(closed, rows, entries)


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
