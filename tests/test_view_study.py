"""What studies show beside error curves: dots of seeds, tracks of movers, columns with decimals, what to know first."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

from kalmap.view import StudyDots, StudyRow, StudyTable, dots_figure, maps_figure, render_study
from kalmap.view.style import png_bytes
from test_view_samples import loop_run


@pytest.fixture(autouse=True)
def no_warnings():
    """Any warning of numpy or matplotlib is a fault."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def rows(*values, paper=None):
    return [
        StudyDots(name, np.array(each, dtype=float), group, paper)
        for name, group, each in zip("abc", ("one", "one", "two"), values, strict=False)
    ]


def dots(axes):
    return [line for line in axes.get_lines() if line.get_marker() == "o"]


def test_a_dot_a_seed_and_the_mean_beside_the_panel():
    """Oracle: the values themselves; the mean by hand."""
    figure = dots_figure({"left": rows([1, 2, 6], [4], [5, 5]), "right": rows([2], [2], [2])}, "m")
    left, right = figure.axes
    assert [list(line.get_xdata()) for line in dots(left)] == [[1, 2, 6], [4], [5, 5]]
    assert [text.get_text() for text in left.texts] == ["3.00", "4.00", "5.00"]
    bars = [line.get_xdata()[0] for line in left.get_lines() if line.get_marker() == "|"]
    assert bars == [3.0, 4.0, 5.0] and right.get_title(loc="left") == "right"
    places = [np.asarray(line.get_ydata()) for line in dots(left)]
    assert all(np.abs(place - k).max() < 0.5 for k, place in enumerate(places))
    assert dots(left)[0].get_color() == dots(left)[1].get_color() != dots(left)[2].get_color()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["one", "two", "mean over the seeds"]
    assert png_bytes(figure).startswith(b"\x89PNG")


def test_the_papers_value_and_a_line_are_named_once():
    panels = {"a": rows([1, 2], [3, 4], paper=2.5), "b": rows([1, 2], [3, 4])}
    figure = dots_figure(panels, "m", line=(2.0, "two"), decimals=1)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert sorted(labels) == ["mean over the seeds", "one", "the paper's mean", "two"]
    diamonds = [line.get_xdata()[0] for line in figure.axes[0].get_lines() if line.get_marker() == "D"]
    assert diamonds == [2.5, 2.5] and figure.axes[0].texts[0].get_text() == "1.5"


def test_what_cannot_be_drawn_is_left_out():
    """NaN, infinity, no seeds at all, and on a logarithmic axis what is not above zero."""
    values = [np.nan, np.inf, 0.0, -1.0, 10.0], [], [1.0]
    figure = dots_figure({"all": rows(*values)}, "m", log=True)
    assert [list(line.get_xdata()) for line in dots(figure.axes[0])] == [[10.0], [1.0]]
    assert len(dots(dots_figure({"all": rows(*values)}, "m").axes[0])[0].get_xdata()) == 3
    assert png_bytes(figure) and png_bytes(dots_figure({"all": rows([1.0, 1000.0])}, "m", log=True))
    for nothing in ({}, {"empty": []}):
        assert "No methods" in dots_figure(nothing, "m").axes[0].texts[0].get_text()


def test_tracks_lie_beneath_the_map():
    tracks = np.cumsum(np.ones((5, 3, 2)), axis=0)
    run = loop_run()
    figure, plain = maps_figure([run, run], tracks), maps_figure([run, run])
    for axes, without in zip(figure.axes, plain.axes, strict=True):
        drawn = axes.get_lines()[:3]
        assert [list(line.get_xdata()) for line in drawn] == [[1, 2, 3, 4, 5]] * 3
        others = [artist.get_zorder() for artist in without.get_lines() + without.collections]
        assert max(line.get_zorder() for line in drawn) < min(others)
        assert axes.get_legend_handles_labels()[1].count("tracks of movers") == 1
        assert axes.get_xlim() == without.get_xlim()
    nobody = maps_figure([run], np.zeros((5, 0, 2)))
    assert "tracks of movers" not in nobody.axes[0].get_legend_handles_labels()[1]


def test_columns_may_have_their_own_decimals_and_the_page_says_first_what_to_know():
    table = StudyTable(
        "T",
        ("share", "count", "m"),
        (StudyRow("a", (0.93456, 252.0, 0.5), (0.9, None, None)),),
        decimals=(4, 0, None),
    )
    page = render_study("Study", [table], about=["Read <this> first."], warnings=["Beware."])
    cells = re.findall(r'<td class="n">([^<]*)', page)
    assert cells == ["0.9346", "252", "0.500"] and '"paper">0.9000<' in page
    assert page.index("Beware.") < page.index("Read &lt;this&gt; first.") < page.index("0.9346")
    assert "What is compared" not in render_study("Study", [table])
