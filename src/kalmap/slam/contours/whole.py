"""The whole of a drive, from the frames of its local maps: one map, the trajectory, the scans at their places."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, rotate
from kalmap.records import Contours, Scan, Sweeps, Trajectory
from kalmap.slam.contours.closed import ClosedMap, neighbours
from kalmap.slam.contours.leg import Leg, composed
from kalmap.slam.contours.seen import Rules, calibrated, undistorted

CROWDED = (
    0.6  # spacings: a sample this near to one of another map, on the same side of a contour, is left out
)


def whole_contours(
    maps: Sequence[ClosedMap], frames: np.ndarray, covariances: np.ndarray, spacing: float, enough: int
) -> Contours:
    """All maps' samples in one frame; where maps lie on each other, those of the first one.

    frames: (n, 3), covariances: (n, 3, 3) of the maps' frames. A sample's covariance is its own and its frame's.
    enough: scans that must have seen a sample.
    """
    kept: list[tuple[np.ndarray, ...]] = [
        (np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
    ]
    for closed, frame, covariance in zip(maps, frames, covariances, strict=True):
        rows = np.flatnonzero(closed.sightings >= enough)
        placed = frame[:2] + rotate(frame[2], closed.samples[rows])
        normals = rotate(frame[2], closed.normals[rows])
        before, facing = (
            np.concatenate([part[0] for part in kept]),
            np.concatenate([part[2] for part in kept]),
        )
        fresh = ~_crowded(placed, normals, before, facing, CROWDED * spacing)
        rows, placed, normals = rows[fresh], placed[fresh], normals[fresh]
        kept.append((placed, _spread(closed, rows, frame, covariance), normals, closed.sightings[rows]))
    positions, spreads, normals, sightings = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    runs, order = _runs(positions, normals, spacing)
    return Contours(positions[order], spreads[order], normals[order], sightings[order], runs)


def _crowded(
    points: np.ndarray, normals: np.ndarray, others: np.ndarray, facing: np.ndarray, reach: float
) -> np.ndarray:
    """(M,) whether another point of the same side lies within reach."""
    crowded = np.zeros(len(points), dtype=bool)
    if not len(others) or not len(points):
        return crowded
    near = cKDTree(points).sparse_distance_matrix(cKDTree(others), reach, output_type="coo_matrix")
    same = (normals[near.row] * facing[near.col]).sum(axis=1) > 0.5
    crowded[near.row[same]] = True
    return crowded


def _spread(closed: ClosedMap, rows: np.ndarray, frame: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(M, 2, 2) of samples in the map."""
    entries = 3 + 2 * rows[:, None] + np.arange(2)
    own = closed.covariance[entries[:, :, None], entries[:, None, :]]
    c, s = np.cos(frame[2]), np.sin(frame[2])
    turn = np.array([[c, -s], [s, c]])
    arms = rotate(frame[2], closed.samples[rows])
    lever = np.zeros((len(rows), 2, 3))
    lever[:, 0, 0] = lever[:, 1, 1] = 1.0
    lever[:, 0, 2], lever[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return np.asarray(turn @ own @ turn.T + lever @ covariance @ np.swapaxes(lever, 1, 2))


def _runs(positions: np.ndarray, normals: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Runs (N,) of samples that follow one another, and the order (N,) in which they do."""
    count = len(positions)
    pairs = neighbours(positions, normals, spacing)
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    number, labels = connected_components(links, directed=False)
    beside: list[list[int]] = [[] for _ in range(count)]
    for a, b in pairs.tolist():
        beside[a].append(b)
        beside[b].append(a)
    degree = np.array([len(each) for each in beside], dtype=np.int64)
    starts = np.full(number, -1, dtype=np.int64)
    for i in np.lexsort((np.arange(count), degree)).tolist():  # a run begins at an end where it has one
        if starts[labels[i]] < 0:
            starts[labels[i]] = i
    order: list[int] = []
    seen = np.zeros(count, dtype=bool)
    for start in starts.tolist():
        at = start
        while at >= 0:
            seen[at] = True
            order.append(at)
            at = next((b for b in beside[at] if not seen[b]), -1)
    return labels[order].astype(np.int64), np.array(order, dtype=np.int64)


def whole_trajectory(legs: Sequence[Leg], frames: np.ndarray, covariances: np.ndarray) -> Trajectory:
    """Where the vehicle was at every scan."""
    poses, spreads = [np.zeros((0, 3))], [np.zeros((0, 3, 3))]
    for leg, frame, covariance in zip(legs, frames, covariances, strict=True):
        placed, spread = composed(frame, covariance, leg.poses, leg.covariances)
        poses.append(placed)
        spreads.append(spread)
    times = np.concatenate([np.zeros(0), *(leg.times for leg in legs)])
    stamps = np.concatenate([np.zeros(0), *(leg.stamps for leg in legs)])
    return Trajectory(
        times, np.concatenate(poses), np.concatenate(spreads), None if np.isnan(stamps).all() else stamps
    )


def whole_sweeps(legs: Sequence[Leg], frames: np.ndarray, rules: Rules, calibration: np.ndarray) -> Sweeps:
    """The scans that were taken some way apart, where the scanner stood, without what distorts them.

    calibration: (2,) bearing scale and range offset m. A scan is left out if the vehicle has moved less since the one
    before than makes the filter use it.
    """
    mount, beam_time = rules.mount, rules.sensor.beam_time
    step = rules.contour.update_distance, math.radians(rules.contour.update_angle_deg)
    poses, scans = [np.zeros((0, 3))], []
    for leg, frame in zip(legs, frames, strict=True):
        kept = _apart(leg.poses, step)
        poses.append(compose(np.broadcast_to(frame, (len(kept), 3)), leg.poses[kept]))
        for row in kept:
            scan = calibrated(leg.scans[row], calibration, rules.sensor)
            scans.append(_with_bearings(undistorted(scan, leg.twists[row], mount, beam_time)))
    at = np.concatenate(poses)
    return Sweeps(compose(at, np.broadcast_to(mount, at.shape)), tuple(scans))


def _with_bearings(scan: Scan) -> Scan:
    """The scan without the beams whose direction is not known."""
    known = np.isfinite(scan.bearings)
    if known.all():
        return scan
    strengths = None if scan.intensities is None else scan.intensities[known]
    return msgspec.structs.replace(
        scan, ranges=scan.ranges[known], bearings=scan.bearings[known], intensities=strengths
    )


def _apart(poses: np.ndarray, step: tuple[float, float]) -> np.ndarray:
    """Rows of which each is some way from the one before."""
    kept: list[int] = []
    for row, pose in enumerate(poses):
        if kept:
            last = poses[kept[-1]]
            turn = abs(float(wrap(pose[2] - last[2])))
            if np.hypot(*(pose[:2] - last[:2])) < step[0] and turn < step[1]:
                continue
        kept.append(row)
    return np.array(kept, dtype=np.int64)
