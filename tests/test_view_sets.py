"""Pictures of maps as sets: their number and OSPA over time, and their intensity."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from kalmap.view import SetCurve, intensity_figure, set_error_figure
from kalmap.view.intensity_figure import intensity_image
from kalmap.view.style import png_bytes

PNG = b"\x89PNG\r\n\x1a\n"
TIMES = np.arange(6.0)
LIMITS = (-10.0, 30.0, 0.0, 20.0)


@pytest.fixture(autouse=True)
def no_warnings():
    """Any warning of numpy or matplotlib is a fault."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def curve(method, number):
    localisation, cardinality = np.linspace(2.0, 1.0, 6), np.linspace(0.0, 1.5, 6)
    return SetCurve(method, number + TIMES, np.hypot(localisation, cardinality), localisation, cardinality)


def components(count, seed=0):
    rng = np.random.default_rng(seed)
    roots = rng.normal(0.0, 1.0, (count, 2, 2))
    covariances = 0.2 * roots @ roots.transpose(0, 2, 1) + 0.05 * np.eye(2)
    return rng.uniform(0.1, 1.0, count), rng.uniform(5.0, 15.0, (count, 2)), covariances


def labels(axes):
    return axes.get_legend_handles_labels()[1]


def texts(figure):
    return " ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def test_number_above_ospa_above_its_parts():
    """Oracle: the curves that were handed in."""
    curves = [curve("a", 3.0), curve("b", 5.0)]
    figure = set_error_figure(TIMES, curves, 4.0 + TIMES)
    number, whole, localisation, cardinality = figure.axes
    assert labels(number) == ["truth, seen so far", "a", "b"]
    np.testing.assert_array_equal(number.lines[0].get_ydata(), 4.0 + TIMES)
    for axes, name in (
        (whole, "ospa"),
        (localisation, "localisation"),
        (cardinality, "cardinality"),
    ):
        for line, drawn in zip(axes.lines, curves, strict=True):
            np.testing.assert_array_equal(line.get_xdata(), TIMES)
            np.testing.assert_array_equal(line.get_ydata(), getattr(drawn, name))
    assert [line.get_ydata()[0] for line in number.lines[1:]] == [3.0, 5.0]
    assert localisation.get_ylim() == cardinality.get_ylim() and whole.get_ylim()[0] == 0.0
    assert number.get_position().y0 > whole.get_position().y0 > cardinality.get_position().y0
    assert whole.lines[0].get_color() == localisation.lines[0].get_color() != whole.lines[1].get_color()
    assert png_bytes(figure).startswith(PNG)


def test_no_curves_and_a_single_instant():
    assert "No curves" in texts(set_error_figure(TIMES, [], TIMES))
    none = np.zeros(0)
    assert "No curves" in texts(set_error_figure(none, [SetCurve("a", none, none, none, none)], none))
    one = np.ones(1)
    assert png_bytes(set_error_figure(one, [SetCurve("a", one, one, one, one)], one)).startswith(PNG)
    gap = np.array([1.0, np.nan, 2.0])
    assert png_bytes(set_error_figure(TIMES[:3], [SetCurve("a", gap, gap, gap, gap)], gap)).startswith(PNG)


def test_the_image_is_the_density():
    """Oracle: scipy's Gaussian, of the widened covariance, at every pixel's centre."""
    weights, means, covariances = components(20)
    image = intensity_image(weights, means, covariances, LIMITS, columns=200)
    assert image.shape == (100, 200)
    x, y = np.meshgrid(-9.9 + 0.2 * np.arange(200), 0.1 + 0.2 * np.arange(100))
    exact = sum(
        weight * multivariate_normal(mean, covariance + 0.12**2 * np.eye(2)).pdf(np.dstack([x, y]))
        for weight, mean, covariance in zip(weights, means, covariances, strict=True)
    )
    np.testing.assert_allclose(image, exact, rtol=0.0, atol=1e-4 * exact.max())


@pytest.mark.parametrize("size", [1.0, 0.01, 0.0])
def test_the_image_holds_the_expected_number_however_narrow_the_components(size):
    """Oracle: the sum of the weights."""
    weights, means, covariances = components(50, seed=1)
    image = intensity_image(weights, means, size**2 * covariances, LIMITS, columns=100)
    assert image.sum() * 0.4**2 == pytest.approx(weights.sum(), rel=0.01)


def test_components_out_of_the_picture_leave_it_empty():
    """Oracle: by hand; one in the corner gives a quarter of itself."""
    where = np.array([[-100.0, 5.0], [0.0, 100.0], [50.0, 50.0], [30.0, 20.0]])
    image = intensity_image(np.ones(4), where, np.tile(np.eye(2), (4, 1, 1)), LIMITS, columns=400)
    assert image.sum() * 0.1**2 == pytest.approx(0.25, abs=0.001)
    assert image[:100].max() == 0.0 and image[-1, -1] == image.max()


def test_the_picture_has_image_bar_rings_and_path():
    weights, means, covariances = components(30)
    landmarks, path = means[:20], np.column_stack([TIMES, TIMES])
    figure = intensity_figure(weights, means, covariances, landmarks, path)
    axes, bar = figure.axes
    assert labels(axes) == ["path", "landmarks, true"]
    assert bar.get_ylabel() == "landmarks per m²"
    (image,) = axes.images
    np.testing.assert_array_equal(axes.collections[0].get_offsets(), landmarks)
    assert image.get_array().max() == pytest.approx(image.norm.vmax)
    left, right, bottom, top = image.get_extent()
    assert left < min(means[:, 0].min(), 0.0) and top > means[:, 1].max()
    assert axes.get_xlim() == (left, right) and axes.get_ylim() == (bottom, top)
    assert axes.get_aspect() == 1.0
    assert f"30 components, {weights.sum():.1f} landmarks" in axes.get_title(loc="left")
    assert png_bytes(figure).startswith(PNG)
    alone = intensity_figure(weights, means, covariances)
    assert labels(alone.axes[0]) == [] and not alone.legends and png_bytes(alone).startswith(PNG)


def test_the_picture_puts_a_landmark_where_it_is():
    """Oracle: the largest pixel is at the only component's mean."""
    figure = intensity_figure(np.ones(1), np.array([[3.0, 1.0]]), 0.01 * np.eye(2)[None], np.zeros((1, 2)))
    image = figure.axes[0].images[0]
    values, (left, right, bottom, _) = np.asarray(image.get_array()), image.get_extent()
    row, column = np.unravel_index(values.argmax(), values.shape)
    pixel = (right - left) / values.shape[1]
    assert image.origin == "lower"
    assert left + (column + 0.5) * pixel == pytest.approx(3.0, abs=pixel)
    assert bottom + (row + 0.5) * pixel == pytest.approx(1.0, abs=pixel)


def test_components_that_cannot_be_drawn_are_left_out():
    weights, means, covariances = components(6)
    weights[0], means[1, 0], weights[2] = 0.0, np.inf, np.nan
    covariances[3] = [[1.0, 2.0], [2.0, 1.0]]
    figure = intensity_figure(weights, means, covariances)
    assert "2 components" in figure.axes[0].get_title(loc="left")
    assert png_bytes(figure).startswith(PNG)
    for landmarks in (means[2:], None, np.zeros((0, 2))):
        nothing = intensity_figure(weights[:0], means[:0], covariances[:0], landmarks)
        assert "no components" in texts(nothing) and len(nothing.axes) == 1
        assert png_bytes(nothing).startswith(PNG)
