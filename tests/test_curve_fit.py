"""Fits of lines, conics and cubics. Oracles: Monte Carlo for every covariance, closed forms of least squares, numpy."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.geometry.curve_fit import fit_curve
from kalmap.geometry.curves import Curve
from kalmap.kernels.contour_curves import invert
from kalmap.kernels.contour_fit import fit_bent_line, fit_line

TRIALS = 1500


def rays_of(bearings):
    return np.column_stack([np.cos(bearings), np.sin(bearings)])


def spread(ranges, bearings, sigma, order, rng, trials=TRIALS):
    """Empirical and predicted covariance of the distances at the true points, over fits of that order alone."""
    rays = rays_of(bearings)
    truth = ranges[:, None] * rays
    chosen = np.linspace(0, len(rays) - 1, 9).astype(int)
    distances, predicted = [], []
    for _ in range(trials):
        points = (ranges + sigma * rng.standard_normal(len(ranges)))[:, None] * rays
        fit = fit_curve(points, np.full(len(points), sigma**2), rays=rays)
        if fit.curve.order == order:
            side = np.sign(fit.curve.gradient(truth[len(truth) // 2]) @ rays[len(truth) // 2])
            distances.append(side * fit.curve.distance(truth[chosen]))
            predicted.append(fit.curve.distance_covariance(truth[chosen]))
    assert len(distances) > 0.9 * trials
    distances = np.array(distances)
    return np.cov(distances.T), np.mean(predicted, axis=0), distances.mean(axis=0)


def ranges_to(outline, bearings, guess, steps=400):
    """Ranges to the curve x = outline(y), by fixed-point iteration with half steps."""
    ranges = np.full(len(bearings), guess)
    for _ in range(steps):
        ranges = 0.5 * ranges + 0.5 * outline(ranges * np.sin(bearings)) / np.cos(bearings)
    assert np.allclose(ranges * np.cos(bearings), outline(ranges * np.sin(bearings)), atol=1e-9)
    return ranges


def bend(y):
    return 3.0 + 0.25 * np.sin(3.0 * y)


def ring_ranges(distance, radius, bearings):
    across = distance * np.sin(bearings)
    return distance * np.cos(bearings) - np.sqrt(radius**2 - across**2)


@pytest.mark.parametrize("limits", [(-60, 40), (20, 80)])
def test_the_noise_of_a_lines_distances_is_what_it_says(limits):
    """Monte Carlo, 1,500 walls 2 m ahead, seen from straight on to 10 degrees along; variances agree to what 1,500
    draws leave open (5 standard deviations of a variance: 18 %), and so do the correlations."""
    bearings = np.deg2rad(np.arange(*limits, 1.0))
    found, said, mean = spread(2.0 / np.cos(bearings), bearings, 0.015, 1, np.random.default_rng(1))
    np.testing.assert_allclose(np.diag(found) / np.diag(said), 1.0, atol=5.0 * np.sqrt(2.0 / TRIALS))
    root = np.sqrt(np.diag(said))
    np.testing.assert_allclose(found / np.outer(root, root), said / np.outer(root, root), atol=0.2)
    assert (np.abs(mean) < 0.15 * root).all()


def test_the_noise_of_a_conics_distances_is_what_it_says():
    """Monte Carlo over a column of 1 m thickness 2 m away, seen by 27 beams a degree apart."""
    bearings = np.deg2rad(np.arange(-13.0, 13.1, 1.0))
    found, said, mean = spread(ring_ranges(2.0, 0.5, bearings), bearings, 0.01, 2, np.random.default_rng(2))
    np.testing.assert_allclose(np.diag(found) / np.diag(said), 1.0, atol=0.2)
    assert (np.abs(mean) < 0.35 * np.sqrt(np.diag(said))).all()


def test_the_noise_of_a_round_rooms_distances_is_what_it_says():
    """Monte Carlo over most of a circle of 3 m radius, seen from inside, 1 m off its centre."""
    bearings = np.deg2rad(np.arange(-80.0, 80.1, 2.0))
    ranges = np.cos(bearings) + np.sqrt(9.0 - np.sin(bearings) ** 2)
    found, said, _mean = spread(ranges, bearings, 0.015, 2, np.random.default_rng(3))
    np.testing.assert_allclose(np.diag(found) / np.diag(said), 1.0, atol=0.2)


def test_the_noise_of_a_cubics_distances_is_what_it_says():
    """Monte Carlo over an S that no conic follows, 65 beams half a degree apart."""
    bearings = np.deg2rad(np.arange(-16.0, 16.1, 0.5))
    found, said, _mean = spread(ranges_to(bend, bearings, 3.0), bearings, 0.01, 3, np.random.default_rng(4))
    np.testing.assert_allclose(np.diag(found) / np.diag(said), 1.0, atol=0.2)


def test_a_line_with_even_noise_is_the_principal_axis():
    """Oracle: singular value decomposition, and the textbook's variances of offset and slope."""
    rng = np.random.default_rng(5)
    points = np.column_stack([np.linspace(-1.0, 2.0, 30), np.zeros(30)]) + 0.01 * rng.standard_normal((30, 2))
    points = points @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + [4.0, 1.0]
    fit = fit_curve(points, np.full(30, 1e-4))
    centre = points.mean(axis=0)
    _u, values, axes = np.linalg.svd(points - centre)
    np.testing.assert_allclose(np.abs(fit.residuals), np.abs((points - centre) @ axes[1]), atol=1e-12)
    assert fit.curve.order == 1 and fit.explained
    assert fit.chi2 == pytest.approx(values[1] ** 2 / 1e-4)
    along = (points - centre) @ axes[0]
    expected = 1e-4 * (1.0 / 30 + np.outer(along, along) / np.sum(along**2))
    np.testing.assert_allclose(
        fit.curve.distance_covariance(points - fit.residuals[:, None] * 0), expected, rtol=1e-3
    )


def test_the_order_is_the_lowest_that_explains_the_points():
    """200 noisy draws each: straight walls come out as lines, arcs as conics, the S as a cubic."""
    rng = np.random.default_rng(6)
    wall = np.deg2rad(np.arange(-40.0, 40.1, 1.0))
    column = np.deg2rad(np.arange(-13.0, 13.1, 1.0))
    wave = np.deg2rad(np.arange(-16.0, 16.1, 0.5))
    cases = [
        (wall, 2.0 / np.cos(wall), 1),
        (column, ring_ranges(2.0, 0.5, column), 2),
        (wave, ranges_to(bend, wave, 3.0), 3),
    ]
    for bearings, ranges, order in cases:
        rays = rays_of(bearings)
        orders = []
        for _ in range(200):
            points = (ranges + 0.01 * rng.standard_normal(len(ranges)))[:, None] * rays
            orders.append(fit_curve(points, np.full(len(points), 1e-4), rays=rays).curve.order)
        assert np.mean(np.array(orders) == order) > 0.97


def test_a_corner_is_no_conic():
    """A hyperbola hugs two walls that meet; it is refused, and the answer says that nothing explains the points."""
    rng = np.random.default_rng(7)
    side = np.linspace(0.05, 1.0, 20)
    points = np.vstack([np.column_stack([side[::-1], np.zeros(20)]), np.column_stack([np.zeros(20), side])])
    fit = fit_curve(points + 0.01 * rng.standard_normal((40, 2)), np.full(40, 1e-4))
    assert not fit.explained


def test_a_curve_does_not_turn_away_beyond_its_ends():
    """A tenth of its length beyond an arc of 150 degrees the conic is still where the circle goes on, and its gradient
    what it was."""
    rng = np.random.default_rng(8)
    for _ in range(100):
        angle = np.linspace(0.0, np.radians(150.0), 40)
        points = rays_of(angle) + 0.01 * rng.standard_normal((40, 2))
        curve = fit_curve(points, np.full(40, 1e-4)).curve
        beyond = rays_of(np.radians([-10.0, 160.0]))
        steep = np.linalg.norm(curve.gradient(beyond), axis=1) * curve.scale
        assert (np.abs(curve.distance(beyond)) < 0.05).all()
        assert ((steep > 0.4) & (steep < 2.5)).all()


def test_roughness_is_found_and_makes_the_fit_less_sure():
    """A wall rough by 3 cm under a sensor of 1 cm; the excess of 100 points has a standard error of 8 %."""
    rng = np.random.default_rng(9)
    points = np.column_stack([np.linspace(0.0, 5.0, 100), 0.03 * rng.standard_normal(100)])
    fit = fit_curve(points, np.full(100, 1e-4), max_order=1)
    smooth = fit_curve(points * [1.0, 0.3], np.full(100, 1e-4), max_order=1)
    assert fit.roughness == pytest.approx(np.sqrt(0.03**2 - 0.01**2), rel=0.25)
    assert not fit.explained and smooth.roughness == 0.0
    middle = np.array([[2.5, 0.0]])
    assert fit.curve.distance_covariance(middle) > 5.0 * smooth.curve.distance_covariance(middle)


def test_one_gross_error_bends_a_line_little():
    points = np.column_stack([np.linspace(0.0, 3.0, 30), np.zeros(30)])
    points[29, 1] = 0.3
    fit = fit_curve(points, np.full(30, 1e-4), max_order=1)
    plain = np.polyfit(points[:, 0], points[:, 1], 1)
    assert np.abs(fit.residuals[:29]).max() < 0.5 * np.abs(np.polyval(plain, points[:29, 0])).max()


def test_the_compiled_inverse_is_numpys():
    rng = np.random.default_rng(10)
    for size in (6, 10):
        root = rng.normal(size=(size, size))
        matrix, inverse = root @ root.T + 0.1 * np.eye(size), np.empty((size, size))
        assert invert(matrix.copy(), size, inverse)
        np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-8, atol=1e-9)
    assert not invert(-np.eye(6), 6, np.empty((6, 6)))


def test_bad_points_are_refused():
    good = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.1]])
    with pytest.raises(ValueError, match="different"):
        fit_curve(good[[0, 0]], np.ones(2))
    with pytest.raises(ValueError, match="finite"):
        fit_curve(good * np.nan, np.ones(3))
    with pytest.raises(ValueError, match="positive"):
        fit_curve(good, np.zeros(3))
    with pytest.raises(ValueError, match="needed"):
        fit_curve(good, np.ones(2))


def bent_fit(points, rays, variances, sigma_bend):
    coef, cov, origin = np.empty(10), np.empty((10, 10)), np.empty(2)
    scale, squares, _rough = fit_bent_line(
        points, rays, variances, np.zeros(len(points)), sigma_bend, 0.0, coef, cov, origin
    )
    return Curve(coef, origin, scale, 3, cov), squares


@pytest.mark.parametrize("turn", [0.0, 1.1])
def test_a_bent_line_is_the_posterior_of_its_prior(turn):
    """Oracle: numpy's least squares of a cubic, the prior as two more rows, in the axes of the straight fit."""
    rng = np.random.default_rng(4)
    x = np.linspace(-1.0, 1.4, 40)
    points = np.column_stack([x, 3.0 + 0.04 * x**2 - 0.02 * x**3 + 0.01 * rng.standard_normal(40)])
    c, s = np.cos(turn), np.sin(turn)
    points = points @ np.array([[c, s], [-s, c]])
    rays = np.tile([-s, c], (40, 1))
    variances = rng.uniform(0.8, 1.2, 40) * 1e-4
    curve, squares = bent_fit(points, rays, variances, 0.1)
    coef, cov, origin = np.empty(10), np.empty((10, 10)), np.empty(2)
    fit_line(points, rays, variances, np.zeros(40), coef, cov, origin)
    nx, ny = coef[1], coef[2]
    away, along = (points - origin) @ [nx, ny], (points - origin) @ [ny, -nx]
    sigma = np.sqrt(variances) * abs(rays[0] @ [nx, ny])
    rows = np.vander(along, 4, increasing=True) / sigma[:, None]
    rows = np.vstack([rows, [0, 0, 2 / 0.1, 0], [0, 0, 0, 6 / 0.1]])
    shape = np.linalg.lstsq(rows, np.r_[away / sigma, 0.0, 0.0], rcond=None)[0]
    at = np.linspace(-1.0, 1.0, 7)
    powers = np.vander(at, 4, increasing=True)
    feet = origin + np.outer(at, [ny, -nx]) + np.outer(powers @ shape, [nx, ny])
    np.testing.assert_allclose(curve.distance(feet), 0.0, atol=1e-9)
    expected = powers @ np.linalg.inv(rows.T @ rows) @ powers.T
    steep = np.linalg.norm(curve.gradient(feet), axis=1) * curve.scale
    np.testing.assert_allclose(
        curve.distance_covariance(feet), expected / np.outer(steep, steep), rtol=1e-6, atol=1e-12
    )
    left = away - np.vander(along, 4, increasing=True) @ shape
    assert squares == pytest.approx(np.sum(left**2 / variances), rel=1e-6)
