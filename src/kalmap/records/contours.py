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


class Trajectory(msgspec.Struct, frozen=True):
    """Where a vehicle was: times (F,) s, poses (F, 3) x m, y m, heading rad, covariances (F, 3, 3).

    stamps: (F,) s, what the log itself printed for each row (`Scan.stamp`), or None where that is `times`.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    stamps: np.ndarray | None = None


class Sweeps(msgspec.Struct, frozen=True):
    """Scans, each where it was taken: poses (K, 3) of the *scanner* in the map, and the K scans."""

    poses: np.ndarray
    scans: tuple[Scan, ...]
