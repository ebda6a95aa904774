"""A metric of several methods, a dot a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import StudyDots
from kalmap.view.reading import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SPREAD = 0.26  # of a row's height: how far the dots of seeds are drawn apart

_MEAN, _PAPER = "mean over the seeds", "the paper's mean"


def dots_figure(
    panels: Mapping[str, Sequence[StudyDots]],
    label: str,
    *,
    line: tuple[float, str] | None = None,
    log: bool = False,
    decimals: int | None = None,
) -> Figure:
    """Panels side by side, one row a method from the top down: a dot a seed, a bar at the mean with its number.

    panels: title -> the methods, the same in each. label: of the axis. line: a value to be marked, and what it is.
    log: logarithmic axis; what is not above zero is left out there. decimals: of the means, None as their size wants.
    """
    with style.house_style():
        rows = next(iter(panels.values()), ())
        figure = style.new_figure(height=1.3 + 0.34 * max(len(rows), 1))
        if not rows:
            style.say(figure.add_subplot(), "No methods to compare.")
            return figure
        grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (title, methods) in zip(grid, panels.items(), strict=True):
            if log:
                _logarithmic(axes)
            _draw_rows(axes, methods, log, decimals)
            if line is not None:
                axes.axvline(line[0], color=style.BLACK, lw=1.0, ls="--", zorder=2, label=line[1])
            axes.set_title(title)
            axes.set_xlabel(label)
            axes.grid(axis="y", visible=False)
            axes.tick_params(left=axes is grid[0])
        grid[0].set_yticks(range(len(rows)), [row.method for row in rows])
        grid[0].set_ylim(len(rows) - 0.4, -0.6)
        figure.set_layout_engine("constrained", wspace=0.06)  # room for the means beside each panel
        _legend(figure, grid)
    return figure


def _logarithmic(axes: Axes) -> None:
    """Ticks at 1, 2 and 5 in every decade, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_rows(axes: Axes, methods: Sequence[StudyDots], log: bool, decimals: int | None) -> None:
    """All methods; a thin line between groups."""
    groups = list(dict.fromkeys(method.group for method in methods))
    for place, method in enumerate(methods):
        if place and method.group != methods[place - 1].group:
            axes.axhline(place - 0.5, color=style.GREY, lw=0.5, zorder=1)
        colour = style.METHOD_COLOURS[groups.index(method.group) % len(style.METHOD_COLOURS)]
        _draw_row(axes, place, method, colour, log, decimals)


def _draw_row(
    axes: Axes, place: int, method: StudyDots, colour: str, log: bool, decimals: int | None
) -> None:
    values = np.asarray(method.values, dtype=float)
    values = values[np.isfinite(values) & ((values > 0.0) | (not log))]
    if len(values):
        spread = np.linspace(-_SPREAD, _SPREAD, len(values)) if len(values) > 1 else np.zeros(1)
        dots: dict[str, Any] = {"ls": "", "marker": "o", "ms": 3.4, "mew": 0, "alpha": 0.6, "zorder": 3}
        axes.plot(values, place + spread, color=colour, label=method.group, **dots)
        mean = float(values.mean())
        bar: dict[str, Any] = {"ls": "", "marker": "|", "ms": 15.0, "mew": 1.8, "zorder": 4}
        axes.plot([mean], [place], color=style.BLACK, label=_MEAN, **bar)
        text = number(mean) if decimals is None else f"{mean:.{decimals}f}"
        axes.annotate(text, (1.02, place), xycoords=("axes fraction", "data"), va="center", size=8)
    if method.paper is not None:
        ring: dict[str, Any] = {"ls": "", "marker": "D", "ms": 6.0, "mfc": "none", "mew": 1.2, "zorder": 3.5}
        axes.plot([method.paper], [place], mec=style.GREY, label=_PAPER, **ring)


def _legend(figure: Figure, grid: Sequence[Axes]) -> None:
    """Every label once: the groups first."""
    found = {
        name: handle for axes in grid for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    names = sorted(found, key=lambda name: name in (_MEAN, _PAPER))
    figure.legend([found[name] for name in names], names, loc="outside lower center", ncols=3)
