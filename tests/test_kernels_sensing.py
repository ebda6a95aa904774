"""Sensing kernels: against the numpy sensor, its Jacobians against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kalmap.geometry.angles import wrap as numpy_wrap
from kalmap.geometry.se2 import exp_position
from kalmap.kernels import layout, regression, sensing
from slam_problems import MOUNTED, random_covariance

position = st.floats(-50, 50)
angle = st.floats(-4, 4)


def setup_of(rule: int = layout.JACOBIAN) -> np.ndarray:
    setup = np.zeros(layout.SETUP_LENGTH)
    MOUNTED.fill(setup)
    setup[layout.RULE], setup[layout.RULE_A] = rule, 3**0.5
    return setup


def differences(f, x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    columns = []
    for d in step * np.eye(len(x)):
        change = f(x + d) - f(x - d)
        change[1] = change[1] if abs(change[1]) < 3 else change[1] - np.sign(change[1]) * 2 * np.pi
        columns.append(change / (2 * step))
    return np.array(columns).T


@given(x=position, y=position, heading=angle, lx=position, ly=position)
@settings(max_examples=150, deadline=None, derandomize=True)
def test_sighting_and_its_jacobian(x, y, heading, lx, ly):
    """Oracle: the numpy sensor model, and central differences of it."""
    pose, landmark = np.array([x, y, heading]), np.array([lx, ly])
    expected = MOUNTED.predict(pose, landmark)
    assume(expected[0] > 0.5)
    predicted, matrix, residual = np.empty(2), np.empty((2, 5)), np.empty((2, 2))
    status = sensing.regress_sighting(setup_of(), pose, lx, ly, np.eye(5), predicted, matrix, residual)
    assert status == layout.OK
    np.testing.assert_allclose(predicted[0], expected[0], rtol=1e-13)
    assert abs(numpy_wrap(predicted[1] - expected[1])) < 1e-12
    numeric = differences(lambda v: MOUNTED.predict(v[:3], v[3:]), np.array([x, y, heading, lx, ly]))
    np.testing.assert_allclose(matrix, numeric, atol=2e-6)
    np.testing.assert_array_equal(residual, 0.0)


@given(x=position, y=position, heading=angle, distance=st.floats(0, 80), bearing=angle)
@settings(max_examples=150, deadline=None, derandomize=True)
def test_first_sighting_and_its_jacobian(x, y, heading, distance, bearing):
    """Oracle: the numpy sensor's inverse, and central differences of it."""
    pose, z = np.array([x, y, heading]), np.array([distance, bearing])
    landmark, matrix, residual = np.empty(2), np.empty((2, 5)), np.empty((2, 2))
    status = sensing.regress_landmark(setup_of(), pose, z, np.eye(3), np.eye(2), landmark, matrix, residual)
    assert status == layout.OK
    np.testing.assert_allclose(landmark, MOUNTED.locate(pose, z), atol=1e-11)
    point = np.array([x, y, heading, distance, bearing])
    numeric = np.array([MOUNTED.locate((point + d)[:3], (point + d)[3:]) for d in 1e-5 * np.eye(5)])
    numeric = (numeric - [MOUNTED.locate((point - d)[:3], (point - d)[3:]) for d in 1e-5 * np.eye(5)]) / 2e-5
    np.testing.assert_allclose(matrix, numeric.T, atol=1e-6)


def test_noise_equals_the_numpy_sensor():
    """Oracle: RangeBearing.covariance."""
    z = np.array([[0.0, 1.0], [10.0, -1.0], [80.0, 3.0]])
    got = np.empty((3, 2, 2))
    sensing.fill_noises(setup_of(), z, got)
    np.testing.assert_allclose(got, MOUNTED.covariance(z), rtol=1e-14)


@pytest.mark.parametrize("bad", [(-0.1, 0.0), (np.nan, 0.0), (1.0, np.nan), (np.inf, 0.0), (1.0, -np.inf)])
def test_first_bad_sighting(bad):
    """Oracle: the row where the bad number was put."""
    z = np.array([[0.0, 0.0], [1.0, 9.0], bad, bad])
    assert sensing.first_bad_sighting(z) == 2
    assert sensing.first_bad_sighting(z[:2]) == -1


@pytest.mark.parametrize("value", [0.0, np.pi, -np.pi, 3 * np.pi, 7.0, -1e3, np.nextafter(-np.pi, -4), 1e8])
def test_kernel_wrap_equals_the_numpy_wrap(value):
    """Oracle: kalmap.geometry.angles.wrap."""
    assert -np.pi <= regression.wrap(value) < np.pi
    np.testing.assert_allclose(regression.wrap(value), numpy_wrap(value), atol=1e-15)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_kernel_wrap_keeps_what_is_no_angle_visible(value):
    """Oracle: kalmap.geometry.angles.wrap, which gives NaN: a direction must not be made up."""
    assert np.isnan(numpy_wrap(value))
    assert np.isnan(regression.wrap(value))


@given(turn=st.one_of(st.floats(-6, 6), st.floats(-2e-4, 2e-4)))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_left_jacobian_equals_the_numpy_twin(turn):
    """Oracle: kalmap.geometry.se2.exp_position of the unit vector."""
    np.testing.assert_allclose(
        regression.left_jacobian(turn), exp_position(np.array(turn), np.array([1.0, 0.0])), atol=1e-15
    )


def test_small_block_operations():
    """Oracle: dense numpy: A P A', and N P N' with the twist matrix written out."""
    rng = np.random.default_rng(2)
    matrix, cov, out = rng.standard_normal((2, 5)), random_covariance(rng, 5), np.empty((2, 2))
    regression.congruence(matrix, cov, 2, 5, out)
    np.testing.assert_allclose(out, matrix @ cov @ matrix.T, atol=1e-13)
    assert out[0, 1] == out[1, 0]
    change, twisted = np.eye(5), cov.copy()
    change[3, 2], change[4, 2] = 4.0, -3.0  # xi = d - J (3, 4) d_theta
    sensing.to_twist(twisted, 3.0, 4.0)
    np.testing.assert_allclose(twisted, change @ cov @ change.T, atol=1e-12)
