"""What mapping from raw scans says: sampled contours, the whole drive, and the scans at their places."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.records.events import Scan


class Contours(msgspec.Struct, frozen=True):
    """A sampled environment map: points on the contours of obstacles (N samples).

    positions: (N, 2) m. covariances: (N, 2, 2) m^2. normals: (N, 2) unit, square to the contour, pointing to the side
    that it was seen from. sightings: (N,) int64, how many scans corrected each. runs: (N,) int64: samples that share a
    number follow one another on one stretch of contour, in the order of the rows.
    """

    positions: np.ndarray
    covariances: np.ndarray
    normals: np.ndarray
    sightings: np.ndarray
    runs: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def strands(self) -> list[np.ndarray]:
        """The rows of each run, in order, by run number."""
        order = np.argsort(self.runs, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(self.runs[order])) + 1) if len(order) else []

    def segments(self) -> np.ndarray:
        """(S, 4) m, from x, y to x, y: between neighbours of each run; a sample that is alone is one without length."""
        rows = self.strands()
        starts = np.concatenate(
            [row[:-1] if len(row) > 1 else row for row in rows] or [np.zeros(0, dtype=np.int64)]
        )
        ends = np.concatenate(
            [row[1:] if len(row) > 1 else row for row in rows] or [np.zeros(0, dtype=np.int64)]
        )
        return np.hstack([self.positions[starts], self.positions[ends]])


class Trajectory(msgspec.Struct, frozen=True):
    """Where a vehicle was: times (F,) s, poses (F, 3) x m, y m, heading rad, covariances (F, 3, 3).

    stamps: (F,) s, what the log itself printed for each row (`Scan.stamp`), or None where that is `times`; NaN for a
    row where it is.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    stamps: np.ndarray | None = None

    def printed(self) -> np.ndarray:
        """(F,) s, the log's own stamp of each row."""
        return self.times if self.stamps is None else np.where(np.isnan(self.stamps), self.times, self.stamps)


class Sweeps(msgspec.Struct, frozen=True):
    """Scans, each where it was taken: poses (K, 3) of the *scanner* in the map, and the K scans."""

    poses: np.ndarray
    scans: tuple[Scan, ...]

    def points(self, min_range: float = 0.0, max_range: float = np.inf) -> np.ndarray:
        """(P, 2) m, where the beams ended that hit something between the two ranges (m), in order."""
        if not self.scans:
            return np.zeros((0, 2))
        ranges = np.concatenate([scan.ranges for scan in self.scans])
        bearings = np.concatenate([scan.bearings for scan in self.scans])
        poses = np.repeat(self.poses, [len(scan.ranges) for scan in self.scans], axis=0)
        hit = np.isfinite(ranges) & (ranges >= min_range) & (ranges <= max_range)
        direction = poses[hit, 2] + bearings[hit]
        return poses[hit, :2] + ranges[hit, None] * np.column_stack([np.cos(direction), np.sin(direction)])
