"""Maps of a floor beside each other, and what a step took as the map grew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.view import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class FloorMaps(msgspec.Struct, frozen=True, eq=False):
    """walls: (S, 4) m, true. true: (F, 2) m, the drive; paths: (F, 2), as the one map and the joined map have it.
    plain: (N, 2) samples of the one map. local: of each local map, placed by the drive. joined: of what they became."""

    walls: np.ndarray
    true: np.ndarray
    paths: tuple[np.ndarray, np.ndarray]
    plain: np.ndarray
    local: tuple[np.ndarray, ...]
    joined: tuple[np.ndarray, ...]


class StepTimes(msgspec.Struct, frozen=True, eq=False):
    """times: (F,) s of the drive. seconds: (F,) of each step, joins included; amortised: (F,)."""

    method: str
    times: np.ndarray
    seconds: np.ndarray
    amortised: np.ndarray


def floor_maps_figure(maps: FloorMaps, title: str) -> Figure:
    """Four panels: the truth, one map, local maps, joined map."""
    with style.house_style():
        figure = style.new_figure(width=1.5 * style.WIDTH, height=9.0)
        axes = figure.subplots(2, 2, sharex=True, sharey=True)
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        for panel in axes.flat:
            panel.set_aspect("equal")
            panel.set_xlabel("x (m)")
            panel.set_ylabel("y (m)")
        _draw_walls(axes[0, 0], maps.walls, style.BLACK, 0.8)
        axes[0, 0].plot(*maps.true.T, color=style.BLUE)
        axes[0, 0].set_title("(a) floor and drive")
        panels = (
            (axes[0, 1], (maps.plain,), f"(b) one map, {len(maps.plain)} samples", maps.paths[0]),
            (axes[1, 0], maps.local, f"(c) {len(maps.local)} local maps, not joined", None),
            (axes[1, 1], maps.joined, _joined_title(maps.joined), maps.paths[1]),
        )
        for panel, parts, text, path in panels:
            _draw_walls(panel, maps.walls, "#bbbbbb", 0.5)
            if path is not None:
                panel.plot(*path.T, color=style.GREY, linewidth=0.8)
            for index, part in enumerate(parts):
                colour = style.METHOD_COLOURS[index % len(style.METHOD_COLOURS)]
                panel.plot(*part.T, ".", color=colour, markersize=2.0)
            panel.set_title(text)
    return figure


def _joined_title(parts: tuple[np.ndarray, ...]) -> str:
    count = sum(len(part) for part in parts)
    return f"(d) joined, {count} samples" + ("" if len(parts) == 1 else f" in {len(parts)} maps left apart")


def _draw_walls(axes: Axes, walls: np.ndarray, colour: str, width: float) -> None:
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(walls.reshape(-1, 2, 2)), colors=colour, linewidths=width))
    axes.autoscale_view()


def step_times_figure(runs: Sequence[StepTimes], period: float) -> Figure:
    """Time of each step, all time so far, and the amortised time of a step; period: s between two scans.

    Most scans correct nothing, as the vehicle has hardly moved: of every 150th of the drive the longest step
    is drawn.
    """
    with style.house_style():
        figure = style.new_figure(width=1.5 * style.WIDTH, height=4.2)
        single, total, spread = figure.subplots(1, 3, sharex=True)
        for index, run in enumerate(runs):
            looks = style.method_style(index)
            single.plot(*_longest(run.times, 1e3 * run.seconds), label=run.method, **looks)
            total.plot(run.times, np.cumsum(run.seconds), **looks)
            spread.plot(*_longest(run.times, 1e3 * run.amortised), **looks)
        for axes, text in (
            (single, "(a) longest steps (ms)"),
            (total, "(b) time so far (s)"),
            (spread, "(c) longest steps, joins spread (ms)"),
        ):
            axes.set_title(text)
            axes.set_xlabel("time of the drive (s)")
        for axes in (single, spread):
            axes.set_yscale("log")
            axes.axhline(
                1e3 * period, color=style.GREY, linewidth=0.8, linestyle=":", label="the scanner's period"
            )
        figure.legend(*single.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


_BINS = 150


def _longest(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest value of each of `_BINS` parts, and when that began."""
    starts = np.unique(np.linspace(0, len(values), _BINS, endpoint=False).astype(int))
    return times[starts], np.maximum(np.maximum.reduceat(values, starts), 1e-5)
