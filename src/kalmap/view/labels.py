"""Short texts in a plot, each only where there is room for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDE, _HIGH = 0.62, 1.1  # of the font's size: a character's width, a line's height
_MARK = 4.5  # half the side of a mark that texts keep clear of, points
# Where a text may stand beside its point: in the corners, then on the four sides.
_SIDES = np.array([(1, 0.8), (-1, 0.8), (1, -0.8), (-1, -0.8), (0, 1), (0, -1), (1, 0), (-1, 0)])


class Labels:
    """Keeps account of what is taken in axes whose place in the figure is settled, in points from its corner."""

    def __init__(self, axes: Axes) -> None:
        box = axes.get_window_extent()
        self._axes = axes
        self._points_a_pixel = 72.0 / axes.figure.dpi
        self._corner = np.array([box.x0, box.y0])
        self._size = self._points_a_pixel * np.array([box.width, box.height])
        self._taken: list[tuple[float, float, float, float]] = []

    def keep_clear(self, points: np.ndarray) -> None:
        """No text over the marks at these points (K, 2)."""
        for x, y in self._place(points):
            self._taken.append((x - _MARK, x + _MARK, y - _MARK, y + _MARK))

    def put(self, point: np.ndarray, text: str, apart: float = 5.0, **look: Any) -> bool:
        """Write beside a point, on the first side that is free, `apart` points away.

        look: as for `annotate`, with `size`. Returns whether there was room.
        """
        half = 0.5 * float(look["size"]) * np.array([_WIDE * len(text), _HIGH])
        centre = self._place(point[None])[0]
        for side in _SIDES:
            shift = side * (half + apart)
            box = (*(centre + shift - half).tolist(), *(centre + shift + half).tolist())
            if self._free(*box):
                self._taken.append((box[0], box[2], box[1], box[3]))
                look |= {"ha": "center", "va": "center", "zorder": 9}
                self._axes.annotate(text, tuple(point), tuple(shift), textcoords="offset points", **look)
                return True
        return False

    def _place(self, points: np.ndarray) -> np.ndarray:
        """(K, 2) points of the data, in points from the axes' corner."""
        return (self._axes.transData.transform(points.reshape(-1, 2)) - self._corner) * self._points_a_pixel

    def _free(self, left: float, bottom: float, right: float, top: float) -> bool:
        if left < 0.0 or bottom < 0.0 or right > self._size[0] or top > self._size[1]:
            return False
        return not any(left < r and x < right and bottom < t and y < top for x, r, y, t in self._taken)
