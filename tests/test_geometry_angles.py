import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kalmap.geometry.angles import wrap

angles = hnp.arrays(float, hnp.array_shapes(max_dims=3, max_side=5), elements=st.floats(-1e6, 1e6))


@given(angles)
def test_wrap_stays_in_the_half_open_circle_and_keeps_the_direction(angle):
    wrapped = wrap(angle)
    assert wrapped.shape == angle.shape
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


@given(st.floats(-np.pi, np.pi, exclude_max=True))
def test_wrap_leaves_wrapped_angles_alone(angle):
    assert wrap(angle) == angle


def test_wrap_at_the_seam():
    assert wrap(np.pi) == -np.pi
    assert wrap(-np.pi) == -np.pi
    assert -np.pi <= wrap(np.nextafter(-np.pi, -4.0)) < np.pi
    assert wrap(3 * np.pi) == -np.pi


def test_wrap_has_no_direction_for_what_is_not_finite():
    assert np.isnan(wrap([np.nan, np.inf, -np.inf])).all()


def test_wrap_hands_out_its_own_array_and_a_scalar_as_an_array():
    """What is done to the answer must not change the angle that was handed in."""
    angle = np.array([0.1, -3.0, 2.0])
    wrap(angle)[:] = 9.0
    assert (angle == [0.1, -3.0, 2.0]).all()
    for each in (0.5, np.float64(4.0), np.array(0.5)):
        assert isinstance(wrap(each), np.ndarray)
        assert wrap(each).shape == ()
