"""A spatial index that follows the moving map."""

from __future__ import annotations

import numpy as np

from kalmap.gaussian import Belief
from kalmap.kernels import region

_CELL = 12.0  # m; a third of what a laser scanner sees, so that a query touches about fifty cells
_SLACK = 3.0  # m that the filed positions may be out of date before all are filed again
_FEWEST = 64  # landmarks that are looked at one by one without a loss


class LandmarkIndex:
    """Finds the landmarks in a region without looking at all of them, exactly, wherever corrections moved them.

    Landmarks are filed in cells of a grid. What an update moves is not filed again: the index adds up how far
    landmarks can have moved at most, widens its search by that, and files all again when it gets too much.
    """

    __slots__ = ("_filed", "_keys", "_moved", "_order")

    def __init__(self) -> None:
        self._keys = self._order = np.zeros(0, dtype=np.int64)
        self._filed, self._moved = 0, 0.0

    def within(
        self, belief: Belief, sensor: tuple[float, float, float], reach: float, front: float
    ) -> np.ndarray:
        """Indices, ascending, of the landmarks within `reach` m of the sensor and more than `front` m ahead of it."""
        count = (belief.n - belief.robot) // 2
        if count - self._filed > max(_FEWEST, self._filed // 4) or self._moved > _SLACK:
            self._file(belief, count)
        return region.landmarks_within(
            belief.mean,
            belief.robot,
            count,
            self._keys,
            self._order,
            sensor,
            reach,
            front,
            _CELL,
            self._moved,
        )

    def _file(self, belief: Belief, count: int) -> None:
        keys = np.empty(count, dtype=np.int64)
        region.cell_keys(belief.mean, belief.robot, count, _CELL, keys)
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]
        self._filed, self._moved = count, 0.0

    @property
    def filed(self) -> int:
        """How many landmarks, the first ones, are filed: whose moves have to be told."""
        return self._filed

    def moved(self, distance: float) -> None:
        """Say how far (m) the last correction moved any filed landmark at most."""
        self._moved += distance

    def removed(self, index: int) -> None:
        """Say that a landmark is gone and those behind it have moved up."""
        if index < self._filed:
            self.clear()

    def clear(self) -> None:
        """Forget everything: the next question files all landmarks again."""
        self._keys = self._order = np.zeros(0, dtype=np.int64)
        self._filed, self._moved = 0, 0.0
