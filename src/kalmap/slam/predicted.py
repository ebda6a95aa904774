"""The map as a filter expects it: what it lets an associator ask."""

from __future__ import annotations

import numpy as np

from kalmap.gaussian import Belief
from kalmap.models import SensorModel
from kalmap.slam.engines import Engine


class PredictedMap:
    """See `kalmap.association.Predicted`. A view of the filter at the frame's time, good for that frame only."""

    __slots__ = ("_belief", "_engine", "_noises", "_sensor", "_z")

    def __init__(
        self, engine: Engine, belief: Belief, sensor: SensorModel, z: np.ndarray, noises: np.ndarray
    ) -> None:
        self._engine, self._belief, self._sensor = engine, belief, sensor
        self._z, self._noises = z, noises

    @property
    def count(self) -> int:
        """How many landmarks there are."""
        return (self._belief.n - self._belief.robot) // 2

    @property
    def positions(self) -> np.ndarray:
        """(N, 2) m, a copy."""
        return self._belief.mean[self._belief.robot : self._belief.n].reshape(-1, 2).copy()

    def innovations(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mahalanobis distance squared and ln det S of every sighting with every candidate: two (M, C)."""
        begin = self._belief.robot + 2 * np.asarray(candidates, dtype=np.int64)
        return self._engine.innovations(self._belief, self._z, self._noises, begin)

    def in_view(self, margin: float) -> np.ndarray:
        """(N,) bool: landmarks that the sensor should see now; the margin shrinks its view by that share."""
        return self._sensor.in_view(self._belief.mean[:3], self.positions, margin)
