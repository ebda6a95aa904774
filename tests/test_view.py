"""Pictures: the right artists, no warnings, nothing left open, and something to show for every input."""

from __future__ import annotations

import subprocess
import sys
import warnings

import matplotlib
import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from kalmap.view import StudyCurve, comparison_figures, run_figures, save_figures, study_figure
from kalmap.view.compare_figure import bars_figure, error_curves_figure, maps_figure
from kalmap.view.consistency import chi_square_band, shares
from kalmap.view.consistency_figure import consistency_figure
from kalmap.view.error_figure import error_figure
from kalmap.view.map_figure import map_figure, map_limits
from kalmap.view.style import png_bytes
from kalmap.view.timing_figure import timing_figure
from test_view_samples import empty_run, loop_run

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def no_warnings():
    """Any warning of numpy or matplotlib is a fault."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def without(run, **errors):
    """The run with some fields of its errors replaced."""
    return msgspec.structs.replace(run, errors=msgspec.structs.replace(run.errors, **errors))


def labels(axes):
    return set(axes.get_legend_handles_labels()[1])


def texts(figure):
    return " ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def test_map_holds_what_is_known():
    run = loop_run()
    figure = map_figure(run)
    (axes,) = figure.axes
    assert labels(axes) == {
        "estimated path",
        "truth path",
        "landmarks, estimated",
        "landmarks, truth",
        "95 % ellipse",
        "start",
        "final pose, 95 %",
    }
    ellipses = next(one for one in axes.collections if one.get_label() == "95 % ellipse")
    dots = next(one for one in axes.collections if one.get_label() == "landmarks, estimated")
    assert len(ellipses.get_paths()) == len(dots.get_offsets()) == 35
    path = next(line for line in axes.lines if line.get_label() == "estimated path")
    np.testing.assert_array_equal(path.get_xydata(), run.trace.poses[:, :2])
    assert axes.get_aspect() == 1.0
    assert axes.get_title(loc="left") == "course-35: cr-cdkf, 35 landmarks"


def test_map_without_reference_or_landmarks_or_path():
    (axes,) = map_figure(msgspec.structs.replace(loop_run(), reference=None)).axes
    assert "truth path" not in labels(axes)
    figure = map_figure(empty_run())
    assert labels(figure.axes[0]) == {"final pose, 95 %"}
    assert "no path" in texts(figure)


def test_gps_is_drawn_as_dots():
    run = loop_run(2)
    run = msgspec.structs.replace(run, reference=msgspec.structs.replace(run.reference, kind="gps"))
    line = next(one for one in map_figure(run).axes[0].lines if one.get_label() == "gps path")
    assert line.get_linestyle() == "None"


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (50.0, 1.0), (1.0, 50.0), (0.0, 0.0)])
def test_map_limits_hold_all_and_are_neither_slit_nor_tower(stretch):
    run = loop_run(10)
    run.trace.poses[:, :2] *= stretch
    run = msgspec.structs.replace(run, reference=None)
    left, right, bottom, top = map_limits([run])
    x, y = run.trace.poses[:, 0], run.trace.poses[:, 1]
    assert left < x.min()
    assert x.max() < right
    assert bottom < y.min()
    assert y.max() < top
    assert 0.39 < (top - bottom) / (right - left) < 1.01


def test_errors_have_three_axes_with_bands():
    run = loop_run()
    figure = error_figure(run)
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "x error (m)",
        "y error (m)",
        "heading error (deg)",
    ]
    heading = figure.axes[2]
    np.testing.assert_allclose(heading.lines[0].get_ydata(), np.degrees(run.errors.values[:, 2]))
    assert heading.lines[0].get_xdata()[0] == 0.0
    assert all(len(axes.collections) == 1 for axes in figure.axes)


def test_errors_without_headings_show_the_distance():
    run = loop_run()
    values = run.errors.values * (1.0, 1.0, np.nan)
    (axes,) = error_figure(without(run, values=values)).axes
    np.testing.assert_allclose(axes.lines[0].get_ydata(), np.hypot(values[:, 0], values[:, 1]))


def test_what_is_missing_is_said():
    nothing = empty_run()
    assert "no reference" in texts(error_figure(nothing))
    assert "needs the true pose" in texts(consistency_figure(nothing))
    assert "no sighting" in texts(consistency_figure(nothing))
    assert "No step" in texts(timing_figure(nothing))
    assert "No metrics" in texts(bars_figure({"ekf": {"a": None}}))
    assert "No runs" in texts(maps_figure([]))
    assert "no reference" in texts(error_curves_figure([nothing]))
    assert "No curves" in texts(study_figure([]))


def test_consistency_dots_are_judged_each_by_its_own_band():
    run = loop_run()
    figure = consistency_figure(run)
    for axes, values, dof in (
        (figure.axes[0], run.errors.nees, np.full(400, 3)),
        (figure.axes[1], run.trace.nis, run.trace.nis_dof),
    ):
        known = np.isfinite(values) & (dof > 0)
        cumulative = chi2.cdf(values[known], dof[known])
        inside = (cumulative >= 0.025) & (cumulative <= 0.975)
        dots = {one.get_label(): one for one in axes.collections}
        assert len(dots["inside"].get_offsets()) == inside.sum()
        assert len(dots["outside"].get_offsets()) == (~inside).sum()
        assert f"{100 * inside.mean():.1f} % inside" in axes.get_legend().get_title().get_text()
        assert axes.get_yscale() == "linear"


def test_far_outliers_get_a_logarithmic_axis():
    run = loop_run()
    run.errors.nees[10] = 1e4
    assert consistency_figure(run).axes[0].get_yscale() == "log"


def test_bands_and_shares():
    lower, upper = chi_square_band(np.array([1, 3, 40, 0]))
    np.testing.assert_allclose(lower[:3], chi2.ppf(0.025, [1, 3, 40]))
    np.testing.assert_allclose(upper[:3], chi2.ppf(0.975, [1, 3, 40]))
    assert np.isnan(lower[3])
    values = np.array([0.0, 3.0, 3.0, 100.0, np.nan])
    assert shares(values, 3.0) == pytest.approx((0.25, 0.5, 0.25))
    assert np.isnan(shares(values[4:], 3.0)).all()


def test_timing_marks_mean_percentile_and_largest():
    run = loop_run()
    figure = timing_figure(run)
    spent = 1e3 * run.trace.step_seconds
    marks = [line.get_ydata()[0] for line in figure.axes[0].lines[1:4]]
    np.testing.assert_allclose(marks, [spent.mean(), np.percentile(spent, 99), spent.max()])
    assert sum(patch.get_width() for patch in figure.axes[1].patches) == len(spent)


def test_timing_of_steps_that_took_no_time():
    run = loop_run()
    run.trace.step_seconds[:] = 0.0
    assert png_bytes(timing_figure(run)).startswith(PNG)


def test_comparison_draws_every_method():
    runs = [loop_run(seed=seed, method=name) for seed, name in enumerate(("a", "b", "c"))]
    metrics = {run.method: {"nees": 3.0 + k, "deep": {"x_m": -1.0 * k}} for k, run in enumerate(runs)}
    metrics["c"]["nees"] = float("nan")
    figures = comparison_figures(runs, metrics)
    assert [axes.get_title(loc="left") for axes in figures["maps"].axes[:3]] == ["a", "b", "c"]
    assert [line.get_label() for line in figures["error-curves"].axes[0].lines] == ["a", "b", "c"]
    bars = figures["metrics"].axes
    assert [axes.get_title(loc="left") for axes in bars] == ["NEES", "Deep x (m)"]
    assert [patch.get_width() for patch in bars[0].patches] == [3.0, 4.0, 0.0]
    assert bars[0].texts[2].get_text() == "unknown"
    assert all(png_bytes(figure).startswith(PNG) for figure in figures.values())


def test_bars_prefer_the_headlines():
    metrics = {"ekf": {"steps": 7, "step_ms_mean": 2.0, "position_rmse_m": 1.0, "nees_mean": None}}
    titles = [axes.get_title(loc="left") for axes in bars_figure(metrics).axes]
    assert titles == ["Position RMSE (m)", "Step mean (ms)"]


def test_study_curves_are_in_degrees():
    curve = StudyCurve("ekf", np.arange(3.0), np.ones(3), np.full(3, np.pi / 180))
    position, heading = study_figure([curve]).axes
    np.testing.assert_allclose(position.lines[0].get_ydata(), 1.0)
    np.testing.assert_allclose(heading.lines[0].get_ydata(), 1.0)


@pytest.mark.parametrize(
    "make",
    [loop_run, lambda: loop_run(400, 150.0, 3000), empty_run, lambda: empty_run(1), lambda: empty_run(3)],
    ids=["35 landmarks", "400 landmarks", "no frames", "one frame", "three frames"],
)
def test_all_figures_are_saved_as_png(make, tmp_path):
    paths = save_figures(tmp_path / "new", run_figures(make()))
    assert set(paths) == {"map", "errors", "consistency", "timing"}
    for path in paths.values():
        content = path.read_bytes()
        assert content.startswith(PNG)
        assert len(content) > 3000


def test_saved_width_is_about_1000_pixels(tmp_path):
    from PIL import Image

    for path in save_figures(tmp_path, run_figures(loop_run())).values():
        with Image.open(path) as image:
            assert image.width == 1000
            assert 300 < image.height < 1400


def test_a_figure_is_drawn_the_same_twice():
    assert png_bytes(map_figure(loop_run(5))) == png_bytes(map_figure(loop_run(5)))


def test_users_parameters_neither_matter_nor_change():
    plain = png_bytes(map_figure(loop_run(5)))
    with matplotlib.rc_context({"lines.linewidth": 20.0, "font.size": 30.0}):
        before = dict(matplotlib.rcParams)
        assert png_bytes(map_figure(loop_run(5))) == plain
        assert dict(matplotlib.rcParams) == before


def test_matplotlib_is_not_loaded_before_it_is_needed():
    code = "import sys, kalmap.view; sys.exit('matplotlib' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
