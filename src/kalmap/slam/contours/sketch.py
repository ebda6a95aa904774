"""Maps of rooms that show hardly any contour, laid over each other by what their scans saw point by point.

Legs of tables, shelves and clutter are a few points in every scan, and samples of contours stand for hardly any of
them. The points can be laid on each other, and on the space that the other map's scans saw to be free: a correlative
search within what the drive allows (Olson 2009), then the nearest points of both, along lines only across them
(Segal et al. 2009, Generalized-ICP).
"""

from __future__ import annotations

import math
from functools import cached_property

import msgspec
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import inverse, rotate
from kalmap.kernels.grid import trace_beams
from kalmap.records import Sweeps
from kalmap.slam.contours.belief import POINTS, is_elsewhere
from kalmap.slam.contours.leg import Leg, turned_by
from kalmap.slam.contours.matching import Overlay
from kalmap.slam.contours.seen import Rules
from kalmap.slam.contours.whole import whole_sweeps

MOST_CELLS = 4_000_000  # of a grid, 100 m x 100 m; a leg that needs more has odometry that jumps
# m from the end of a beam to the nearer one of its neighbours' ends: between these it is of a wall that has come apart
COARSE, TORN = 0.15, 0.75
CELL = 0.05  # m, of the grids
DENSE = 0.1  # m, side of the squares that hold one point each
HITS = 2  # scans that must have hit a cell for it to be solid
PASSES = 3  # scans that must have seen through a cell for it to be free
SHARE = 0.25  # of the scans that see through a cell, that must hit it
BESIDE = 0.15  # m: what is nearer to something solid is not taken for free
FACING = -0.5  # cosine between the sides from which two points were seen, below which they are not one
LIMITS = (
    0.3,
    0.25,
    0.2,
    0.15,
    0.12,
    0.1,
    0.1,
    0.1,
)  # m, how far apart two points that are one may lie, by rounds
LEAST_PAIRS = 10  # points that lie on points
NEAR = 0.2  # m: the points so near tell along what a point lies
LONG, THIN = 0.08, 0.45  # m, standard deviation along a line of points, and across it as a share of that
ACROSS = 0.04  # m, standard deviation of one point on another, across a line of points
ALONE = 0.06  # m, the same where there is no line
ONE = 0.2  # m: points that are nearer to each other are of one thing
BLUR = 0.07  # m: how much less a point on another one counts, the farther off it lies
LIKE, AGAINST = 0.1, 0.5  # m, blur of the search, and what a point in free space counts against
STEP, TURN = 0.1, 0.03  # m and rad, of the search
SEARCHED, PLACES = 300, 8  # points at most that are searched by, and places that are looked at closely
APART, APART_TURN = 0.25, 0.08  # m and rad between two of these
SAME, SAME_TURN = 0.05, 0.02  # m and rad within which two alignments are one
ASKED = 40  # points at most that are asked how their map errs there


class Sketch(msgspec.Struct, frozen=True, eq=False, dict=True):
    """What the scans of one map agree on, in its frame.

    points: (P, 2) m; facing: (P, 2) mean of the unit vectors towards the scanner. low: (2,) m, corner of the grids
    distance (H, W) m to what is solid and free (H, W).
    """

    points: np.ndarray
    facing: np.ndarray
    low: np.ndarray
    distance: np.ndarray
    free: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """(2,) of the points."""
        return np.asarray(self.points.mean(axis=0))

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        return cKDTree(self.points)

    @cached_property
    def information(self) -> np.ndarray:
        """(P, 2, 2) 1/m^2 on where a point lies that is the same thing: along lines there is none."""
        found = np.empty((len(self.points), 2, 2))
        for row, near in enumerate(self.tree.query_ball_point(self.points, NEAR)):
            spread = np.cov(self.points[near].T) if len(near) > 2 else np.zeros((2, 2))
            values, axes = np.linalg.eigh(spread)
            across, along = np.sqrt(np.maximum(values, 0.0))
            on_line = along > LONG and across < THIN * along
            weights = [1.0 / ACROSS**2, 0.0] if on_line else [1.0 / ALONE**2] * 2
            found[row] = (axes * weights) @ axes.T
        return found


class Laid(msgspec.Struct, frozen=True, eq=False):
    """A place of one sketch on another, and how many separate things lie on each other there.

    A corner of two walls is one thing: many rooms have such a corner, and it may lie on any of them.
    """

    overlay: Overlay
    things: int


def drawn(leg: Leg, rules: Rules) -> Sketch | None:
    """The sketch of a leg; None where its scans agree on nothing.

    Silence says nothing here: dark and slanting things bring nothing back either. What is so far away that the beams'
    points are more than `COARSE` apart is left out: a wall would be many things there.
    """
    sensor = rules.sensor
    sweeps = whole_sweeps([leg], np.zeros((1, 3)), rules, rules.calibration.mean)
    farthest = min(sensor.max_range, COARSE / _beam_spacing(sweeps))
    ends, towards = _ends(sweeps, sensor.min_range, farthest)
    if not len(ends):
        return None
    places = np.concatenate([sweeps.poses[:, :2], ends])
    low = np.floor(places.min(axis=0) / CELL) * CELL - CELL
    extent = np.ceil((places.max(axis=0) - low) / CELL) + 1.0
    if extent.prod() > MOST_CELLS:
        return None
    columns, rows = extent.astype(int)
    hits, passes, marks = (np.zeros((rows, columns), dtype=np.int32) for _ in range(3))
    scans = sweeps.scans
    trace_beams(
        np.ascontiguousarray(sweeps.poses), np.cumsum([0, *(len(scan.ranges) for scan in scans)], dtype=np.int64),
        np.concatenate([scan.ranges for scan in scans]), np.concatenate([scan.bearings for scan in scans]),
        np.array([sensor.min_range, farthest, 0.0]), low, CELL, hits, passes, marks,
    )  # fmt: skip
    solid = (hits >= HITS) & (hits > SHARE * passes)
    column, row = ((ends - low) / CELL).astype(np.int64).T
    kept = solid[row, column]
    if not kept.any():
        return None
    _, square, count = np.unique(
        np.floor(ends[kept] / DENSE), axis=0, return_inverse=True, return_counts=True
    )
    means = [np.bincount(square.ravel(), each) / count for each in (*ends[kept].T, *towards[kept].T)]
    distance = (distance_transform_edt(~solid) * CELL).astype(np.float32)
    free = (passes >= PASSES) & (hits == 0) & (distance > BESIDE)
    return Sketch(np.column_stack(means[:2]), np.column_stack(means[2:]), low, distance, free)


def _beam_spacing(sweeps: Sweeps) -> float:
    """rad, from one beam to the next; the median of all scans' means. Endless for single beams."""
    spans = [
        np.ptp(scan.bearings) / (len(scan.bearings) - 1) for scan in sweeps.scans if len(scan.bearings) > 1
    ]
    return max(1e-6, float(np.median(spans))) if spans else math.inf


def _ends(sweeps: Sweeps, nearest: float, farthest: float) -> tuple[np.ndarray, np.ndarray]:
    """(P, 2) m where beams ended between two ranges m, and unit vectors (P, 2) from there to the scanner.

    Without the ends on walls that are seen at such an angle that they are more than `COARSE` apart.
    """
    ends, towards = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for pose, scan in zip(sweeps.poses, sweeps.scans, strict=True):
        hit = (scan.ranges >= nearest) & (scan.ranges <= farthest)
        course = pose[2] + scan.bearings[hit]
        way = -np.column_stack([np.cos(course), np.sin(course)])
        end = pose[:2] - scan.ranges[hit, None] * way
        apart = np.hypot(*np.diff(end, axis=0).T)
        beside = np.minimum(np.concatenate([[np.inf], apart]), np.concatenate([apart, [np.inf]]))[: len(end)]
        kept = (beside <= COARSE) | (beside > TORN)
        ends.append(end[kept])
        towards.append(way[kept])
    return np.concatenate(ends), np.concatenate(towards)


def laid(
    first: tuple[Sketch, Leg],
    second: tuple[Sketch, Leg],
    guess: np.ndarray,
    half: float,
    turn: float,
    end: np.ndarray | None = None,
) -> list[Laid]:
    """The places of the second on the first within `half` m and `turn` rad of a guess (3,), best first.

    What overlays tell as contour is points here, each for `DENSE` m, and the lesser of both ways round; their `freedom`
    is 0. end: (3, 3) covariance of the first one's end, where the second begins there.
    """
    a, b = first[0], second[0]
    found: list[Laid] = []
    middle = b.middle
    for start in [guess, *_searched(a, b, guess, half, turn)]:
        pose, information, pairs = _aligned(a, b, start)
        if not len(pairs) or any(
            not is_elsewhere(pose, each.overlay.pose, SAME, SAME_TURN, middle) for each in found
        ):
            continue
        (one, into), (other, onto) = _fit(a, b, pose), _fit(b, a, inverse(pose))
        matched, agreement = min(one, other), min(one / (one + into), other / (other + onto))
        own = _carried(first[1], a.points[pairs[:, 0]], pose[:2])
        if end is not None:
            own = _within(own, end)
        back = turned_by(pose[2])
        covariance = (
            np.linalg.inv(information)
            + own
            + back @ _carried(second[1], b.points[pairs[:, 1]], np.zeros(2)) @ back.T
        )
        with_end = np.zeros((3, 3)) if end is None else own
        laid_so = Overlay(pose, covariance, with_end, matched, agreement, 0.0, 0)
        found.append(Laid(laid_so, _things(b.points[pairs[:, 1]])))
    found.sort(key=lambda each: _worth(each.overlay), reverse=True)
    if found:
        doubted = _doubted([each.overlay for each in found], middle)
        found[0] = msgspec.structs.replace(found[0], overlay=doubted)
    return found


def _things(points: np.ndarray) -> int:
    """How many things points (M, 2) are of: what is nearer to each other than `ONE` is one."""
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), ONE, output_type="coo_matrix")
    return int(connected_components(near, directed=False)[0])


def _worth(place: Overlay) -> float:
    return place.matched * place.agreement


def _doubted(places: list[Overlay], middle: np.ndarray) -> Overlay:
    """The best place, less sure by the others about it that are nearly as good, of which any may be the right one."""
    best = places[0]
    spread = best.covariance.copy()
    for other in places[1:]:
        if _worth(other) > POINTS.rival * _worth(best) and not is_elsewhere(
            other.pose, best.pose, about=middle
        ):
            shift = other.pose - best.pose
            shift[2] = wrap(shift[2])
            spread += np.outer(shift, shift)
    return msgspec.structs.replace(best, covariance=spread)


def _fit(a: Sketch, b: Sketch, pose: np.ndarray) -> tuple[float, float]:
    """m of b's points that lie on a's, the nearer the more, and m of those that stand where a saw free space."""
    points = pose[:2] + rotate(pose[2], b.points)
    away = _pairs(a, b, pose, 2.0 * LIMITS[-1])[2]
    on = np.exp(-0.5 * (away / BLUR) ** 2).sum()
    return max(1e-9, DENSE * float(on)), DENSE * float(_at(a.free, a.low, points, False).sum())


def _pairs(a: Sketch, b: Sketch, pose: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of b's points that lie within `limit` m of one of a's that was seen from the same side, its row, and how
    far off they lie m."""
    away, nearest = a.tree.query(pose[:2] + rotate(pose[2], b.points), distance_upper_bound=limit)
    rows = np.flatnonzero(np.isfinite(away))
    sides = (a.facing[nearest[rows]] * rotate(pose[2], b.facing[rows])).sum(axis=1)
    rows = rows[sides > FACING]
    return rows, nearest[rows], away[rows]


def _at(grid: np.ndarray, low: np.ndarray, points: np.ndarray, outside: float | bool) -> np.ndarray:
    """(...,) what a grid (H, W) holds at points (..., 2)."""
    cells = np.floor((points - low) / CELL).astype(np.int64)
    inside = (cells >= 0).all(axis=-1) & (cells[..., 0] < grid.shape[1]) & (cells[..., 1] < grid.shape[0])
    cells = np.where(inside[..., None], cells, 0)
    return np.asarray(np.where(inside, grid[cells[..., 1], cells[..., 0]], outside))


def _searched(a: Sketch, b: Sketch, guess: np.ndarray, half: float, turn: float) -> list[np.ndarray]:
    """Poses (3,) worth a close look, best first: every shift and turn is tried."""
    like = np.exp(-0.5 * (a.distance / LIKE) ** 2) - AGAINST * a.free
    points, middle = b.points[:: math.ceil(len(b.points) / SEARCHED)], b.middle
    centre = guess[:2] + rotate(guess[2], middle)
    steps = STEP * np.arange(-math.ceil(half / STEP), math.ceil(half / STEP) + 1)
    turns = TURN * np.arange(-math.ceil(turn / TURN), math.ceil(turn / TURN) + 1)
    shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    values = np.empty((len(turns), len(shifts)))
    for row, by in enumerate(turns):
        placed = shifts + centre + rotate(guess[2] + by, points - middle)
        values[row] = _at(like, a.low, placed, 0.0).sum(axis=1)
    kept: list[np.ndarray] = []
    for at in np.argsort(-values, axis=None, kind="stable"):
        row, column = np.unravel_index(at, values.shape)
        place = np.array([*shifts[column, 0], turns[row]])
        if all(is_elsewhere(place, each, APART, APART_TURN) for each in kept):
            kept.append(place)
            if len(kept) == PLACES:
                break
    headings = wrap(guess[2] + np.array([each[2] for each in kept]))
    return [
        np.array([*(centre + each[:2] - rotate(heading, middle)), heading])
        for each, heading in zip(kept, headings, strict=True)
    ]


def _aligned(a: Sketch, b: Sketch, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where b's points lie best on a's, from a pose (3,) on: the pose, its information (3, 3) and the pairs (M, 2)."""
    pose, information, pairs = start.copy(), np.zeros((3, 3)), np.zeros((0, 2), dtype=np.int64)
    for limit in LIMITS:
        rows, nearest, _ = _pairs(a, b, pose, limit)
        if len(rows) < LEAST_PAIRS:
            return start, information, pairs[:0]
        pairs = np.column_stack([nearest, rows])
        arms, weights = rotate(pose[2], b.points[rows]), a.information[nearest]
        design = np.zeros((len(rows), 2, 3))
        design[:, 0, 0] = design[:, 1, 1] = 1.0
        design[:, 0, 2], design[:, 1, 2] = -arms[:, 1], arms[:, 0]
        weighed = np.swapaxes(design, 1, 2) @ weights
        information = (weighed @ design).sum(axis=0) + np.diag([1e-2, 1e-2, 1e-2])
        off = a.points[nearest] - pose[:2] - arms
        pose = pose + np.linalg.solve(information, (weighed @ off[:, :, None]).sum(axis=0)[:, 0])
        pose[2] = wrap(pose[2])
    return pose, information, pairs


def _carried(leg: Leg, points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(3, 3) covariance of the pose of a frame at `origin` (2,) m that is held by a map's points (M, 2), by the map's
    own errors.

    A point errs as the pose of the leg nearest to it does, with which it was turned; the mean over the points.
    """
    _, rows = cKDTree(leg.poses[:, :2]).query(points[:: math.ceil(len(points) / ASKED)])
    arms = origin - leg.poses[rows, :2]
    lever = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    lever[:, 0, 2], lever[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return np.asarray((lever @ leg.covariances[rows] @ np.swapaxes(lever, 1, 2)).mean(axis=0))


def _within(covariance: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(3, 3) the covariance, but in no direction wider than the other: an end errs as the way to it does, and more."""
    root = np.linalg.cholesky(other)
    inner = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, axes = np.linalg.eigh(0.5 * (inner + inner.T))
    axes = root @ axes
    return np.asarray((axes * np.minimum(values, 1.0)) @ axes.T)
