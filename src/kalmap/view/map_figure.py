"""The map: path, landmarks with their ellipses, what is known from outside, and the robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.geometry.ellipses import ellipse_points
from kalmap.records import Contours, Landmarks
from kalmap.view import style
from kalmap.view.inputs import Aligned, RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Above this many landmarks, marks get smaller and lines thinner.
_MANY = 120
# Height over width of a map lies between these.
_FLATTEST, _TALLEST = 0.4, 1.0
Limits = tuple[float, float, float, float]


def map_figure(run: RunView) -> Figure:
    """Path, landmarks with 95 % ellipses, reference where there is one, start and final pose."""
    limits = map_limits([run])
    with style.house_style():
        height = style.WIDTH * (limits[3] - limits[2]) / (limits[1] - limits[0])
        figure = style.new_figure(height=0.92 * height + 1.3)
        axes = figure.add_subplot()
        draw_map(axes, run, limits)
        axes.set_title(f"{run.title}, {_count(len(run.estimate.landmarks))}")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def map_limits(runs: list[RunView]) -> Limits:
    """Left, right, bottom and top that hold what all runs estimate and know, with a margin, m.

    Ellipses do not count: an unsure landmark must not shrink the rest.
    """
    clouds = [np.zeros((0, 2))]
    for run in runs:
        clouds += [run.path()[0], run.estimate.landmarks.positions, run.estimate.pose[None, :2]]
        if run.estimate.contours is not None:
            clouds.append(run.estimate.contours.positions)
        if run.reference is not None:
            clouds += [run.reference.path, run.reference.landmarks]
    return limits_around(np.concatenate(clouds))


def limits_around(points: np.ndarray, margin: float = 0.1) -> Limits:
    """Left, right, bottom and top, m, that hold the finite points (N, 2), with a margin: a share of the longer half."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
    middle, half = (low + high) / 2, (high - low) / 2
    half += max(margin * float(half.max()), 0.5)
    # Neither a slit nor a tower: the shorter side is widened, and the picture stays filled.
    half = np.maximum(half, (half[1] / _TALLEST, half[0] * _FLATTEST))
    (left, bottom), (right, top) = (middle - half).tolist(), (middle + half).tolist()
    return left, right, bottom, top


def draw_map(axes: Axes, run: RunView, limits: Limits) -> None:
    """Draw one run's map into axes, with equal scales."""
    if run.reference is not None:
        _draw_reference(axes, run.reference)
    _draw_landmarks(axes, run.estimate.landmarks)
    if run.estimate.contours is not None:
        draw_contours(axes, run.estimate.contours, width=0.7)
    path, label = run.path()
    if len(path):
        axes.plot(path[:, 0], path[:, 1], color=style.BLUE, label=label, zorder=4)
        axes.plot(*path[0], "o", ms=8, mfc="white", mec=style.BLUE, mew=1.6, label="start", zorder=6)
    else:
        axes.text(
            0.5, 0.96, "no path: the trace is empty", transform=axes.transAxes, ha="center", color=style.GREY
        )
    draw_robot(axes, run, limits)
    axes.set_xlim(limits[:2])
    axes.set_ylim(limits[2:])
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def _draw_reference(axes: Axes, reference: Aligned) -> None:
    """The reference's path, as dots where it jumps like GPS, and its landmarks as crosses."""
    many = len(reference.landmarks) > _MANY
    if len(reference.path):
        looks: dict[str, Any] = (
            {"ls": "", "marker": ".", "ms": 2.0} if reference.kind == "gps" else {"ls": "-", "lw": 1.0}
        )
        path = reference.path
        axes.plot(path[:, 0], path[:, 1], color=style.GREY, label=f"{reference.kind} path", zorder=2, **looks)
    if len(reference.landmarks):
        crosses = reference.landmarks
        size, width = (7.0, 0.5) if many else (28.0, 0.9)
        label = f"landmarks, {reference.kind}"
        axes.scatter(
            crosses[:, 0], crosses[:, 1], s=size, marker="x", c=style.BLACK, lw=width, label=label, zorder=5
        )


def _draw_landmarks(axes: Axes, landmarks: Landmarks) -> None:
    """A dot for each landmark, so that none vanishes, and over it the 95 % ellipse."""
    from matplotlib.collections import PolyCollection

    if not len(landmarks):
        return
    many = len(landmarks) > _MANY
    ellipses = PolyCollection(
        list(ellipse_points(landmarks.positions, landmarks.covariances)),
        facecolors=style.VERMILLION + ("12" if many else "22"),
        edgecolors=style.VERMILLION,
        linewidths=0.5 if many else 0.9,
        label="95 % ellipse",
        zorder=3,
    )
    dots: dict[str, Any] = {"s": 3.5 if many else 12.0, "c": style.VERMILLION, "lw": 0, "zorder": 3.5}
    axes.scatter(landmarks.positions[:, 0], landmarks.positions[:, 1], label="landmarks, estimated", **dots)
    axes.add_collection(ellipses)


def draw_contours(axes: Axes, contours: Contours, width: float, alone: bool = True) -> None:
    """Each run as a line of that width (points), samples that are alone as dots unless these are drawn elsewhere."""
    from matplotlib.collections import LineCollection

    strands = contours.strands()
    lines = [contours.positions[rows] for rows in strands if len(rows) > 1]
    if lines:
        looks: dict[str, Any] = {
            "colors": style.BLACK,
            "linewidths": width,
            "capstyle": "round",
            "zorder": 3.5,
        }
        axes.add_collection(LineCollection(lines, label="contours", **looks), autolim=False)
    single = [rows[0] for rows in strands if len(rows) == 1]
    if single and alone:
        places = contours.positions[single]
        dots: dict[str, Any] = {"s": 4.0 * width, "c": style.BLACK, "lw": 0, "zorder": 3.5}
        axes.scatter(places[:, 0], places[:, 1], label="samples alone", **dots)


def draw_robot(axes: Axes, run: RunView, limits: Limits) -> None:
    """The final pose as an arrow-head that points ahead, with its 95 % ellipse."""
    x, y, heading = run.estimate.pose
    if not np.isfinite(run.estimate.pose).all():
        return
    length = 0.02 * max(limits[1] - limits[0], limits[3] - limits[2])
    shape = length * np.array([[1.2, 0.0], [-0.8, 0.7], [-0.4, 0.0], [-0.8, -0.7]])
    cos, sin = np.cos(heading), np.sin(heading)
    corners = shape @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    ellipse = ellipse_points(run.estimate.pose[:2], run.estimate.covariance[:2, :2])
    axes.fill(*ellipse.T, fc=style.PURPLE + "44", ec=style.PURPLE, lw=1.0, zorder=6)
    axes.fill(*corners.T, fc=style.PURPLE, ec="white", lw=0.8, label="final pose, 95 %", zorder=7)


def _count(landmarks: int) -> str:
    if not landmarks:
        return "no landmarks"
    return f"{landmarks} landmark" + ("s" if landmarks > 1 else "")
