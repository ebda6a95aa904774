"""The floor plan: what it shows and leaves out, at which scale, for every kind of input."""

from __future__ import annotations

import io
import warnings

import msgspec
import numpy as np
import pytest
from PIL import Image

from contour_samples import REACH, contours_of, floor_run
from kalmap.perception import occupancy_grid
from kalmap.records import OccupancyGrid, Sweeps, Trajectory
from kalmap.records.grid import FREE, OCCUPIED, UNKNOWN
from kalmap.view import run_figures
from kalmap.view.contour_report import contour_cards, contour_section, relation_cards
from kalmap.view.map_figure import draw_map
from kalmap.view.plan_figure import close_up_figure, densest_part, plan_figure, plan_limits
from kalmap.view.style import new_figure, png_bytes
from kalmap.view.summary import summary_cards
from test_view_samples import empty_run


@pytest.fixture(autouse=True)
def no_warnings():
    """Any warning of numpy or matplotlib is a fault."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def full():
    run = floor_run()
    return msgspec.structs.replace(run, grid=occupancy_grid(run.estimate.sweeps(), max_range=REACH))


def labels(figure):
    return set(figure.axes[0].get_legend_handles_labels()[1])


def shown(figure):
    """The picture as (rows, columns, 3) and where its axes lie in it, in pixels from its upper left."""
    image = np.asarray(Image.open(io.BytesIO(png_bytes(figure))).convert("RGB"))
    return image, figure.axes[0].get_window_extent()


def test_the_plan_holds_what_is_known():
    run = full()
    figure = plan_figure(run)
    assert labels(figure) == {
        "walls, truth",
        "odometry alone",
        "contours",
        "samples alone",
        "estimated path",
        "start",
        "final pose, 95 %",
        "95 % ellipses, drawn 2 times as large",
    }
    (axes,) = figure.axes
    lines = {artist.get_label(): artist for artist in axes.collections}
    drawn = lines["contours"].get_segments()
    strands = [rows for rows in run.estimate.contours.strands() if len(rows) > 1]
    assert len(drawn) == len(strands)
    for line, rows in zip(drawn, strands, strict=True):
        np.testing.assert_array_equal(line, run.estimate.contours.positions[rows])
    path = next(line for line in axes.lines if line.get_label() == "estimated path")
    np.testing.assert_array_equal(path.get_xydata(), run.estimate.trajectory.poses[:, :2])
    assert axes.get_aspect() == 1.0
    assert "475 samples" in axes.get_title(loc="left")
    assert [text.get_text() for text in axes.texts] == ["2 m"]


def test_the_scale_bar_is_as_long_as_it_says():
    (axes,) = plan_figure(full()).axes
    bar = next(line for line in axes.lines if line.get_linewidth() == 2.5)
    assert np.ptp(bar.get_xdata()) == pytest.approx(2.0)


def test_a_floor_is_large_enough_for_the_eye():
    run = full()
    image, place = shown(plan_figure(run))
    limits = plan_limits(run)
    assert place.width / (limits[1] - limits[0]) > 80  # pixels a metre
    assert place.height / (limits[3] - limits[2]) == pytest.approx(
        place.width / (limits[1] - limits[0]), rel=0.01
    )
    assert image.shape[1] == 2500


def test_free_occupied_and_unknown_lie_where_they_are():
    cells = np.full((12, 20), UNKNOWN, dtype=np.int8)
    cells[:6, :] = FREE
    cells[9:, 10:] = OCCUPIED
    run = floor_run()
    bare = msgspec.structs.replace(
        run,
        estimate=msgspec.structs.replace(run.estimate, contours=contours_of([]), trajectory=None),
        odometry=None,
        reference=msgspec.structs.replace(run.reference, walls=np.zeros((0, 4))),
        grid=OccupancyGrid(np.zeros(2), 1.0, cells),
    )
    image, place = shown(plan_figure(bare))
    limits = plan_limits(bare)

    def pixel(x, y):
        column = place.x0 + (x - limits[0]) / (limits[1] - limits[0]) * place.width
        row = image.shape[0] - place.y0 - (y - limits[2]) / (limits[3] - limits[2]) * place.height
        return tuple(int(value) for value in image[round(row), round(column)])

    assert pixel(4.5, 3.2) == (255, 255, 255)
    assert pixel(13.5, 9.6) == (0xA9, 0xBA, 0xD0)
    assert pixel(4.5, 8.0) == (0xE9, 0xED, 0xF2)


def test_drifting_odometry_does_not_shrink_the_plan():
    run = floor_run()
    away = msgspec.structs.replace(run, odometry=1000.0 * run.odometry)
    assert plan_limits(away) == plan_limits(run)
    assert plan_figure(away).axes[0].get_xlim() == plan_figure(run).axes[0].get_xlim()


def test_the_close_up_is_the_densest_square_by_brute_force():
    run = floor_run()
    left, right, bottom, top = densest_part(run)
    assert (right - left, top - bottom) == (7.0, 7.0)
    x, y = run.estimate.contours.positions.T
    counts = {
        (i, j): int(((x >= i) & (x < i + 6) & (y >= j) & (y < j + 6)).sum())
        for i in range(-8, 22)
        for j in range(-8, 14)
    }
    assert counts[(left + 0.5, bottom + 0.5)] == max(counts.values())
    figure = close_up_figure(full())
    assert labels(figure) == {"walls, truth", "contours", "samples", "95 % ellipses", "hit by beams"}
    inside = {artist.get_label(): len(artist.get_offsets()) for artist in figure.axes[0].collections}
    square = (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
    assert inside["samples"] == square.sum()


def test_ellipses_are_drawn_as_the_legend_says():
    run = floor_run()
    contours = contours_of([np.array([[5.0, 5.0]])], sigma=0.1)
    lone = msgspec.structs.replace(run.estimate, contours=contours, trajectory=None)
    (axes,) = plan_figure(msgspec.structs.replace(run, estimate=lone)).axes
    found = next(artist for artist in axes.collections if "ellipses" in artist.get_label())
    corners = found.get_paths()[0].vertices
    factor = 1 if found.get_label() == "95 % ellipses" else int(found.get_label().split()[4])
    assert np.ptp(corners[:, 0]) == pytest.approx(2 * factor * np.sqrt(5.991) * 0.3, rel=0.01)


@pytest.mark.parametrize(
    "change",
    [
        {"contours": contours_of([])},
        {"contours": contours_of([np.array([[3.0, 4.0]])])},
        {"trajectory": None},
        {"trajectory": Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))},
        {"sweeps": None},
        {"sweeps": lambda: Sweeps(np.zeros((0, 3)), ())},
    ],
)
def test_every_map_can_be_drawn(change):
    run = floor_run()
    run = msgspec.structs.replace(
        run, estimate=msgspec.structs.replace(run.estimate, **change), reference=None
    )
    for figure in (plan_figure(run), close_up_figure(run)):
        figure.canvas.draw()
        image = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        assert (
            image.shape[0] > 500 and (image[..., :3] < 128).any() and np.isfinite(figure.axes[0].axis()).all()
        )


def test_a_run_of_contours_has_a_plan_and_one_of_landmarks_a_map():
    nothing = empty_run()
    drawn = run_figures(
        msgspec.structs.replace(
            nothing, estimate=msgspec.structs.replace(nothing.estimate, contours=contours_of([]))
        )
    )
    assert list(drawn) == ["plan", "plan-close-up", "errors", "consistency", "timing"]
    assert list(run_figures(nothing)) == ["map", "errors", "consistency", "timing"]


def test_a_plan_is_drawn_the_same_twice():
    run = full()
    assert png_bytes(close_up_figure(run)) == png_bytes(close_up_figure(run))


def test_maps_side_by_side_hold_contours():
    axes = new_figure().add_subplot()
    draw_map(axes, floor_run(), (0.0, 20.0, 0.0, 12.0))
    assert "contours" in axes.get_legend_handles_labels()[1]


def test_cards_and_section_read_the_numbers():
    contours = contours_of([np.array([[0.0, 0.0], [3.0, 4.0]])], sigma=0.02)
    metrics = {
        "crispness_mean_m": 0.0123,
        "crispness_beyond_share": 0.05,
        "map_error_rms_m": 0.02,
        "loop_error_m": 0.3,
        "loop_error_deg": 1.5,
    }
    cards = {label: (value, unit, says) for label, value, unit, says in contour_cards(contours, metrics)}
    assert cards["Contour samples"] == ("2", "", "in 1 run, 5.00 m of contours.")
    assert cards["Crispness"][:2] == ("1.23", "cm")
    assert "5.00 % lie far off" in cards["Crispness"][2]
    assert cards["Map error"][:2] == ("2.00", "cm RMS")
    assert cards["Loop error"][:2] == ("0.300", "m")
    assert [label for label, *_ in contour_cards(contours, {})] == ["Contour samples"]
    section = contour_section(contours)
    # across: sigma; along: 3 sigma; the second sample's are twice as large
    assert "across the contour" in section
    for value in ("3.00", "4.00", "9.00", "12.0"):
        assert value in section


def test_known_motions_stand_in_for_a_reference_path():
    metrics = {
        "relations_translation_mean_m": 0.0312,
        "relations_translation_std_m": 0.02,
        "relations_rotation_mean_deg": 0.61,
        "relations_rotation_std_deg": 1.4,
        "relations_found": 2980,
        "relations_missed": 4,
    }
    (card,) = relation_cards(metrics)
    assert card[:3] == ("Relations error", "0.0312", "m mean")
    assert card[3] == "± 0.0200 m and 0.610 ± 1.40 deg, over 2980 motions, 4 not found."
    assert not list(relation_cards({"relations_translation_mean_m": None}))
    run = msgspec.structs.replace(floor_run(), reference=None)
    named = [[label for label, *_ in summary_cards(run, given)] for given in ({}, metrics)]
    assert "Accuracy" in named[0]
    assert "Accuracy" not in named[1]
