"""Coordinate frames of a ROS recording: transforms, odometry out of them, and how the laser is mounted.

All matrices are (4, 4) homogeneous, T_parent_child.
"""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np

from kalmap.records import LogError

CORRECTED = ("map", "world", "earth")
"""Frames whose transforms are the work of a SLAM program or of a localisation, never odometry."""
ODOMETRY = "odom"
BASES = ("base_link", "base_footprint")
FLATTEST = float(np.cos(np.deg2rad(15.0)))
"""A laser that is tilted by more than 15 degrees does not see a plan."""
STILL = 1e-2
"""How much a mounting may vary over the recording, m and (elements of the rotation) rad."""


class Edge(msgspec.Struct, frozen=True):
    """All transforms between two frames. stamps (n,) of the headers, orders (n,) in the bag, matrices (n, 4, 4)."""

    stamps: np.ndarray
    orders: np.ndarray
    matrices: np.ndarray

    def moves(self) -> bool:
        """Whether it changes."""
        return bool(np.ptp(self.matrices, axis=0).max() > STILL)


Edges = dict[tuple[str, str], Edge]


class Mounting(msgspec.Struct, frozen=True):
    """A laser in the robot's frame. pose: (3,) m, m, rad; upside_down: its beams turn the other way round."""

    pose: np.ndarray
    upside_down: bool


def bare(frame: str) -> str:
    """A frame's name without the slash that early ROS put before it."""
    return frame.lstrip("/")


def rotation(quaternion: np.ndarray) -> np.ndarray | None:
    """(3, 3) of a quaternion (x, y, z, w) of any length; None where it has no direction."""
    length = np.linalg.norm(quaternion)
    if not np.isfinite(length) or length < 1e-6:
        return None
    x, y, z, w = quaternion / length
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def matrix(translation: np.ndarray, quaternion: np.ndarray) -> np.ndarray | None:
    """(4, 4) of a translation and a quaternion; None if they are not finite or the quaternion is zero."""
    turn = rotation(quaternion)
    if turn is None or not np.isfinite(translation).all():
        return None
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn, translation
    return result


def planar(matrices: np.ndarray) -> np.ndarray:
    """(..., 3) x, y, heading of matrices (..., 4, 4), what is out of the plane left away."""
    heading = np.arctan2(matrices[..., 1, 0], matrices[..., 0, 0])
    return np.stack([matrices[..., 0, 3], matrices[..., 1, 3], heading], axis=-1)


def odometry_edge(edges: Edges) -> tuple[str, str] | None:
    """The pair of frames whose transform is the odometry: out of a frame called odom, a base frame first; else None.

    Never one out of map, world or earth: that is a correction.
    """
    found = [
        pair
        for pair in edges
        if pair[0].split("/")[-1] == ODOMETRY and pair[1].split("/")[-1] not in CORRECTED
    ]
    return min(
        found,
        key=lambda pair: (pair[1].split("/")[-1] not in BASES, -len(edges[pair].stamps), pair),
        default=None,
    )


def mounting(edges: Edges, base: str, laser: str, file: object) -> Mounting | None:
    """How the laser sits on the robot; None where no transforms join the two frames.

    Raises LogError if the laser moves on the robot or looks out of the plane.
    """
    T_base_laser = _chain(edges, base, laser, file)
    if T_base_laser is None:
        return None
    up = float(T_base_laser[2, 2])
    if abs(up) < FLATTEST:
        tilt = np.rad2deg(np.arccos(abs(up)))
        raise LogError(f"the laser {laser!r} is tilted by {tilt:.0f} degrees: it sees no plan", file=file)
    return Mounting(planar(T_base_laser), up < 0)


def _chain(edges: Edges, base: str, laser: str, file: object) -> np.ndarray | None:
    """T_base_laser along the fewest transforms, whichever way they point."""
    done, waiting = {base: np.eye(4)}, deque([base])
    while waiting and laser not in done:
        frame = waiting.popleft()
        for (parent, child), edge in edges.items():
            if parent in CORRECTED or parent.split("/")[-1] == ODOMETRY or frame not in (parent, child):
                continue
            other = child if frame == parent else parent
            if other in done:
                continue
            if edge.moves():
                if other == laser:
                    raise LogError(f"the laser {laser!r} moves against {frame!r}", file=file)
                continue
            step = edge.matrices[0]
            done[other] = done[frame] @ (step if frame == parent else np.linalg.inv(step))
            waiting.append(other)
    return done.get(laser)
