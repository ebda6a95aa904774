"""What a step costs, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import RunView
from kalmap.view.reading import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def timing_figure(run: RunView) -> Figure:
    """Time per step (ms) with mean, 99th percentile and largest marked, and beside it the histogram."""
    with style.house_style():
        figure = style.new_figure(height=3.6)
        spent = 1e3 * run.trace.step_seconds
        known = np.isfinite(spent)
        spent, times = spent[known], run.trace.step_times[known] - run.start_time
        if not len(spent):
            axes = figure.add_subplot()
            style.say(axes, "No step was timed.")
        else:
            axes, histogram = figure.subplots(1, 2, sharey=True, width_ratios=(4, 1))
            _draw_course(axes, times, spent)
            _draw_histogram(histogram, spent)
        axes.set_title(f"Time per step, {run.title}")
    return figure


def _draw_course(axes: Axes, times: np.ndarray, spent: np.ndarray) -> None:
    axes.plot(times, spent, ".", ms=2.0, color=style.BLUE, alpha=0.6, mew=0, rasterized=True)
    marks = (
        ("mean", float(spent.mean()), style.GREEN, "-"),
        ("99 % below", float(np.percentile(spent, 99)), style.ORANGE, "--"),
        ("largest", float(spent.max()), style.VERMILLION, ":"),
    )
    for name, value, colour, line in marks:
        axes.axhline(value, color=colour, ls=line, lw=1.3, label=f"{name}: {number(value)} ms")
    if spent.min() > 0.0 and spent.max() > 10.0 * np.median(spent):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0.0, 1.08 * max(float(spent.max()), 1e-6))
    axes.set_xlabel("time since start (s)")
    axes.set_ylabel("time per step (ms)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)


def _draw_histogram(axes: Axes, spent: np.ndarray) -> None:
    """Turned by a quarter, so that it shares the axis of the course; bins even on that axis."""
    low, high = float(spent.min()), float(spent.max())
    if axes.get_yscale() == "log":
        bins = np.geomspace(low, high, 40)
    else:
        bins = np.linspace(0.0, max(high, 1e-6), 40)
    axes.hist(spent, bins=bins.tolist(), orientation="horizontal", color=style.BLUE, alpha=0.8)
    axes.set_xlabel("steps")
    axes.tick_params(labelleft=False)
