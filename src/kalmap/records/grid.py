"""An occupancy grid: which parts of the plane are free, occupied or unknown."""

from __future__ import annotations

import msgspec
import numpy as np

FREE, OCCUPIED, UNKNOWN = 0, 100, -1


class OccupancyGrid(msgspec.Struct, frozen=True):
    """Square cells, row 0 the lowest in y and column 0 the lowest in x.

    origin: (2,) m, the lower left corner of the grid. resolution: m, the side of a cell. cells: (H, W) int8: `FREE`,
    `OCCUPIED` or `UNKNOWN`, the numbers that ROS has for them.
    """

    origin: np.ndarray
    resolution: float
    cells: np.ndarray

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top, m."""
        height, width = self.cells.shape
        left, bottom = self.origin.tolist()
        return left, left + width * self.resolution, bottom, bottom + height * self.resolution
