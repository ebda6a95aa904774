"""NEES and NIS over time: whether the filter's own covariances tell the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.view import style
from kalmap.view.consistency import chi_square_band, shares
from kalmap.view.inputs import Errors, RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Bands and means are drawn over this many stretches of time; the dots are judged one by one.
_STRETCHES = 120
# Above this many instants the dots are small and faint, to leave the band visible.
_CROWD = 1500
# A logarithmic axis from where the largest value is this many times the band's upper bound.
_LOGARITHMIC = 4.0


def consistency_figure(run: RunView) -> Figure:
    """NEES (needs truth) above NIS per degree of freedom (needs none), each with its 95 % band.

    Where the map is a random finite set there is no innovation of a whole frame, and no NIS.
    """
    with style.house_style():
        whole = run.sets is None
        figure = style.new_figure(height=6.0 if whole else 3.2)
        upper, *lower = figure.subplots(1 + whole, 1, squeeze=False)[:, 0]
        _draw_nees(upper, run.errors, run.start_time)
        upper.set_title("NEES: pose error over its stated covariance")
        for axes in lower:
            _draw_nis(axes, run)
            axes.set_title("NIS per degree of freedom: innovation over its stated covariance")
        for axes in (upper, *lower):
            axes.set_xlabel("time since start (s)")
    return figure


def _draw_nees(axes: Axes, errors: Errors | None, start: float) -> None:
    if errors is None or not np.isfinite(errors.nees).any():
        style.say(axes, "NEES needs the true pose, which this log does not give.")
        return
    dof = np.full(len(errors), float(errors.nees_dof))
    _draw_ratio(axes, errors.times - start, errors.nees, dof, per_dof=False)
    axes.set_ylabel(f"NEES ({errors.nees_dof} is right)")


def _draw_nis(axes: Axes, run: RunView) -> None:
    trace = run.trace
    if not (np.isfinite(trace.nis) & (trace.nis_dof > 0)).any():
        style.say(axes, "No NIS: no sighting was used.")
        return
    _draw_ratio(axes, trace.times - run.start_time, trace.nis, trace.nis_dof, per_dof=True)
    axes.set_ylabel("NIS / dof (1 is right)")


def _draw_ratio(axes: Axes, times: np.ndarray, values: np.ndarray, dof: np.ndarray, *, per_dof: bool) -> None:
    """Dots judged each by its own band, the band and a running mean; log scale for far outliers."""
    known = np.isfinite(values) & (dof > 0)
    times, values, dof = times[known], values[known], np.asarray(dof, dtype=np.float64)[known]
    scale = dof if per_dof else np.ones(len(dof))
    low, high = chi_square_band(dof)
    inside = (values >= low) & (values <= high)
    share = shares(values, dof)[1]
    shown, low, high = values / scale, low / scale, high / scale
    looks: dict[str, Any] = {"s": 9.0, "lw": 0, "zorder": 3}
    if len(times) > _CROWD:
        looks |= {"s": 2.0, "alpha": 0.35}
    axes.scatter(times[inside], shown[inside], c=style.BLUE, label="inside", **looks)
    axes.scatter(times[~inside], shown[~inside], c=style.VERMILLION, label="outside", **looks)
    middles, mean, floor, ceiling = _by_stretch(times, shown, low, high)
    axes.fill_between(middles, floor, ceiling, color=style.GREEN, alpha=0.18, lw=0, label="95 % band")
    for edge in (floor, ceiling):
        axes.plot(middles, edge, color=style.GREEN, lw=0.9, zorder=4)
    axes.plot(middles, mean, color=style.BLACK, lw=1.1, label="running mean", zorder=4)
    axes.axhline(
        1.0 if per_dof else dof[0], color=style.GREEN, lw=1.2, ls="--", label="right on average", zorder=4
    )
    if shown.max() > _LOGARITHMIC * high.max():
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * float(low.min()))
    else:
        axes.set_ylim(0.0, 1.08 * float(max(shown.max(), high.max())))
    verdict = f"{100 * share:.1f} % inside\n(95 % is right)\n"
    legend = axes.legend(
        loc="upper left", bbox_to_anchor=(1.0, 1.0), title=verdict, markerscale=3.0 / looks["s"] ** 0.5
    )
    for handle in legend.legend_handles:
        if handle is not None and handle.get_alpha() == looks.get("alpha", 1.0):
            handle.set_alpha(1.0)


def _by_stretch(times: np.ndarray, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean of the times and of each column over up to `_STRETCHES` runs of neighbours."""
    count = min(_STRETCHES, len(times))
    first = np.linspace(0, len(times), count, endpoint=False).astype(int)
    lengths = np.diff(np.append(first, len(times)))
    return tuple(np.add.reduceat(column, first) / lengths for column in (times, *columns))
