"""A small drive that nobody asked for, so that compiled code is loaded before the first step that counts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kalmap.records import Odometry, Scan

if TYPE_CHECKING:
    from kalmap.slam.contours.slam import ContourSlam

_ROOM = (3.0, 2.0, -2.5, -1.5)  # m ahead, to the left, behind and to the right


def rehearse(slam: ContourSlam) -> None:
    """Two scans of a room, and a map closed and laid on another. slam: one of its own, which is thrown away."""
    from kalmap.slam.contours.matching import overlay, search
    from kalmap.slam.contours.worker import closed

    bearings = np.radians(np.linspace(-110.0, 110.0, 221))
    for number in range(3):
        x = 0.15 * number
        values = np.zeros((1, slam.motion.control_size))
        values[0, 0] = 0.15 if number else 0.0
        slam.step(Odometry(float(number), values, np.array([1.0])))
        slam.step(Scan(float(number), _ranges(x, bearings), bearings))
    room = closed(slam._live)
    search(room, room, np.zeros(3), 0.5, 0.1)
    overlay(room, room, np.zeros(3))


def _ranges(x: float, bearings: np.ndarray) -> np.ndarray:
    """(B,) m from (x, 0) to the walls of the room."""
    ahead, left, behind, right = _ROOM
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        along = np.where(c > 0.0, (ahead - x) / c, (behind - x) / c)
        across = np.where(s > 0.0, left / s, right / s)
    return np.minimum(np.where(along > 0.0, along, np.inf), np.where(across > 0.0, across, np.inf))
