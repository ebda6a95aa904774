"""The floor plan: contours over what the scans swept, the drive, what is known from outside, and how sure it all is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.geometry.ellipses import ellipse_axes, ellipse_points
from kalmap.records import Contours, OccupancyGrid
from kalmap.records.grid import FREE, OCCUPIED
from kalmap.view import style
from kalmap.view.inputs import RunView
from kalmap.view.map_figure import Limits, draw_contours, draw_robot, limits_around

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Pixels a metre that walls need to be judged by eye, and the bounds of what that may make of a picture.
_PER_METRE, _LEAST_DPI, _MOST_DPI = 80.0, 300.0, 330.0
_UNKNOWN_SHADE, _FREE_SHADE, _OCCUPIED_SHADE = "#e9edf2", "#ffffff", "#a9bad0"
_SAMPLES_SHOWN, _POSES_SHOWN = 60, 12
_THICK = 0.05  # m, how thick a contour may be drawn
_CLOSE_UP = 6.0  # m, the side of the close-up
_POINTS_SHOWN = 60_000
# An ellipse that is smaller than this share of the plan's width is drawn larger, by one of these factors.
_VISIBLE, _FACTORS = 0.012, (1, 2, 5, 10, 20, 50, 100)


def plan_figure(run: RunView) -> Figure:
    """The whole floor, large enough to see whether walls are doubled or bent."""
    limits = plan_limits(run)
    figure, axes = _blank(limits)
    with style.house_style():
        # a wall that was mapped twice must not vanish in a thick line
        per_metre = 72.0 * style.WIDTH / (limits[1] - limits[0])
        _draw_plan(axes, run, width=min(max(_THICK * per_metre, 0.35), 0.9))
        _draw_drive(axes, run, limits)
        _draw_spread(axes, run, limits)
        contours = run.estimate.contours
        size = f"{len(contours)} samples" if contours is not None else "no contours"
        axes.set_title(f"{run.title}, {size}")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def close_up_figure(run: RunView) -> Figure:
    """The part of the plan with the most samples: each sample with its ellipse at true size, and what the scans hit."""
    limits = densest_part(run)
    figure, axes = _blank(limits)
    with style.house_style():
        _draw_points(axes, run, limits)
        _draw_plan(axes, run, width=1.1, alone=False)
        if run.estimate.contours is not None:
            _draw_samples(axes, run.estimate.contours, limits)
        axes.set_title(f"{run.title}, close up")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, markerscale=3.0)
    return figure


def plan_limits(run: RunView) -> Limits:
    """Left, right, bottom and top, m, that hold contours, walls and drive. Odometry does not count: it drifts away."""
    clouds = [run.path()[0], run.estimate.pose[None, :2]]
    if run.estimate.contours is not None:
        clouds.append(run.estimate.contours.positions)
    if run.reference is not None:
        clouds += [run.reference.walls.reshape(-1, 2), run.reference.path]
    return limits_around(np.concatenate(clouds), margin=0.04)


def densest_part(run: RunView) -> Limits:
    """The square of 6 m, on whole metres, with the most samples, and half a metre around it.

    Without samples it lies around the final pose.
    """
    positions = np.zeros((0, 2)) if run.estimate.contours is None else run.estimate.contours.positions
    if not len(positions):
        return _square(run.estimate.pose[:2] - 0.5 * _CLOSE_UP)
    cells, counts = np.unique(np.floor(positions).astype(np.int64), axis=0, return_counts=True)
    side = int(_CLOSE_UP)
    inside = np.all((cells[None] >= cells[:, None]) & (cells[None] < cells[:, None] + side), axis=2)
    # of squares that hold equally much, the one whose samples lie in its middle rather than at its edges
    aside = np.abs((inside[:, :, None] * (cells[None] - cells[:, None] + 0.5 - 0.5 * side)).sum(axis=1)).sum(
        axis=1
    )
    best = int(np.lexsort((aside, -(inside * counts).sum(axis=1)))[0])
    return _square(cells[best].astype(float))


def _square(corner: np.ndarray) -> Limits:
    left, bottom = (corner - 0.5).tolist()
    return left, left + _CLOSE_UP + 1.0, bottom, bottom + _CLOSE_UP + 1.0


def _blank(limits: Limits) -> tuple[Figure, Axes]:
    """A figure of the plan's proportions, with equal scales and a bar of known length."""
    span = max(limits[1] - limits[0], limits[3] - limits[2])
    dpi = min(max(_PER_METRE * span / style.WIDTH, _LEAST_DPI), _MOST_DPI)
    with style.house_style():
        height = style.WIDTH * (limits[3] - limits[2]) / (limits[1] - limits[0])
        figure = style.new_figure(height=0.94 * height + 1.2, dpi=dpi)
        axes = figure.add_subplot()
        axes.set_xlim(limits[:2])
        axes.set_ylim(limits[2:])
        axes.set_aspect("equal")
        axes.grid(False)
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        _draw_bar(axes, limits)
    return figure, axes


def _draw_plan(axes: Axes, run: RunView, width: float, alone: bool = True) -> None:
    """What was swept, true walls, and contours. width: of contours, in points. alone: see `draw_contours`."""
    from matplotlib.collections import LineCollection

    if run.grid is not None:
        _draw_grid(axes, run.grid)
    if run.reference is not None and len(run.reference.walls):
        walls = run.reference.walls.reshape(-1, 2, 2)
        looks: dict[str, Any] = {
            "colors": style.ORANGE,
            "linewidths": 2.6 * width,
            "alpha": 0.55,
            "zorder": 2.2,
        }
        lines = LineCollection(list(walls), label=f"walls, {run.reference.kind}", **looks)
        axes.add_collection(lines, autolim=False)
    if run.estimate.contours is not None:
        draw_contours(axes, run.estimate.contours, width, alone)


def _draw_drive(axes: Axes, run: RunView, limits: Limits) -> None:
    """The drive as it is seen at the end and by odometry alone, its start and the final pose."""
    if run.odometry is not None and len(run.odometry):
        looks: dict[str, Any] = {"color": style.GREY, "lw": 0.5, "ls": (0, (4, 2)), "zorder": 2.4}
        axes.plot(*run.odometry.T, label="odometry alone", **looks)
    path, label = run.path()
    if len(path):
        axes.plot(path[:, 0], path[:, 1], color=style.BLUE, lw=0.7, label=label, zorder=4)
        axes.plot(*path[0], "o", ms=5, mfc="white", mec=style.BLUE, mew=1.2, label="start", zorder=7.5)
    draw_robot(axes, run, limits)


def _draw_grid(axes: Axes, grid: OccupancyGrid) -> None:
    """Free, occupied and unknown as three light shades; unknown also beyond the grid."""
    limits = (*axes.get_xlim(), *axes.get_ylim())
    height, width = grid.cells.shape
    (left, low), (right, high) = ((np.array(limits).reshape(2, 2).T - grid.origin) / grid.resolution).tolist()
    columns = slice(max(0, math.floor(left)), max(0, min(width, math.ceil(right))))
    rows = slice(max(0, math.floor(low)), max(0, min(height, math.ceil(high))))
    cells = grid.cells[rows, columns]
    axes.set_facecolor(_UNKNOWN_SHADE)
    if not cells.size:
        return
    shades = np.empty(
        (*cells.shape, 3), dtype=np.uint8
    )  # bytes: a large plan in floats takes a gigabyte to draw
    shades[:] = _bytes(_UNKNOWN_SHADE)
    shades[cells == FREE] = _bytes(_FREE_SHADE)
    shades[cells == OCCUPIED] = _bytes(_OCCUPIED_SHADE)
    x, y = (grid.origin + grid.resolution * np.array([columns.start, rows.start])).tolist()
    extent = (x, x + cells.shape[1] * grid.resolution, y, y + cells.shape[0] * grid.resolution)
    axes.imshow(shades, extent=extent, origin="lower", interpolation="nearest", zorder=1)
    axes.set_xlim(limits[:2])
    axes.set_ylim(limits[2:])


def _bytes(shade: str) -> tuple[int, int, int]:
    from matplotlib.colors import to_rgb

    red, green, blue = (round(255.0 * part) for part in to_rgb(shade))
    return red, green, blue


def _draw_spread(axes: Axes, run: RunView, limits: Limits) -> None:
    """95 % ellipses of some samples and poses, drawn larger where they would vanish, which the legend says."""
    centres, covariances = _spread(run)
    good = np.isfinite(covariances).all(axis=(1, 2))
    if not good.any():
        return
    centres, covariances = centres[good], covariances[good]
    size = float(np.median(ellipse_axes(covariances)[0][:, 0]))
    wanted = 0.5 * _VISIBLE * (limits[1] - limits[0])
    factor = next((each for each in _FACTORS if each * size >= wanted), _FACTORS[-1])
    label = "95 % ellipses" if factor == 1 else f"95 % ellipses, drawn {factor} times as large"
    _draw_ellipses(axes, centres, factor**2 * covariances, label)


def _spread(run: RunView) -> tuple[np.ndarray, np.ndarray]:
    """Some samples and poses, evenly chosen: places (K, 2) and covariances (K, 2, 2)."""
    estimate = run.estimate
    centres, covariances = [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    known = []
    if estimate.contours is not None:
        known.append((estimate.contours.positions, estimate.contours.covariances, _SAMPLES_SHOWN))
    if estimate.trajectory is not None:
        course = estimate.trajectory
        known.append((course.poses[:, :2], course.covariances[:, :2, :2], _POSES_SHOWN))
    for places, spreads, most in known:
        chosen = np.unique(np.linspace(0, len(places) - 1, min(len(places), most)).round().astype(int))
        centres.append(places[chosen])
        covariances.append(spreads[chosen])
    return np.concatenate(centres), np.concatenate(covariances)


def _draw_ellipses(axes: Axes, centres: np.ndarray, covariances: np.ndarray, label: str) -> None:
    from matplotlib.collections import PolyCollection

    ellipses = PolyCollection(
        list(ellipse_points(centres, covariances)),
        facecolors=style.VERMILLION + "22",
        edgecolors=style.VERMILLION,
        linewidths=0.5,
        label=label,
        zorder=5,
    )
    axes.add_collection(ellipses, autolim=False)


def _draw_samples(axes: Axes, contours: Contours, limits: Limits) -> None:
    """Dots and true 95 % ellipses of the samples inside the limits."""
    inside = _inside(contours.positions, limits)
    if inside.any():
        _draw_ellipses(axes, contours.positions[inside], contours.covariances[inside], "95 % ellipses")
        places = contours.positions[inside]
        axes.scatter(places[:, 0], places[:, 1], s=5, c=style.BLACK, lw=0, label="samples", zorder=5.5)


def _draw_points(axes: Axes, run: RunView, limits: Limits) -> None:
    """What the scans hit, at their final places."""
    if run.estimate.sweeps is None:
        return
    points = run.estimate.sweeps().points()
    points = points[_inside(points, limits)]
    points = points[:: max(1, math.ceil(len(points) / _POINTS_SHOWN))]
    looks: dict[str, Any] = {"s": 1.5, "c": style.SKY, "lw": 0, "zorder": 3}
    axes.scatter(points[:, 0], points[:, 1], label="hit by beams", **looks)


def _inside(points: np.ndarray, limits: Limits) -> np.ndarray:
    left, right, bottom, top = limits
    x, y = points.T
    return np.asarray((x >= left) & (x <= right) & (y >= bottom) & (y <= top))


def _draw_bar(axes: Axes, limits: Limits) -> None:
    """A bar of 1, 2 or 5 times a power of ten of metres, lower left, under the walls: it must not hide one."""
    left, right, bottom, top = limits
    wanted = (right - left) / 6.0
    power = 10.0 ** math.floor(math.log10(wanted))
    length = power * max(each for each in (1, 2, 5) if each * power <= wanted)
    x, y = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([x, x + length], [y, y], color="#333333", lw=2.5, solid_capstyle="butt", zorder=2)
    above = y + 0.01 * (top - bottom)
    box = {"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.6}
    axes.text(
        x + 0.5 * length,
        above,
        f"{length:g} m",
        ha="center",
        va="bottom",
        color="#333333",
        zorder=2,
        bbox=box,
    )
