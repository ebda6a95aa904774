import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmap.geometry.alignment import align, apply
from kalmap.geometry.angles import wrap

coordinate = st.floats(-1e3, 1e3)


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 30),
    angle=st.floats(-np.pi, np.pi),
    x=coordinate,
    y=coordinate,
)
def test_a_rigid_motion_is_recovered(seed, count, angle, x, y):
    points = np.random.default_rng(seed).uniform(-100, 100, (count, 2))
    targets = apply(angle, np.array([x, y]), points)
    found, translation = align(points, targets)
    np.testing.assert_allclose(apply(found, translation, points), targets, atol=1e-8)
    assert abs(wrap(found - angle)) < 1e-5


@given(seed=st.integers(0, 2**32 - 1), change=st.floats(-0.1, 0.1), dx=st.floats(-1, 1), dy=st.floats(-1, 1))
def test_no_other_motion_fits_better(seed, change, dx, dy):
    rng = np.random.default_rng(seed)
    points, targets = rng.normal(size=(2, 8, 2))
    angle, translation = align(points, targets)
    best = np.sum((apply(angle, translation, points) - targets) ** 2)
    other = np.sum((apply(angle + change, translation + [dx, dy], points) - targets) ** 2)
    assert best <= other + 1e-9


def test_without_pairs_nothing_moves():
    angle, translation = align(np.zeros((0, 2)), np.zeros((0, 2)))
    assert angle == 0
    np.testing.assert_array_equal(translation, [0, 0])


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("place", [0.1, 1e6])
def test_points_in_one_place_are_only_shifted(count, place):
    points = np.full((count, 2), place)
    targets = np.random.default_rng(1).uniform(size=(count, 2))
    angle, translation = align(points, targets)
    assert angle == 0
    np.testing.assert_allclose(translation, targets.mean(axis=0) - place, atol=1e-9)
    assert align(targets, points)[0] == 0


def test_no_correlation_leaves_the_rotation_at_zero():
    square = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    assert align(square, square * [1, -1])[0] == 0


def test_what_cannot_be_aligned_is_refused():
    with pytest.raises(ValueError, match=r"\(K, 2\)"):
        align(np.zeros((3, 2)), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="finite"):
        align(np.array([[np.nan, 0.0]]), np.zeros((1, 2)))
