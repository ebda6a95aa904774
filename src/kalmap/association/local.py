"""The local association region and what should be seen in it."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.association.associator import Expected, Predicted
from kalmap.association.checks import check
from kalmap.kernels.region import in_sector


class Region(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which landmarks take part in a frame: equations (7) and (10) of Zhou, Zhao & Zhang 2010.

    local: False lets all of them take part. pad: m, the paper's d, by which the region is wider and the field
    of view in which a landmark must be seen is narrower than the sensor's range. turn: rad, the paper's angle
    by which the front line is moved, times the range, back for the one and forward for the other. Three
    standard deviations of the robot's position are added to the region, so that it still holds what the sensor
    sees when the robot is unsure of itself. reliable_range: m, up to which a landmark that is there is seen as
    a rule; None takes the sensor's range.
    """

    local: bool = True
    pad: float = 1.0
    turn: float = 0.05
    reliable_range: float | None = None

    def __post_init__(self) -> None:
        check(self.pad >= 0.0, "region.pad", "0 or more m", self.pad)
        check(0.0 <= self.turn <= math.pi, "region.turn", "0 to pi rad", self.turn)
        reliable = self.reliable_range
        check(reliable is None or reliable > 0.0, "reliable_range", "a positive number of m", reliable)

    def candidates(self, predicted: Predicted) -> np.ndarray:
        """Indices of the landmarks that take part, ascending."""
        if not self.local:
            return np.arange(predicted.count)
        reach = predicted.max_range + self.pad + 3.0 * predicted.position_sigma
        front = -math.inf
        if predicted.half_view <= 0.5 * math.pi + 1e-9:
            front = -self._shift(predicted.max_range) - 3.0 * predicted.position_sigma
        return predicted.within(reach, front)

    def reach(self, predicted: Predicted) -> float:
        """Up to which range a landmark that is there should be seen, m, before `pad` is taken off."""
        far = predicted.max_range
        return far if self.reliable_range is None else min(far, self.reliable_range)

    def _shift(self, reach: float) -> float:
        """How far the front line is moved, m; not at all without `turn`, however far the sensor sees."""
        return self.turn * reach if self.turn > 0.0 else 0.0

    def in_view(self, predicted: Predicted, expected: Expected, shrink: bool = False) -> np.ndarray:
        """(C,) bool: in the sensor's field of view.

        shrink: by a margin, equation (7): nearer than R - d, and farther than `turn` R from the edges of the
        sector (for a half plane: ahead of the front line).
        """
        reach = self.reach(predicted)
        distance, half = expected.z[:, 0], predicted.half_view
        if not shrink:
            inside = np.empty(len(distance), dtype=np.bool_)
            in_sector(expected.z, predicted.min_range, reach, half, inside)
            return inside
        near = (distance < reach - self.pad) & (distance >= predicted.min_range)
        if half >= math.pi:
            return near
        off_edge = half - np.abs(expected.z[:, 1])
        return near & (distance * np.sin(np.minimum(off_edge, 0.5 * math.pi)) > self._shift(reach))
