"""Several methods on one log: maps side by side, errors over time, metrics as bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import RunView
from kalmap.view.map_figure import draw_map, map_limits
from kalmap.view.reading import HEADLINES, Metric, metric_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def maps_figure(runs: Sequence[RunView], tracks: np.ndarray | None = None) -> Figure:
    """The maps of all runs side by side, with the same limits.

    tracks: (F, movers, 2) m, where things went that are no landmarks, drawn beneath each map.
    """
    with style.house_style():
        if not runs:
            figure = style.new_figure(height=2.0)
            style.say(figure.add_subplot(), "No runs to compare.")
            return figure
        limits = map_limits(list(runs))
        columns = min(len(runs), 3 if len(runs) != 4 else 2)
        rows = math.ceil(len(runs) / columns)
        ratio = (limits[3] - limits[2]) / (limits[1] - limits[0])
        height = rows * (0.9 * style.WIDTH / columns * ratio + 0.35) + 0.8
        figure = style.new_figure(height=height)
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes, run in zip(grid.flat, runs, strict=False):
            if tracks is not None and tracks.size:
                _draw_tracks(axes, tracks)
            draw_map(axes, run, limits)
            axes.set_title(run.method)
            axes.label_outer()
        for axes in grid.flat[len(runs) :]:
            axes.set_axis_off()
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _draw_tracks(axes: Axes, tracks: np.ndarray) -> None:
    """A thin line for each mover, one entry of the legend for all."""
    lines = axes.plot(tracks[..., 0], tracks[..., 1], color=style.SKY, lw=0.6, alpha=0.4, zorder=1)
    lines[0].set_label("tracks of movers")


def error_curves_figure(runs: Sequence[RunView]) -> Figure:
    """Position error (m) and size of the heading error (deg) of all runs over time."""
    with style.house_style():
        judged = [
            (index, run) for index, run in enumerate(runs) if run.errors is not None and len(run.errors)
        ]
        if not judged:
            figure = style.new_figure(height=2.0)
            style.say(figure.add_subplot(), "Nothing to compare with: this log has no reference path.")
            return figure
        headings = any(run.errors is not None and run.errors.has_heading() for _, run in judged)
        figure = style.new_figure(height=5.4 if headings else 3.4)
        stack = figure.subplots(2 if headings else 1, 1, sharex=True, squeeze=False)[:, 0]
        for index, run in judged:
            assert run.errors is not None
            times, values = run.errors.times - run.start_time, run.errors.values
            looks = style.method_style(index)
            stack[0].plot(times, np.hypot(values[:, 0], values[:, 1]), label=run.method, **looks)
            if headings:
                stack[1].plot(times, np.degrees(np.abs(values[:, 2])), **looks)
        for axes, label in zip(stack, ("position error (m)", "heading error (deg)"), strict=False):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        stack[0].set_title(f"Errors over time, {judged[0][1].log}")
        stack[-1].set_xlabel("time since start (s)")
        figure.legend(*stack[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def bars_figure(metrics: Mapping[str, Mapping[str, float | None]], limit: int = 12) -> Figure:
    """One small bar chart a metric, one bar a method. metrics: method -> key -> value, None if unknown.

    The headline metrics if there are any of them, else the first `limit` of all.
    """
    methods = list(metrics)
    known = {key for row in metrics.values() for key, value in row.items() if value is not None}
    headlines = [key for key in HEADLINES if key in known]
    keys = headlines or list(dict.fromkeys(key for row in metrics.values() for key in row if key in known))
    keys = keys[:limit]
    with style.house_style():
        if not keys:
            figure = style.new_figure(height=2.0)
            style.say(figure.add_subplot(), "No metrics to compare.")
            return figure
        columns = min(3, len(keys))
        rows = math.ceil(len(keys) / columns)
        figure = style.new_figure(height=rows * (0.75 + 0.24 * len(methods)) + 0.2)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, key in zip(grid.flat, keys, strict=False):
            _draw_bars(axes, metric_of(key), [metrics[method].get(key) for method in methods])
        for row in grid:
            for column, axes in enumerate(row):
                axes.set_yticks(range(len(methods)), methods if column == 0 else [""] * len(methods))
        for axes in grid.flat[len(keys) :]:
            axes.set_axis_off()
    return figure


def _draw_bars(axes: Axes, metric: Metric, values: Sequence[float | None]) -> None:
    """Bars from the top down, each with its number; the right value as a line where there is one."""
    shown = [math.nan if value is None else metric.scale * value for value in values]
    largest = style.finite_maximum(np.array([*shown, metric.scale * (metric.right or 0.0)]))
    backing = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
    for row, value in enumerate(shown):
        length = value if math.isfinite(value) else 0.0
        axes.barh(row, length, height=0.72, color=style.METHOD_COLOURS[row % len(style.METHOD_COLOURS)])
        text = metric.format(values[row])
        place = (max(length, 0.0), row)
        axes.annotate(
            text, place, (4, 0), textcoords="offset points", va="center", size=8, bbox=backing, zorder=4
        )
    if metric.right is not None:
        axes.axvline(metric.scale * metric.right, color=style.BLACK, lw=1.0, ls="--", zorder=3)
    smallest = -style.finite_maximum(-np.array([*shown, 0.0]))
    axes.set_xlim(1.28 * min(smallest, 0.0), 1.28 * largest if largest > 0 else 1.0)
    axes.invert_yaxis()
    axes.grid(False)
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(left=False)
    axes.set_title(metric.title, fontsize=9)
