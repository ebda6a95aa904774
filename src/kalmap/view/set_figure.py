"""A map as a set, over time: how many features it has, and how far it is from the true one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import RunView, SetCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRUE: dict[str, Any] = {"color": style.BLACK, "lw": 3.2, "alpha": 0.28, "zorder": 1.5}


def set_error_figure(
    times: np.ndarray,
    curves: Sequence[SetCurve],
    true_number: np.ndarray,
    cutoff: float | None = None,
    places: Sequence[int] | None = None,
    kind: str = "truth",
) -> Figure:
    """Number of features over time on top, below it OSPA, and its two parts side by side on one scale.

    times: (F,) s, of all curves. true_number: (F,) how many features the map should have. cutoff: m, said in a title.
    places: of each method among all that are compared, for the same colours as elsewhere; None counts these.
    kind: of the reference that true_number and the distances are of.
    """
    with style.house_style():
        if not curves or not len(times):
            figure = style.new_figure(height=2.0)
            style.say(figure.add_subplot(), "No curves: no map was judged as a set.")
            return figure
        figure = style.new_figure(height=7.0)
        panels = number, whole, first, second = _panels(figure)
        number.plot(times, true_number, drawstyle="steps-post", label=f"{kind}, seen so far", **_TRUE)
        for index, curve in zip(range(len(curves)) if places is None else places, curves, strict=True):
            _draw(panels, times, curve, style.method_style(index))
        _write(number, "features", "Number of features in the map")
        whose = "the true one" if kind == "truth" else f"that of {kind}"
        limit = "" if cutoff is None else f", cut off at {cutoff:.3g} m"
        _write(whole, "OSPA (m)", f"OSPA: distance of the map to {whose}{limit}")
        _write(first, "part of OSPA (m)", "Localisation part")
        _write(second, "", "Cardinality part")
        for axes in (first, second):
            axes.set_xlabel("time (s)")
        second.tick_params(labelleft=False)
        handles, labels = number.get_legend_handles_labels()
        columns = len(labels) if len(labels) < 5 else 3
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)
    return figure


def _panels(figure: Figure) -> tuple[Axes, Axes, Axes, Axes]:
    """For number of features, OSPA, and its two parts."""
    grid = figure.add_gridspec(3, 2, height_ratios=(1.1, 1.2, 1.0))
    number = figure.add_subplot(grid[0, :])
    whole = figure.add_subplot(grid[1, :], sharex=number)
    first = figure.add_subplot(grid[2, 0], sharex=number)
    return number, whole, first, figure.add_subplot(grid[2, 1], sharex=number, sharey=first)


def _draw(panels: tuple[Axes, ...], times: np.ndarray, curve: SetCurve, looks: dict[str, Any]) -> None:
    number, whole, first, second = panels
    number.plot(times, curve.number, drawstyle="steps-post", label=curve.method, **looks)
    whole.plot(times, curve.ospa, **looks)
    first.plot(times, curve.localisation, **looks)
    second.plot(times, curve.cardinality, **looks)


def run_set_figure(run: RunView) -> Figure:
    """Number of features and OSPA of one run over time; the number alone where there is no true map."""
    sets = run.sets
    assert sets is not None
    if sets.curve is not None and sets.true_number is not None:
        return set_error_figure(
            sets.times - run.start_time, [sets.curve], sets.true_number, sets.cutoff, kind=sets.kind
        )
    with style.house_style():
        figure = style.new_figure(height=3.0)
        axes = figure.add_subplot()
        axes.plot(sets.times - run.start_time, sets.number, drawstyle="steps-post", color=style.BLUE)
        _write(axes, "features", "Number of features in the map; this log has no true one to compare with")
        axes.set_xlabel("time since start (s)")
    return figure


def runs_set_figure(runs: Sequence[RunView]) -> Figure:
    """The same for those of several runs of a log whose maps are random finite sets with a true one beside them.

    A run that was cut short is drawn as far as it came.
    """
    places = [k for k, run in enumerate(runs) if run.sets is not None and run.sets.curve is not None]
    judged = [runs[k] for k in places]
    longest = max(judged, key=lambda run: run.sets.times[-1], default=None)  # type: ignore[union-attr]
    sets = None if longest is None else longest.sets
    if longest is None or sets is None or sets.true_number is None:
        return set_error_figure(np.zeros(0), [], np.zeros(0))
    curves = [_resampled(run, sets.times) for run in judged]
    times = sets.times - longest.start_time
    return set_error_figure(times, curves, sets.true_number, sets.cutoff, places, sets.kind)


def _resampled(run: RunView, times: np.ndarray) -> SetCurve:
    """A run's curve at these times, NaN beyond its end."""
    sets = run.sets
    assert sets is not None and sets.curve is not None
    parts = (sets.curve.number, sets.curve.ospa, sets.curve.localisation, sets.curve.cardinality)
    return SetCurve(run.method, *(np.interp(times, sets.times, part, right=np.nan) for part in parts))


def _write(axes: Axes, label: str, title: str) -> None:
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)
    axes.set_ylabel(label)
    axes.set_title(title)
