"""The intensity of a map that is a random finite set: how many landmarks to expect where."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmap.view import style
from kalmap.view.map_figure import Limits, limits_around

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 800  # of the image: about the pixels of the finished picture
_REACH = 4.5  # standard deviations within which a component is evaluated
# In pixels; a narrower component is widened to it, or the grid would miss its peak and falsify its weight.
_NARROWEST = 0.6
_LEAST = 1e-30  # weight of a component that is drawn
# Open, so that the peak of a well-known landmark is seen inside.
_RINGS: dict[str, Any] = {
    "marker": "o",
    "facecolors": "none",
    "edgecolors": style.VERMILLION,
    "lw": 0.9,
    "zorder": 5,
}
_MANY = 120  # landmarks
_SHARE = 1e-4  # of the largest intensity: what is lower is left white


def intensity_figure(
    weights: np.ndarray,
    means: np.ndarray,
    covariances: np.ndarray,
    landmarks: np.ndarray | None = None,
    path: np.ndarray | None = None,
    kind: str = "true",
) -> Figure:
    """The sum of weighted Gaussians as an image with a colour bar, on a logarithmic scale.

    weights: (N,) expected landmarks of each component. means: (N, 2), m. covariances: (N, 2, 2), m^2.
    landmarks: (M, 2) those of a reference, as rings; kind: what it is called. path: (F, 2) the robot's, as a line.
    Components that are not finite, not positive semi-definite or of hardly any weight are left out.
    """
    good = _drawable(weights, means, covariances)
    weights, means, covariances = weights[good], means[good], covariances[good]
    known = [cloud for cloud in (means, landmarks, path) if cloud is not None]
    limits = limits_around(np.concatenate(known))
    left, right, bottom, top = limits
    with style.house_style():
        figure = style.new_figure(height=0.8 * style.WIDTH * (top - bottom) / (right - left) + 1.2)
        axes = figure.add_subplot()
        if len(weights):
            _draw_image(axes, intensity_image(weights, means, covariances, limits), limits)
        else:
            axes.text(0.5, 0.96, "no components", transform=axes.transAxes, ha="center", color=style.GREY)
        if path is not None and len(path):
            axes.plot(path[:, 0], path[:, 1], color=style.GREY, lw=0.9, label="path", zorder=4)
        if landmarks is not None and len(landmarks):
            x, y = landmarks.T
            axes.scatter(x, y, _ring(len(x)), label=f"landmarks, {kind}", **_RINGS)
        axes.set(xlim=limits[:2], ylim=limits[2:], aspect="equal", xlabel="x (m)", ylabel="y (m)")
        axes.set_title(
            f"Intensity of the map: {len(weights)} components, {weights.sum():.1f} landmarks expected"
        )
        handles, labels = axes.get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def intensity_image(
    weights: np.ndarray, means: np.ndarray, covariances: np.ndarray, limits: Limits, columns: int = _COLUMNS
) -> np.ndarray:
    """(rows, columns) landmarks per m^2 at the centres of square pixels within `limits`, from the bottom up.

    sum_i w_i N(x; m_i, P_i + s^2 I), each within some standard deviations of its mean; s is a fraction of a
    pixel, so that the sum over the image times a pixel's area is the number expected within it.
    """
    left, right, bottom, top = limits
    pixel = (right - left) / columns
    shape = (max(1, round((top - bottom) / pixel)), columns)
    image = np.zeros(shape)
    spread = covariances + (_NARROWEST * pixel) ** 2 * np.eye(2)
    reach = _REACH * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    corner = np.array([left, bottom]) + 0.5 * pixel
    size = np.array(shape[::-1])
    first = np.clip(np.ceil((means - reach - corner) / pixel), 0, size).astype(np.int64)
    last = np.clip(np.floor((means + reach - corner) / pixel) + 1, 0, size).astype(np.int64)
    inverse = np.linalg.inv(spread)
    height = weights / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
    for k in range(len(weights)):
        (x0, y0), (x1, y1) = first[k], last[k]
        dx = corner[0] + pixel * np.arange(x0, x1) - means[k, 0]
        dy = corner[1] + pixel * np.arange(y0, y1)[:, None] - means[k, 1]
        (xx, xy), (_, yy) = inverse[k]
        image[y0:y1, x0:x1] += height[k] * np.exp(-0.5 * (xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy))
    return image


def _ring(count: int) -> float:
    """Area of a ring, in square points: where there are many they are smaller."""
    return 52.0 if count <= _MANY else 22.0


def _drawable(weights: np.ndarray, means: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """(N,) bool: finite, of some weight, and with a covariance."""
    finite = np.isfinite(weights) & np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    sound = (xx >= 0.0) & (yy >= 0.0) & (xy * xy <= xx * yy * (1.0 + 1e-9))
    return finite & sound & (weights > _LEAST)


def _draw_image(axes: Axes, image: np.ndarray, limits: Limits) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    largest = float(image.max())
    colours = colormaps["YlGnBu"].with_extremes(under="white", bad="white")
    norm = LogNorm(_SHARE * largest, largest)
    shown = axes.imshow(
        image, cmap=colours, norm=norm, origin="lower", extent=limits, interpolation="nearest", zorder=1
    )
    axes.figure.colorbar(shown, ax=axes, label="landmarks per m²", extend="min", shrink=0.8, pad=0.02)
