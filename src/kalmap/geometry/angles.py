"""Angles on the half-open circle [-pi, pi)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

TURN = 2.0 * np.pi


def wrap(angle: ArrayLike) -> np.ndarray:
    """Bring angles (any shape, rad) into [-pi, pi).

    Angles that are there already come back bit for bit. NaN stays NaN; an infinite angle has no
    direction and becomes NaN, without a warning. A scalar gives a 0-d result.
    """
    if isinstance(angle, float) and -np.pi <= angle < np.pi:  # one number: numpy takes ten times as long
        return np.asarray(angle)
    angle = np.asarray(angle, dtype=float)
    inside = (angle >= -np.pi) & (angle < np.pi)
    if inside.all():  # as most are
        return angle.copy()
    with np.errstate(invalid="ignore"):
        turned = np.mod(angle + np.pi, TURN) - np.pi
    # mod may round a hair below zero up to a whole turn; pi itself belongs to the other end
    turned = np.where(turned >= np.pi, turned - TURN, turned)
    return np.where(inside, angle, turned)
