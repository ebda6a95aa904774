"""How well a contour map fits: to the scans it was made from, to the true walls, and end to start of the drive."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.evaluation import trajectory
from kalmap.geometry.alignment import apply
from kalmap.geometry.segments import segment_distances
from kalmap.records import Contours, Reference

CUTOFF = 0.5
"""m: a scan point farther from every contour shows something that the map does not hold."""
MOST_POINTS = 200_000


class Crispness(msgspec.Struct, frozen=True):
    """Distances of scan points to the contours, m, of those within the cut-off; None without any.

    points: how many were measured. beyond: share of them farther than the cut-off, None without points.
    """

    mean: float | None
    median: float | None
    p95: float | None
    points: int
    beyond: float | None


def crispness(points: np.ndarray, contours: Contours, cutoff: float = CUTOFF) -> Crispness:
    """How far scan points (P, 2), at their final places, lie from the contours, drawn as lines through their samples.

    Walls that were mapped twice, or smeared, show here without any truth. Of more than `MOST_POINTS` points every
    second, third, ... is measured.
    """
    points = points[:: max(1, math.ceil(len(points) / MOST_POINTS))]
    distances = segment_distances(points, contours.segments(), cutoff)
    near = distances[np.isfinite(distances)]
    mean, median, p95 = _summary(near)
    return Crispness(mean, median, p95, len(points), 1.0 - len(near) / len(points) if len(points) else None)


class MapError(msgspec.Struct, frozen=True):
    """Distances of the contours' samples to the true walls, m; None without any."""

    mean: float | None
    rms: float | None
    p95: float | None


def map_error(contours: Contours, reference: Reference, matched: trajectory.Matched) -> MapError | None:
    """How far the samples lie from `reference.walls`, None where these are not known.

    Where the reference is in a frame of its own, the map is first moved as the trajectory's alignment says.
    """
    if not len(reference.walls):
        return None
    positions = contours.positions
    if reference.frame != "map":
        if not len(matched):
            return None
        positions = apply(*trajectory.aligned(matched)[1], positions)
    distances = segment_distances(positions, reference.walls)
    mean, _, p95 = _summary(distances)
    return MapError(mean, trajectory.rms(distances), p95)


def loop_error(matched: trajectory.Matched) -> tuple[float, float] | None:
    """Error of the end of a drive as seen from its start: m and rad, both 0 or more.

    From the first instant to the last at which the reference knows the pose. None without two of them.
    """
    headed = np.flatnonzero(np.isfinite(matched.reference[:, 2]))
    if len(headed) < 2:
        return None
    translation, rotation = trajectory.relative_errors(matched, headed[:1], headed[-1:])
    return float(translation[0]), abs(float(rotation[0]))


def _summary(distances: np.ndarray) -> tuple[float | None, float | None, float | None]:
    """Mean, median and what 95 % do not exceed."""
    if not len(distances):
        return None, None, None
    return float(distances.mean()), float(np.median(distances)), float(np.percentile(distances, 95))
