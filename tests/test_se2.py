"""SE(2): group laws, the exponential's position part, angles. Oracles: 3 x 3 matrices and scipy's expm."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, exp_position, inverse, log_position, quarter_turn, rotate

number = st.floats(-1e3, 1e3)
poses = st.tuples(number, number, st.floats(-10, 10)).map(np.array)
quick = settings(max_examples=100, deadline=None, derandomize=True)


def matrix(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


@given(a=poses, b=poses)
@quick
def test_compose_and_inverse_are_matrix_product_and_inverse(a, b):
    """Oracle: homogeneous 3 x 3 matrices."""
    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)
    np.testing.assert_allclose(matrix(inverse(a)), np.linalg.inv(matrix(a)), atol=1e-9)
    assert -np.pi <= compose(a, b)[2] < np.pi
    assert -np.pi <= inverse(a)[2] < np.pi


@given(a=poses, b=poses, c=poses)
@quick
def test_group_laws(a, b, c):
    """Oracle: associativity and the neutral element."""
    left, right = compose(compose(a, b), c), compose(a, compose(b, c))
    np.testing.assert_allclose(left[:2], right[:2], atol=1e-8)
    assert abs(wrap(left[2] - right[2])) < 1e-12
    neutral = compose(a, inverse(a))
    np.testing.assert_allclose(neutral[:2], 0.0, atol=1e-9)
    assert abs(wrap(neutral[2])) < 1e-12


@given(angle=st.one_of(st.floats(-6, 6), st.floats(-2e-4, 2e-4)), x=number, y=number)
@quick
def test_exponential_and_logarithm_of_the_position(angle, x, y):
    """Oracle: scipy's matrix exponential of the twist; the logarithm takes it back."""
    twist = np.array([[0, -angle, x], [angle, 0, y], [0, 0, 0]])
    moved = exp_position(np.array(angle), np.array([x, y]))
    np.testing.assert_allclose(moved, expm(twist)[:2, 2], atol=1e-9)
    np.testing.assert_allclose(log_position(np.array(angle), moved), [x, y], atol=1e-8)


@given(angle=st.floats(-10, 10), x=number, y=number)
@quick
def test_rotate_and_quarter_turn(angle, x, y):
    """Oracle: multiplication of complex numbers."""
    v, z = np.array([x, y]), complex(x, y)
    turned = z * np.exp(1j * angle)
    np.testing.assert_allclose(rotate(np.array(angle), v), [turned.real, turned.imag], atol=1e-11)
    np.testing.assert_array_equal(quarter_turn(v), [-y, x])


def test_batches_broadcast():
    """Oracle: one pose at a time."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((4, 3)), rng.standard_normal((4, 3))
    np.testing.assert_allclose(compose(a, b), [compose(p, q) for p, q in zip(a, b, strict=True)], atol=1e-15)
    np.testing.assert_allclose(inverse(a), [inverse(p) for p in a], atol=1e-15)
    several = exp_position(a[:, 2], b[:, :2])
    np.testing.assert_allclose(
        several, [exp_position(p[2], q[:2]) for p, q in zip(a, b, strict=True)], atol=1e-15
    )
