"""Implicit curves: derivatives, frames, feet and noise. Oracles: central differences, closed forms of circle and line,
brute force along the curve; the compiled functions against the plain ones."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.geometry.curves import TERMS_OF_ORDER, Curve, monomials, substitution
from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.kernels import implicit

STEP = 1e-6


def some_curve(rng, order):
    coefficients = np.zeros(10)
    coefficients[: TERMS_OF_ORDER[order]] = rng.normal(size=TERMS_OF_ORDER[order])
    root = rng.normal(size=(10, 10)) * (np.arange(10) < TERMS_OF_ORDER[order])[:, None]
    return Curve(coefficients, rng.normal(size=2), float(rng.uniform(0.3, 3.0)), order, root @ root.T)


def circle(x, y, radius, scale=1.0):
    """p = (distance from the centre squared - radius squared) / (2 radius): it grows outwards."""
    coefficients = np.zeros(10)
    coefficients[0], coefficients[3], coefficients[5] = -(radius**2), scale**2, scale**2
    return Curve(coefficients / (2.0 * radius), np.array([x, y]), scale, 2)


def differences(f, points):
    """Central differences of f (N, ...) by x and y, in a last axis."""
    sides = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = STEP
        sides.append((f(points + step) - f(points - step)) / (2.0 * STEP))
    return np.stack(sides, axis=-1)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_are_those_of_central_differences(order):
    rng = np.random.default_rng(order)
    curve, points = some_curve(rng, order), rng.normal(size=(50, 2))
    np.testing.assert_allclose(curve.gradient(points), differences(curve.value, points), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        curve.hessian(points), differences(curve.gradient, points), rtol=1e-6, atol=1e-6
    )
    calm = points[np.linalg.norm(curve.gradient(points), axis=-1) > 0.2]
    distance, slope = curve.distance_and_gradient(calm)
    np.testing.assert_allclose(slope, differences(curve.distance, calm), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(distance, curve.value(calm) / np.linalg.norm(curve.gradient(calm), axis=-1))


def test_the_distance_to_a_line_is_exact_and_to_a_circle_of_first_order():
    """Closed forms: n . x - d; and (r^2 - R^2) / (2 r), which tends to r - R."""
    rng = np.random.default_rng(4)
    normal = np.array([0.6, -0.8])
    line = Curve(np.array([0.5, 0.6, -0.8, 0, 0, 0, 0, 0, 0, 0]) * 7.0, np.zeros(2))
    points = rng.normal(size=(20, 2)) * 5.0
    np.testing.assert_allclose(line.distance(points), points @ normal + 0.5, rtol=1e-12)
    np.testing.assert_allclose(line.distance_and_gradient(points)[1], np.tile(normal, (20, 1)), rtol=1e-12)
    ring = circle(1.0, 2.0, 3.0, scale=2.5)
    r = np.linalg.norm(points - [1.0, 2.0], axis=1)
    np.testing.assert_allclose(ring.distance(points), (r**2 - 9.0) / (2.0 * r), rtol=1e-12)
    np.testing.assert_allclose(ring.curvature(points), 1.0 / r, rtol=1e-9)


def test_where_the_gradient_vanishes_there_is_no_distance():
    ring = circle(1.0, 2.0, 3.0)
    assert np.isnan(ring.distance(np.array([1.0, 2.0])))
    assert np.isnan(implicit.signed_distance(ring.coefficients, 1.0, 2.0, 1.0, 1.0, 2.0)).all()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_curve_in_another_frame_has_the_same_values_and_noise(order):
    rng = np.random.default_rng(10 + order)
    curve, points = some_curve(rng, order), rng.normal(size=(30, 2)) * 3.0
    pose = np.array([4.0, -2.0, 2.3])
    there = np.asarray(pose[:2] + rotate(pose[2], points))
    for other in (curve.moved(pose), curve.moved(pose).recentred(np.array([3.0, 1.0]), 0.7)):
        np.testing.assert_allclose(other.value(there), curve.value(points), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(
            np.linalg.norm(other.gradient(there), axis=-1), np.linalg.norm(curve.gradient(points), axis=-1)
        )
        np.testing.assert_allclose(
            other.distance_covariance(there), curve.distance_covariance(points), rtol=1e-6, atol=1e-9
        )
    back = curve.moved(pose).moved(inverse(pose))
    np.testing.assert_allclose(back.coefficients, curve.coefficients, atol=1e-12)
    np.testing.assert_allclose(back.origin, curve.origin, atol=1e-12)
    twice = curve.moved(pose).moved(np.array([1.0, 1.0, -0.4]))
    once = curve.moved(compose(np.array([1.0, 1.0, -0.4]), pose))
    np.testing.assert_allclose(twice.coefficients, once.coefficients, atol=1e-12)


def test_substitution_multiplies_out():
    """Oracle: the terms taken at the changed points."""
    rng = np.random.default_rng(3)
    matrix, offset, points = rng.normal(size=(2, 2)), rng.normal(size=2), rng.normal(size=(40, 2))
    changed = monomials(points @ matrix.T + offset)
    np.testing.assert_allclose(monomials(points) @ substitution(matrix, offset), changed, atol=1e-10)


def test_the_foot_on_a_circle_lies_on_the_ray_from_its_centre():
    rng = np.random.default_rng(6)
    ring = circle(1.0, 2.0, 3.0, scale=3.0)
    angle, r = rng.uniform(-np.pi, np.pi, 100), rng.uniform(1.5, 5.0, 100)
    ray = np.column_stack([np.cos(angle), np.sin(angle)])
    expected = [1.0, 2.0] + 3.0 * ray
    points = [1.0, 2.0] + r[:, None] * ray
    np.testing.assert_allclose(ring.project(points), expected, atol=1e-9)
    compiled = [implicit.project(ring.coefficients, 1.0, 2.0, 3.0, *point) for point in points]
    np.testing.assert_allclose(compiled, expected, atol=1e-9)


def test_the_foot_on_a_cubic_is_the_nearest_point():
    """Oracle: brute force over the graph y = x^3 - x / 2."""
    cubic = Curve(np.array([0, 0.5, 1.0, 0, 0, 0, -1.0, 0, 0, 0]), np.zeros(2), 1.0, 3)
    x = np.linspace(-2.0, 2.0, 400_001)
    graph = np.column_stack([x, x**3 - 0.5 * x])
    rng = np.random.default_rng(8)
    points = graph[rng.integers(100_000, 300_000, 30)] + rng.normal(scale=0.03, size=(30, 2))
    for point, foot in zip(points, cubic.project(points)):
        nearest = graph[np.argmin(np.sum((graph - point) ** 2, axis=1))]
        np.testing.assert_allclose(foot, nearest, atol=2e-5)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_compiled_functions_are_those_of_the_plain_curve(order):
    rng = np.random.default_rng(20 + order)
    curve, points = some_curve(rng, order), rng.normal(size=(40, 2))
    c, (ox, oy), s = curve.coefficients, curve.origin, curve.scale
    distance, slope = curve.distance_and_gradient(points)
    compiled = implicit.distances(
        c[None], curve.origin[None], np.array([s]), np.zeros(40, dtype=np.int64), points
    )
    np.testing.assert_allclose(compiled, np.column_stack([distance, slope]), rtol=1e-9)
    rows = np.empty((40, 10))
    implicit.distance_rows(c, ox, oy, s, points, rows)
    np.testing.assert_allclose(rows, curve.noise_rows(points), rtol=1e-9)
    for point, hessian in zip(points, curve.hessian(points)):
        u, v = (point - curve.origin) / s
        uu, uv, vv = implicit.second_derivatives(c, u, v)
        np.testing.assert_allclose([[uu, uv], [uv, vv]], hessian * s**2, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(implicit.bend(c, u, v) / s, curve.curvature(point), rtol=1e-9)
