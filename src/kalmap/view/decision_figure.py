"""One frame of the audit trail: what was seen, where landmarks were expected, and who went where."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.geometry.ellipses import ellipse_points
from kalmap.geometry.se2 import rotate
from kalmap.records import Frame, Reason
from kalmap.view import style
from kalmap.view.decision_groups import Group, groups, points_of
from kalmap.view.labels import Labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CLOSE_UPS = 3
_REJECTED = 3  # candidates that a sighting did not get, to which lines are drawn
_FEW = 6  # landmarks of a close-up up to which wide gates are drawn too
_MARGIN = 0.68  # inches of a plot's width that its labels take
_ONE_SIGMA = float(-np.expm1(-0.5))  # the probability whose ellipse is the covariance's own
_FLATTEST, _TALLEST = 0.32, 0.62  # height over width of the plots
_FATES: dict[str, dict[str, Any]] = {
    "matched": {"marker": "o", "c": style.GREEN, "s": 30, "lw": 0},
    "matched, landmark on trial": {
        "marker": "o",
        "c": "white",
        "s": 28,
        "lw": 1.4,
        "edgecolors": style.GREEN,
    },
    "founds a landmark": {"marker": "*", "c": style.ORANGE, "s": 95, "lw": 0},
    "left unused": {"marker": "X", "c": style.VERMILLION, "s": 52, "lw": 0},
}
_GIVEN: dict[str, Any] = {"color": style.GREEN, "lw": 1.8, "zorder": 4, "label": "given to"}
_NOT_TAKEN: dict[str, Any] = {
    "color": style.GREY,
    "lw": 0.6,
    "zorder": 3,
    "label": "candidate that was not taken",
}
Limits = tuple[float, float, float, float]


def decision_figure(frame: Frame) -> Figure:
    """The whole frame around the sensor, and below it close-ups of the sightings decided in most doubt.

    A gate's ellipse is where a sighting has d^2 = gate, to first order: the expected position's covariance and the
    sensor's noise. Without noises in the frame it is the former alone, and the legend says so.
    """
    points, close, gates = points_of(frame), groups(frame)[:_CLOSE_UPS], gate_covariances(frame)
    cloud = np.vstack([points, frame.positions, frame.sensor[None, :2]])
    limits = [_limits(cloud, _FLATTEST, _TALLEST, 2.0 if len(points) else 10.0)]
    limits += [_around(frame, points, gates, group, len(close)) for group in close]
    with style.house_style():
        widths = [style.WIDTH - _MARGIN] + [style.WIDTH / len(close) - _MARGIN for _ in close[:1]]
        heights = [width * _shape(some) for width, some in zip(widths, limits)]
        figure = style.new_figure(height=sum(heights) + 0.72 * len(heights) + (0.9 if close else 0.45))
        grid = figure.add_gridspec(len(heights), max(1, len(close)), height_ratios=heights)
        plots = [figure.add_subplot(grid[0, :])] + [figure.add_subplot(grid[1, k]) for k in range(len(close))]
        for axes, some, group in zip(plots, limits, [None, *close]):
            _draw_decisions(axes, frame, points, gates, some, group)
        _draw_view(plots[0], frame, points, limits[0])
        plots[0].set_title(_title(frame))
        for letter, inside, some in zip("ABC", plots[1:], limits[1:]):
            _mark_close_up(plots[0], inside, limits[0], some, letter)
        _legend(figure)
        figure.draw_without_rendering()  # only now is it known where there is room for words
        for axes, group in zip(plots, [None, *close]):
            _write(Labels(axes), frame, points, group)
    return figure


def gate_covariances(frame: Frame) -> np.ndarray:
    """(L, 2, 2) m^2: covariance, in the map's axes, of where a sighting of each expected landmark should lie.

    The spread of the expected position; and, where the frame has noises, that of the sighting nearest to the landmark,
    turned from range and bearing into the map at the expected position.
    """
    if frame.noises is None or not len(frame.values):
        return frame.spreads
    covariances = frame.spreads.copy()
    apart = frame.positions - frame.sensor[:2]
    for k, landmark in enumerate(frame.landmarks.tolist()):
        rows = np.flatnonzero(frame.why.pairs[:, 1] == landmark)
        nearest = frame.why.pairs[rows[np.argmin(frame.why.squared[rows])], 0] if len(rows) else 0
        distance = max(float(np.hypot(*apart[k])), 1e-9)
        along = apart[k] / distance
        turn = np.column_stack([along, distance * np.array([-along[1], along[0]])])
        covariances[k] += turn @ frame.noises[nearest] @ turn.T
    return covariances


def _title(frame: Frame) -> str:
    labels, reasons = frame.labels, frame.why.reasons
    founded, unused = int((reasons == Reason.FOUNDED).sum()), int((labels < 0).sum())
    matched = len(labels) - founded - unused
    counts = f"{matched} matched, {founded} founded, {unused} unused" if len(labels) else "nothing was seen"
    lines = [f"Frame {frame.number}, t = {frame.time:.6g} s: {counts}"]
    notes = "; ".join(frame.why.notes)
    return "\n".join(lines + [notes if len(notes) < 100 else f"{notes[:97]}..."] * bool(notes))


def _limits(points: np.ndarray, flattest: float, tallest: float, least: float) -> Limits:
    """Left, right, bottom, top around the finite points, of a shape within bounds, at least so many metres."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
    middle, half = (low + high) / 2, (high - low) / 2
    half = half + max(0.09 * float(half.max()), least / 2)
    half = np.maximum(half, (half[1] / tallest, half[0] * flattest))
    (left, bottom), (right, top) = (middle - half).tolist(), (middle + half).tolist()
    return left, right, bottom, top


def _around(frame: Frame, points: np.ndarray, gates: np.ndarray, group: Group, beside: int) -> Limits:
    """A close-up that holds the group's sightings and the gates of its landmarks; square if there are several."""
    rows = np.flatnonzero(np.isin(frame.landmarks, group.landmarks))
    clouds = [points[list(group.sightings)], frame.positions[rows]]
    if np.isfinite(frame.why.gate):
        clouds += list(_ellipses(frame.positions[rows], gates[rows], frame.why.gate))
    flattest, tallest = {1: (_FLATTEST, 0.72), 2: (0.75, 0.75)}.get(beside, (1.0, 1.0))
    return _limits(np.vstack(clouds), flattest, tallest, 0.1)


def _shape(limits: Limits) -> float:
    """Height over width."""
    return (limits[3] - limits[2]) / (limits[1] - limits[0])


def _ellipses(centres: np.ndarray, covariances: np.ndarray, gate: float) -> np.ndarray:
    """(K, count, 2) points at the squared Mahalanobis distance `gate`, of the landmarks that have such an ellipse."""
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    sound = np.isfinite(centres).all(axis=1) & (xx >= 0.0) & (yy >= 0.0) & (xy * xy <= xx * yy * (1.0 + 1e-9))
    centres, covariances = centres[sound], covariances[sound]
    return ellipse_points(centres, max(gate, 0.0) * covariances, _ONE_SIGMA, 72)


def _draw_view(axes: Axes, frame: Frame, points: np.ndarray, limits: Limits) -> None:
    """The robot, and the sector in which something was seen, with the rays to it."""
    x, y, _ = frame.sensor
    if len(points):
        first, width = _sector(frame.values[:, 1])
        turn = frame.sensor[2] + first + np.linspace(0.0, width, 60)
        radius = 1.04 * float(frame.values[:, 0].max())
        arc = np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn)])
        outline = np.vstack([[(x, y)], arc])
        axes.fill(*outline.T, fc=style.SKY + "18", ec="none", label="field of what was seen", zorder=1)
        for point in points:
            axes.plot((x, point[0]), (y, point[1]), color="#c8ccd4", lw=0.5, zorder=1.5)
    else:
        axes.text(
            0.5, 0.93, "no sighting in this frame", transform=axes.transAxes, ha="center", color=style.GREY
        )
    shape = 0.013 * (limits[1] - limits[0]) * np.array([[1.2, 0.0], [-0.8, 0.7], [-0.4, 0.0], [-0.8, -0.7]])
    corners = rotate(np.full(4, frame.pose[2]), shape) + frame.pose[:2]
    axes.fill(*corners.T, fc=style.PURPLE, ec="white", lw=0.8, label="robot, as predicted", zorder=7)


def _sector(bearings: np.ndarray) -> tuple[float, float]:
    """Begin and width, rad, of the smallest sector that holds all bearings, a little widened."""
    ordered = np.sort(np.mod(bearings, 2.0 * np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    widest = int(np.argmax(gaps))
    width = min(2.0 * np.pi, 2.0 * np.pi - float(gaps[widest]) + 0.1)
    return float(ordered[(widest + 1) % len(ordered)]) - 0.05, width


def _draw_decisions(
    axes: Axes, frame: Frame, points: np.ndarray, gates: np.ndarray, limits: Limits, group: Group | None
) -> None:
    """Gates, lines, landmarks and sightings; the wide gates only in a close-up of few landmarks."""
    axes.set_xlim(limits[:2])
    axes.set_ylim(limits[2:])
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    _draw_gates(axes, frame, gates, wide=group is not None and len(group.landmarks) <= _FEW)
    for m, landmark, _, given in _drawn_pairs(frame):
        ends = np.array([points[m], frame.positions[frame.landmarks == landmark][0]])
        look = _GIVEN if given else _NOT_TAKEN
        axes.plot(*ends.T, **look)
    if len(frame.landmarks):
        look = {"s": 34, "facecolors": "white", "edgecolors": style.BLUE, "lw": 1.3, "zorder": 5}
        axes.scatter(*frame.positions.T, label="landmark, where it was expected", **look)
    fates = np.array([_fate(frame, m) for m in range(len(points))])
    for fate, look in _FATES.items():
        if (fates == fate).any():
            axes.scatter(*points[fates == fate].T, label=f"sighting, {fate}", zorder=6, **look)


def _drawn_pairs(frame: Frame) -> list[tuple[int, int, float, bool]]:
    """(sighting, landmark, d^2, whether it was given to it) of the pairs that get a line.

    The pair taken, and within the wide gate the nearest few that were not.
    """
    why, labels, places = frame.why, frame.labels.tolist(), set(frame.landmarks.tolist())
    widest, left = max(why.gate, why.new_gate), dict.fromkeys(range(len(labels)), _REJECTED)
    found = []
    for squared, (m, landmark) in sorted(zip(why.squared.tolist(), why.pairs.tolist())):
        given = landmark == labels[m]
        if landmark in places and (given or (squared < widest and left[m])):
            found.append((m, landmark, squared, given))
            left[m] -= not given
    return found


def _write(labels: Labels, frame: Frame, points: np.ndarray, group: Group | None) -> None:
    """Numbers of landmarks; in a close-up also of sightings, and the distances at the lines."""
    labels.keep_clear(points)
    labels.keep_clear(frame.positions)
    for place, landmark in zip(frame.positions, frame.landmarks.tolist()):
        labels.put(place, str(landmark), color=style.BLUE, size=8.0 if group is None else 9.0, weight="bold")
    if group is None:
        return
    for m in group.sightings:
        labels.put(points[m], f"s{m}", color=style.BLACK, size=7.5, style="italic")
    taken_first = sorted(_drawn_pairs(frame), key=lambda pair: not pair[-1])
    for m, landmark, squared, given in taken_first:
        if landmark in group.landmarks:
            middle = (points[m] + frame.positions[frame.landmarks == landmark][0]) / 2
            look: dict[str, Any] = {"color": style.GREEN if given else style.GREY, "size": 7.0}
            text = f"{squared:.2f}" if squared < 100.0 else f"{squared:.3g}"
            # A short line has no room in its middle: then its distance may stand further off.
            any(
                labels.put(middle, text, apart, **look)
                for apart in ((1.5, 8.0, 15.0) if given else (1.5, 8.0))
            )


def _draw_gates(axes: Axes, frame: Frame, gates: np.ndarray, wide: bool) -> None:
    from matplotlib.collections import PolyCollection

    if not len(frame.landmarks):
        return
    what = "" if frame.noises is not None else ", sensor noise left out"
    if np.isfinite(frame.why.gate):
        ellipses = PolyCollection(
            list(_ellipses(frame.positions, gates, frame.why.gate)),
            facecolors=style.BLUE + "12",
            edgecolors=style.BLUE,
            linewidths=0.8,
            label=f"gate, d² < {frame.why.gate:.3g}{what}",
            zorder=2,
        )
        axes.add_collection(ellipses, autolim=False)
    if wide and np.isfinite(frame.why.new_gate) and frame.why.new_gate > frame.why.gate:
        outer = PolyCollection(
            list(_ellipses(frame.positions, gates, frame.why.new_gate)),
            facecolors="none",
            edgecolors=style.BLUE + "88",
            linewidths=0.7,
            linestyles=(0, (2, 3)),
            label=f"wide gate, d² < {frame.why.new_gate:.3g}{what}",
            zorder=2,
        )
        axes.add_collection(outer, autolim=False)


def _fate(frame: Frame, m: int) -> str:
    """A key of `_FATES`."""
    if frame.labels[m] < 0:
        return "left unused"
    if frame.why.reasons[m] == Reason.FOUNDED:
        return "founds a landmark"
    return "matched, landmark on trial" if frame.trial[m] else "matched"


def _mark_close_up(axes: Axes, inside: Axes, whole: Limits, limits: Limits, letter: str) -> None:
    """Frame the close-up in the whole view, and name both."""
    from matplotlib.patches import Rectangle

    left, right, bottom, top = limits
    axes.add_patch(
        Rectangle((left, bottom), right - left, top - bottom, fc="none", ec=style.BLACK, lw=0.8, zorder=8)
    )
    where: dict[str, Any]
    room = 0.05 * (whole[3] - whole[2])
    if top + room < whole[3]:
        corner, where = (left, top), {"va": "bottom"}
    elif bottom - room > whole[2]:
        corner, where = (left, bottom), {"va": "top"}
    else:
        corner, where = (max(left, whole[0]), min(top, whole[3])), {"va": "top"}
    shift = (2, 2 if where["va"] == "bottom" else -3)
    axes.annotate(letter, corner, shift, textcoords="offset points", weight="bold", zorder=8, **where)
    inside.set_title(f"{letter}, d² beside the lines")


def _legend(figure: Figure) -> None:
    """One entry for each thing that is drawn anywhere: places first, then sightings, then lines."""
    found: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels()):
            found.setdefault(label, handle)
    order = ("robot", "field", "landmark", "gate", "wide", "sighting", "given", "candidate")
    labels = sorted(found, key=lambda label: order.index(label.replace(",", " ").split()[0]))
    figure.legend([found[label] for label in labels], labels, loc="outside lower center", ncols=3)
