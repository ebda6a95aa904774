"""SE(2) as the filters use it: poses (x, y, heading) composed, and the position part of the exponential.

All functions take arrays (..., 3) or (..., 2) and broadcast.
"""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap


def _beside(*columns: np.ndarray) -> np.ndarray:
    """Numbers of one shape side by side along a last axis: np.stack, which takes longer than the rest for one pose."""
    whole = np.empty((*columns[0].shape, len(columns)))
    for k, column in enumerate(columns):
        whole[..., k] = column
    return whole


def rotate(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R(angle) v. angle: (...). v: (..., 2)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = v[..., 0], v[..., 1]
    return _beside(c * x - s * y, s * x + c * y)


def compose(T_map_a: np.ndarray, T_a_b: np.ndarray) -> np.ndarray:
    """The pose b in the map, from a in the map and b in a. Headings wrapped."""
    position = T_map_a[..., :2] + rotate(T_map_a[..., 2], T_a_b[..., :2])
    heading = wrap(T_map_a[..., 2] + T_a_b[..., 2])
    return _beside(position[..., 0], position[..., 1], heading)


def inverse(T_map_a: np.ndarray) -> np.ndarray:
    """The map in a."""
    position = -rotate(-T_map_a[..., 2], T_map_a[..., :2])
    return _beside(position[..., 0], position[..., 1], wrap(-T_map_a[..., 2]))


def _left_jacobian(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(s, c) of V(angle) = [[s, -c], [c, s]]; the series below 1e-4 rad, where the quotient loses digits."""
    angle = np.asarray(angle, dtype=float)
    small = np.abs(angle) < 1e-4
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    c = np.where(small, angle * (0.5 - angle**2 / 24.0), (1.0 - np.cos(safe)) / safe)
    return s, c


def exp_position(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """V(angle) v: the translation of exp(v, angle)."""
    s, c = _left_jacobian(angle)
    return np.stack([s * v[..., 0] - c * v[..., 1], c * v[..., 0] + s * v[..., 1]], axis=-1)


def log_position(angle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """V(angle)^-1 p: the inverse of `exp_position` for |angle| < 2 pi."""
    s, c = _left_jacobian(angle)
    scale = 1.0 / (s**2 + c**2)
    return np.stack(
        [scale * (s * p[..., 0] + c * p[..., 1]), scale * (s * p[..., 1] - c * p[..., 0])], axis=-1
    )


def quarter_turn(v: np.ndarray) -> np.ndarray:
    """J v with J = [[0, -1], [1, 0]]."""
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def exponential(twist: np.ndarray) -> np.ndarray:
    """exp of a twist (..., 3): the increment that it leads to."""
    return np.concatenate([exp_position(twist[..., 2], twist[..., :2]), twist[..., 2:]], axis=-1)


def logarithm(step: np.ndarray) -> np.ndarray:
    """The twist (..., 3) that leads to an increment."""
    return np.concatenate([log_position(step[..., 2], step[..., :2]), step[..., 2:]], axis=-1)
