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
    """Position (m) and heading (deg) RMS errors over time for several methods, side by side."""
    with style.house_style():
        figure = style.new_figure(height=4.0)
        position, heading = figure.subplots(1, 2, sharex=True)
        for index, curve in enumerate(curves):
            looks = style.method_style(index)
            position.plot(curve.times, curve.position, label=curve.method, **looks)
            heading.plot(curve.times, np.degrees(curve.heading), **looks)
        for axes, label in ((position, "position RMS error (m)"), (heading, "heading RMS error (deg)")):
            axes.set_ylabel(label)
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
