"""Errors over time, inside or outside the bands that the filter promised."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import Errors, RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def error_figure(run: RunView) -> Figure:
    """x, y and heading errors with 3-sigma bands; position error alone where no heading is known."""
    with style.house_style():
        errors = run.errors
        if errors is None or not len(errors):
            figure = style.new_figure(height=2.0)
            axes = figure.add_subplot()
            style.say(axes, "Nothing to compare with: this log has no reference path.")
        elif errors.has_heading():
            figure = style.new_figure(height=6.0)
            axes = _draw_components(figure, errors, run.start_time)
        else:
            figure = style.new_figure(height=3.2)
            axes = figure.add_subplot()
            _draw_position(axes, errors, run.start_time)
        axes.set_title(f"Errors, {run.title}")
    return figure


def _draw_components(figure: Figure, errors: Errors, start: float) -> Axes:
    """Three stacked axes with one clock; returns the top one."""
    stack = figure.subplots(3, 1, sharex=True)
    units = (("x error (m)", 1.0), ("y error (m)", 1.0), ("heading error (deg)", 180.0 / np.pi))
    for index, (axes, (label, scale)) in enumerate(zip(stack, units, strict=True)):
        value, sigma = scale * errors.values[:, index], scale * errors.sigmas[:, index]
        times = errors.times - start
        axes.fill_between(times, -3 * sigma, 3 * sigma, color=style.SKY, alpha=0.3, lw=0, label="3 sigma")
        axes.plot(times, value, color=style.BLUE, lw=1.0, label="error")
        axes.axhline(0.0, color=style.GREY, lw=0.6)
        axes.set_ylabel(label)
        _limit_to_error(axes, value, sigma)
        axes.annotate(
            _inside(value, sigma), (1, 1), xycoords="axes fraction", ha="right", va="bottom", fontsize=8
        )
    stack[-1].set_xlabel("time since start (s)")
    figure.legend(*stack[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return stack[0]


def _draw_position(axes: Axes, errors: Errors, start: float) -> None:
    """The distance between estimate and reference, and three standard deviations of it."""
    distance = np.hypot(errors.values[:, 0], errors.values[:, 1])
    sigma = np.hypot(errors.sigmas[:, 0], errors.sigmas[:, 1])
    times = errors.times - start
    axes.fill_between(
        times, 0, 3 * sigma, color=style.SKY, alpha=0.3, lw=0, label="3 sigma, x and y together"
    )
    axes.plot(times, distance, color=style.BLUE, lw=1.0, label="position error")
    _limit_to_error(axes, distance, sigma)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("position error (m)")
    axes.set_xlabel("time since start (s)")
    axes.legend(loc="upper left")


def _limit_to_error(axes: Axes, value: np.ndarray, sigma: np.ndarray) -> None:
    """Show all of the error, and of the band as much as leaves the error readable."""
    largest = style.finite_maximum(np.abs(value))
    bound = min(max(1.1 * largest, 3.3 * style.finite_maximum(sigma, largest)), 6.0 * largest)
    if bound > 0.0:
        axes.set_ylim(-bound, bound)


def _inside(value: np.ndarray, sigma: np.ndarray) -> str:
    known = np.isfinite(value) & np.isfinite(sigma)
    if not known.any():
        return ""
    share = float((np.abs(value) <= 3 * sigma)[known].mean())
    return f"{100 * share:.1f} % inside 3 sigma (99.7 % is right)"
