"""Two maps that were joined: each as it was, and both in one frame with the pairs that hold them together."""

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


class JoinView(msgspec.Struct, frozen=True):
    """names: of both maps. first (N, 2), second (M, 2): landmarks, m, each in its own frame.

    pairs: (K, 2) rows of both. T_first_second: (3,) how they lie. joined: (L, 2) landmarks of the joined map, in the
    first's frame.
    """

    names: tuple[str, str]
    first: np.ndarray
    second: np.ndarray
    T_first_second: np.ndarray
    pairs: np.ndarray
    joined: np.ndarray


def join_figure(view: JoinView) -> Figure:
    """Above both maps in frames of their own, below both in the first's frame, pairs ringed."""
    with style.house_style():
        figure = style.new_figure(height=8.6)
        grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.7))
        for column, (title, points) in enumerate(((view.names[0], view.first), (view.names[1], view.second))):
            axes = figure.add_subplot(grid[0, column])
            paired = points[view.pairs[:, column]]
            colour, marker = _LOOKS[column]
            axes.plot(*points.T, marker, ms=4.0, color=colour, ls="")
            _rings(axes, paired)
            _finish(axes, points, f"{_short(title)}: {len(points)} landmarks")
        axes = figure.add_subplot(grid[1, :])
        moved = view.T_first_second[:2] + rotate(view.T_first_second[2], view.second)
        for points, (colour, marker), label in (
            (view.first, _LOOKS[0], "first map"),
            (moved, _LOOKS[1], "second map, moved as a whole"),
        ):
            axes.plot(*points.T, marker, ms=5.0, color=colour, ls="", label=label)
        axes.plot(*view.joined.T, ".", ms=3.0, color=style.BLACK, ls="", label="joined map")
        _rings(axes, view.joined[view.pairs[:, 0]], "pairs")
        title = f"joined: {len(view.joined)} landmarks, {len(view.pairs)} pairs"
        _finish(axes, np.concatenate([view.first, moved]), title)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


_LOOKS = ((style.BLUE, "x"), (style.VERMILLION, "+"))


def _rings(axes: Axes, points: np.ndarray, label: str | None = None) -> None:
    axes.plot(*points.T, "o", ms=9.0, mfc="none", mec=style.GREEN, mew=0.9, ls="", label=label)


def _finish(axes: Axes, points: np.ndarray, title: str) -> None:
    left, right, bottom, top = limits_around(points)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def _short(name: str) -> str:
    return name if len(name) <= 44 else f"...{name[-41:]}"
