"""A study's RMS errors over time: one curve a method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from kalmap.view import style
from kalmap.view.inputs import StudyCurve

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def study_figure(curves: Sequence[StudyCurve], title: str = "RMS error over all runs") -> Figure:
    """Position (m) and heading (deg) RMS errors over time for several methods, side by side.

    The second is left out where the reference knows no headings.
    """
    with style.house_style():
        figure = style.new_figure(height=4.0)
        headings = all(len(curve.heading) for curve in curves)
        position, *heading = figure.subplots(1, 1 + headings, sharex=True, squeeze=False)[0]
        for index, curve in enumerate(curves):
            looks = style.method_style(index)
            position.plot(curve.times, curve.position, label=curve.method, **looks)
            for axes in heading:
                axes.plot(curve.times, np.degrees(curve.heading), **looks)
        for axes in (position, *heading):
            axes.set_ylabel("position RMS error (m)" if axes is position else "heading RMS error (deg)")
            axes.set_xlabel("time (s)")
            if curves:
                axes.set_ylim(bottom=0.0)
            else:
                style.say(axes, "No curves: the study has no finished runs.")
        position.set_title(title)
        if curves:
            columns = min(4, len(curves))
            figure.legend(*position.get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure
