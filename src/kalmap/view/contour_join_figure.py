"""Two contour maps that were joined: each as it was, and both in one frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.geometry.se2 import rotate
from kalmap.view import style
from kalmap.view.map_figure import limits_around

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class ContourJoinView(msgspec.Struct, frozen=True, eq=False):
    """names: of both maps. first (S, 4), second (S, 4): contours as segments, m, each in its own frame. T_first_second:
    (3,) how they lie. joined: (S, 4), in the first's frame; samples: how many it has."""

    names: tuple[str, str]
    first: np.ndarray
    second: np.ndarray
    T_first_second: np.ndarray
    joined: np.ndarray
    samples: int


def contour_join_figure(view: ContourJoinView) -> Figure:
    """Above both maps in frames of their own, in the middle one laid on the other, below what they were joined to."""
    with style.house_style():
        figure = style.new_figure(width=1.3 * style.WIDTH, height=13.0)
        grid = figure.add_gridspec(3, 2, height_ratios=(1.0, 1.7, 1.7))
        for column, (name, segments, colour) in enumerate(
            ((view.names[0], view.first, style.BLUE), (view.names[1], view.second, style.VERMILLION))
        ):
            axes = figure.add_subplot(grid[0, column])
            _draw(axes, segments, colour)
            _finish(axes, segments, name if len(name) <= 44 else f"...{name[-41:]}")
        moved = _moved(view.T_first_second, view.second)
        both = np.concatenate([view.first, moved])
        axes = figure.add_subplot(grid[1, :])
        _draw(axes, view.first, style.BLUE, "first map")
        _draw(axes, moved, style.VERMILLION, "second map, moved as a whole")
        _finish(axes, both, "laid on each other")
        axes.legend(loc="best")
        axes = figure.add_subplot(grid[2, :])
        _draw(axes, view.joined, style.BLACK)
        _finish(axes, both, f"joined: {view.samples} samples")
    return figure


def _moved(T_a_b: np.ndarray, segments: np.ndarray) -> np.ndarray:
    ends = segments.reshape(-1, 2)
    return np.asarray(T_a_b[:2] + rotate(T_a_b[2], ends)).reshape(-1, 4)


def _draw(axes: Axes, segments: np.ndarray, colour: str, label: str | None = None) -> None:
    from matplotlib.collections import LineCollection

    axes.add_collection(
        LineCollection(list(segments.reshape(-1, 2, 2)), colors=colour, linewidths=0.9, label=label)
    )


def _finish(axes: Axes, segments: np.ndarray, title: str) -> None:
    left, right, bottom, top = limits_around(segments.reshape(-1, 2))
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
