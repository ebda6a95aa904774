"""Crowded samples of a joined map: put onto their curve, and all but the farthest apart dropped (section 3.3)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from kalmap.geometry.curves import Curve
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.stretches import Stretch, null_space

CROWDED = 0.75  # spacings between samples below which they crowd
SAGITTA = 0.01  # m, how far a contour may bend away from the line between two samples
SHRINK = 0.9  # of the threshold, while too few samples are kept


def thinned(joined: ClosedMap, stretches: list[Stretch]) -> ClosedMap:
    """The map with every crowded stretch thinned to its spacing. The curves are in the map's frame.

    First the samples of a crowded stretch are constrained to its curve: projected onto what curves of its order can
    be, by least squares (Simon & Simon 2010, with the identity for a weight). A constraint without noise would count
    once more what the signed distances have already said; the projection only averages: x <- (I - A) x, and the
    covariance along with it, exactly. Then the rows and columns of those not kept are deleted.
    """
    crowded = [each for each in stretches if _is_crowded(joined, each)]
    if not crowded:
        return joined
    mean, covariance, normals = joined.mean.copy(), joined.covariance, joined.normals.copy()
    operators, shift = [], np.zeros(len(mean))
    dropped: list[np.ndarray] = []
    sightings = joined.sightings.copy()
    for each in crowded:
        operator, step = _onto_curve(joined, each)
        operators.append(operator)
        shift += step
    whole = sum(operators[1:], operators[0])
    mean -= shift
    half = covariance - whole @ covariance
    covariance = half - (whole @ half.T).T
    covariance = 0.5 * (covariance + covariance.T)
    points = mean[3:].reshape(-1, 2)
    for each in crowded:
        slope = each.curve.gradient(points[each.rows])
        normals[each.rows] = slope / np.hypot(*slope.T)[:, None]
        kept = farthest_first(points[each.rows], _wanted(points[each.rows], each.curve, joined.spacing))
        gone = np.setdiff1d(np.arange(len(each.rows)), kept)
        nearest = np.hypot(*(points[each.rows][gone][:, None] - points[each.rows][kept][None]).T).argmin(
            axis=0
        )
        np.add.at(sightings, each.rows[kept][nearest], joined.sightings[each.rows[gone]])
        dropped.append(each.rows[gone])
    stay = np.setdiff1d(np.arange(len(points)), np.concatenate(dropped))
    columns = np.concatenate([np.arange(3), (3 + 2 * stay[:, None] + np.arange(2)).ravel()])
    return ClosedMap(
        mean[columns],
        np.ascontiguousarray(covariance[np.ix_(columns, columns)]),
        normals[stay],
        sightings[stay],
        joined.spacing,
    )


def farthest_first(points: np.ndarray, count: int) -> np.ndarray:
    """Rows, ascending, of `count` points or more, in order along a contour: its ends first, then whatever lies farther
    than D0 from all that are kept, D0 lowered until enough are (steps 1 to 3 of section 3.3)."""
    kept = [0, len(points) - 1] if len(points) > 1 else [0]
    apart = np.min([np.hypot(*(points[row] - points).T) for row in kept], axis=0)  # to the nearest one kept
    threshold = float(np.hypot(*np.diff(points, axis=0).T).sum())
    while len(kept) < min(count, len(points)) and threshold > 1e-6:
        row = 0
        while len(kept) < count and len(farther := np.flatnonzero(apart[row:] > threshold)):
            row += int(farther[0])
            kept.append(row)
            apart = np.minimum(apart, np.hypot(*(points[row] - points).T))
        threshold *= SHRINK
    return np.array(sorted(kept))


def _is_crowded(joined: ClosedMap, stretch: Stretch) -> bool:
    points = joined.samples[stretch.rows]
    apart = np.hypot(*np.diff(points, axis=0).T)
    return len(points) > _wanted(points, stretch.curve, joined.spacing) and bool(
        (apart < CROWDED * _spacing(points, stretch.curve, joined.spacing)).any()
    )


def _spacing(points: np.ndarray, curve: Curve, spacing: float) -> float:
    """m between samples of such a curve: less where it bends."""
    bend = float(np.abs(curve.curvature(points)).max()) if curve.order > 1 else 0.0
    return max(0.05, min(spacing, float(np.sqrt(8.0 * SAGITTA / max(bend, 1e-9)))))


def _wanted(points: np.ndarray, curve: Curve, spacing: float) -> int:
    """How many samples stand for a stretch."""
    length = float(np.hypot(*(points[-1] - points[0])))
    if curve.order > 1:
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    return max(2, int(np.ceil(length / _spacing(points, curve, spacing))) + 1)


def _onto_curve(joined: ClosedMap, stretch: Stretch) -> tuple[csr_array, np.ndarray]:
    """A (n, n) sparse, and the step (n,) that it is the derivative of: away from what no curve of that order is."""
    points = joined.samples[stretch.rows]
    value, slope = stretch.curve.distance_and_gradient(points)
    slope = slope / np.hypot(*slope.T)[:, None]
    left = null_space(stretch.curve, points)
    onto = left @ left.T
    count = len(points)
    columns = (3 + 2 * stretch.rows[:, None] + np.arange(2)).ravel()
    matrix = np.einsum("ij,ia,jb->iajb", onto, slope, slope).reshape(2 * count, 2 * count)
    size = len(joined.mean)
    rows, cols = np.repeat(columns, 2 * count), np.tile(columns, 2 * count)
    step = np.zeros(size)
    step[columns] = ((onto @ value)[:, None] * slope).ravel()
    return csr_array((matrix.ravel(), (rows, cols)), shape=(size, size)), step
