"""Corners of contour maps, and which corners of two maps are one (section 3.1 of Sun et al. 2010)."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy.sparse import csr_array

from kalmap.geometry.corners import corner
from kalmap.geometry.ellipses import chi_square, chi_square_2
from kalmap.geometry.se2 import rotate
from kalmap.slam.contours.closed import ClosedMap, neighbours
from kalmap.slam.contours.stacked import Constraint, Stacked, condition, difference
from kalmap.slam.contours.strands import strands

LEG, LEAST_LEG = 8, 4  # samples of a wall that a corner's line is fitted to: at most, at least
STRAIGHT = 0.02  # m, how far samples of a straight wall may lie off its line
APART = 1.6  # spacings from the end of a wall to the corner, at most
SHARPEST, BLUNTEST = math.radians(35.0), math.radians(145.0)  # turn between the two walls
GATE = chi_square_2(0.99)
SAME_WAY = 0.87  # cosine between normals of walls that may be one
DIFFERENT = 1.0  # m: beyond this, and a certainty of the maps, corners are never one


class MapCorner(msgspec.Struct, frozen=True, eq=False):
    """position: (2,) m. legs: rows of the samples of either wall, the second's normal to the left of the first's.
    normals: (2, 2) of the walls."""

    position: np.ndarray
    legs: tuple[np.ndarray, np.ndarray]
    normals: np.ndarray


def find_corners(samples: np.ndarray, normals: np.ndarray, spacing: float) -> list[MapCorner]:
    """Every place where the ends of two straight walls meet."""
    ends = _wall_ends(samples, normals, spacing)
    found = []
    for i in range(len(ends)):
        for j in range(i + 1, len(ends)):
            made = _corner_of(samples, normals, ends[i], ends[j], spacing)
            if made is not None:
                found.append(made)
    return found


def _wall_ends(samples: np.ndarray, normals: np.ndarray, spacing: float) -> list[np.ndarray]:
    """Rows of the straight run at either end of every wall, the outermost first."""
    found = []
    for rows in strands(neighbours(samples, normals, spacing), len(samples)):
        for piece in _straight(samples, rows):
            for end in (piece, piece[::-1]):
                if len(end) >= LEAST_LEG:
                    found.append(end[:LEG])
    return found


def _straight(samples: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """A strand cut where it bends: at the sample farthest from the chord, until all lie on lines."""
    if len(rows) < LEAST_LEG:
        return []
    points = samples[rows]
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][1]
    off = (points - centre) @ normal
    if np.abs(off).max() <= STRAIGHT:
        return [rows]
    way = points[-1] - points[0]
    chord = (points - points[0]) @ np.array([-way[1], way[0]]) / max(1e-9, float(np.hypot(*way)))
    cut = int(np.clip(np.abs(chord).argmax(), 1, len(rows) - 2))
    return [*_straight(samples, rows[: cut + 1]), *_straight(samples, rows[cut:])]


def _corner_of(
    samples: np.ndarray, normals: np.ndarray, one: np.ndarray, other: np.ndarray, spacing: float
) -> MapCorner | None:
    if (
        np.hypot(*(samples[one[0]] - samples[other[0]])) > 2.0 * APART * spacing
        or np.isin(one, other).sum() > 1
    ):
        return None
    facing = [_mean_normal(normals[rows]) for rows in (one, other)]
    turn = math.atan2(facing[0][0] * facing[1][1] - facing[0][1] * facing[1][0], float(facing[0] @ facing[1]))
    if not SHARPEST < abs(turn) < BLUNTEST:
        return None
    if turn < 0.0:
        one, other, facing = other, one, facing[::-1]
    try:
        made = corner(samples[one], samples[other])
    except ValueError:
        return None
    for rows in (one, other):
        if np.hypot(*(samples[rows[0]] - made.position)) > APART * spacing:
            return None
    return MapCorner(made.position, (one, other), np.array(facing))


def _mean_normal(normals: np.ndarray) -> np.ndarray:
    total = normals.sum(axis=0)
    return total / max(1e-9, float(np.hypot(*total)))


def same_corner(stacked: Stacked, mean: np.ndarray, one: MapCorner, other: MapCorner) -> Constraint:
    """h = c1 - (X_12 (+) c2) = 0 without noise, equation (13); other: of the second map.

    The corner of the second map is taken of its samples where they lie in the first's frame, which is the same.
    """
    places = np.concatenate([stacked.first(mean), stacked.placed(mean)])
    value, matrix = np.zeros(2), None
    for sign, each, behind in ((1.0, one, 0), (-1.0, other, stacked.counts[0])):
        rows = [leg + behind for leg in each.legs]
        made = corner(places[rows[0]], places[rows[1]])
        slopes = np.concatenate([made.first, made.second])
        read = stacked.rows(mean, np.repeat(np.concatenate(rows), 2), slopes.reshape(-1, 2))
        part = sign * (_sum_of(len(slopes)) @ read)
        value, matrix = value + sign * made.position, part if matrix is None else matrix + part
    return Constraint(csr_array(matrix), value, np.zeros((2, 2)))


def _sum_of(count: int) -> csr_array:
    """(2, 2 K): adds up what K samples do to either coordinate."""
    number = np.arange(2 * count)
    return csr_array((np.ones(2 * count), (number % 2, number)), shape=(2, 2 * count))


def match_corners(
    stacked: Stacked,
    mean: np.ndarray,
    first: list[MapCorner],
    second: list[MapCorner],
    widen: float,
) -> list[tuple[int, int]]:
    """Pairs of corners that are one: each the other's nearest within the gate, and compatible together.

    widen: factor on the covariance, for what the maps' own leaves out.
    """
    squared = np.full((len(first), len(second)), np.inf)
    prior = stacked.covariance
    for i, one in enumerate(first):
        for j, other in enumerate(second):
            if np.hypot(*(one.position - mean[:2] - rotate(mean[2], other.position))) > DIFFERENT + 1.0:
                continue  # where it was before anything was known is near enough to tell
            if (one.normals * rotate(mean[2], other.normals)).sum(axis=1).min() < SAME_WAY:
                continue
            constraint = same_corner(stacked, mean, one, other)
            if np.hypot(*constraint.value) > DIFFERENT:
                continue
            columns = np.unique(constraint.matrix.indices)
            part = constraint.matrix[:, columns].toarray()
            spread = widen * part @ prior[np.ix_(columns, columns)] @ part.T + 1e-6 * np.eye(2)
            off = constraint.value + part @ difference(stacked.mean, mean)[columns]
            squared[i, j] = off @ np.linalg.solve(spread, off)
    pairs = [(squared[i].min(), i, int(squared[i].argmin())) for i in range(len(first)) if len(second)]
    pairs = [(d, i, j) for d, i, j in pairs if d < GATE and squared[:, j].argmin() == i]
    return _compatible(stacked, mean, first, second, sorted(pairs), widen)


def _compatible(
    stacked: Stacked,
    mean: np.ndarray,
    first: list[MapCorner],
    second: list[MapCorner],
    pairs: list[tuple[float, int, int]],
    widen: float,
) -> list[tuple[int, int]]:
    """The pairs, the likeliest first, that are jointly compatible with those before (Neira & Tardos 2001)."""
    kept: list[tuple[int, int]] = []
    constraints: list[Constraint] = []
    for _, i, j in pairs:
        tried = [*constraints, same_corner(stacked, mean, first[i], second[j])]
        solved = condition(stacked.mean, stacked.covariance, tried, mean)
        if solved.distance <= widen * chi_square(0.99, max(1, solved.freedom)):
            kept.append((i, j))
            constraints = tried
    return kept


def corners_of(closed: ClosedMap) -> list[MapCorner]:
    """The corners of a map in its own frame."""
    return find_corners(closed.samples, closed.normals, closed.spacing)
