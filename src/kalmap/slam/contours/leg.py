"""The part of a drive that one local map covers: where the vehicle was at each scan, in the map's own frame."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose
from kalmap.records import Scan


class Leg(msgspec.Struct, frozen=True, eq=False):
    """times, stamps: (K,) s, stamps NaN where the time is the stamp; poses: (K, 3); covariances: (K, 3, 3).

    twists: (K, 3) m/s, m/s, rad/s of the vehicle. scans: of each row. driven: (2, 2) m^2, what the odometry alone would
    have added to the vehicle's covariance.
    """

    times: np.ndarray
    stamps: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    twists: np.ndarray
    scans: tuple[Scan, ...]
    driven: np.ndarray


class OpenLeg:
    """A leg that is being driven."""

    def __init__(self) -> None:
        self.rows: list[tuple[Scan, np.ndarray, np.ndarray, np.ndarray]] = []
        self.driven = np.zeros((2, 2))

    def append(self, scan: Scan, pose: np.ndarray, covariance: np.ndarray, twist: np.ndarray) -> None:
        """A further scan, where it was taken and how fast the vehicle went."""
        self.rows.append((scan, pose, covariance, twist))

    def leg(self) -> Leg:
        """What there is so far."""
        scans = tuple(row[0] for row in self.rows)
        return Leg(
            times=np.array([scan.time for scan in scans], dtype=float),
            stamps=np.array([scan.stamp for scan in scans], dtype=float),
            poses=np.array([row[1] for row in self.rows], dtype=float).reshape(-1, 3),
            covariances=np.array([row[2] for row in self.rows], dtype=float).reshape(-1, 3, 3),
            twists=np.array([row[3] for row in self.rows], dtype=float).reshape(-1, 3),
            scans=scans,
            driven=self.driven.copy(),
        )


def turned_by(heading: float) -> np.ndarray:
    """(3, 3) turn of a pose's error."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def composed(
    T_map_a: np.ndarray, covariance_a: np.ndarray, T_a_b: np.ndarray, covariance_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """T_map_b and its covariance, a and b being independent; T_a_b (..., 3), covariance_b (..., 3, 3) may be many."""
    pose = compose(T_map_a, T_a_b)
    turn = turned_by(T_map_a[2])
    lever = np.empty(covariance_b.shape)
    lever[:] = np.eye(3)
    lever[..., 0, 2] = -(pose[..., 1] - T_map_a[1])
    lever[..., 1, 2] = pose[..., 0] - T_map_a[0]
    covariance = lever @ covariance_a @ np.swapaxes(lever, -1, -2) + turn @ covariance_b @ turn.T
    return pose, 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
