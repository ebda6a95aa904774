"""Motion kernels: increments against the numpy models, Jacobians against finite differences."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalmap.kernels import controls as kernel
from kalmap.kernels import layout, motion
from slam_problems import controls, motions

NAMES = ("velocity-steering", "ackermann", "unicycle", "increments")


def setup_of(model) -> np.ndarray:
    setup = np.zeros(layout.SETUP_LENGTH)
    model.fill(setup)
    return setup


def triple(control: np.ndarray) -> tuple[float, float, float]:
    return control[0], control[1] if len(control) == 3 else 0.0, control[-1]


def increment_at(setup: np.ndarray, corrected: np.ndarray, dt: float) -> np.ndarray:
    return np.array(kernel.increment(setup, *triple(corrected), dt))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("biases", [0, 2, 3, 4])
def test_increments_and_noise_equal_the_numpy_models(name, biases):
    """Oracle: the numpy twin in kalmap.models."""
    rng, model = np.random.default_rng(biases), motions(biases)[name]
    biases = len(model.biases)  # the fourth is the steered vehicles' course offset
    setup, zero = setup_of(model), np.zeros(3 + biases)
    samples, durations = controls(rng, model, 20)
    for control, dt in zip(samples, durations, strict=True):
        bias = rng.normal(0, 0.05, biases)
        got = kernel.sample_increment(setup, triple(control), (0.0, 0.0, 0.0), bias, zero, dt)
        np.testing.assert_allclose(got, model.increment(control, bias, dt), atol=1e-14)
        noise = np.zeros((model.control_size, model.control_size))
        kernel.control_covariance(setup, triple(control), dt, noise)
        np.testing.assert_allclose(noise, model.control_covariance(control, dt), rtol=1e-13)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_noise_at_standstill_equals_the_numpy_model(name, exact):
    """Oracle: the numpy twin, and zero where a standstill is believed exactly."""
    model = msgspec.structs.replace(motions(0)[name], exact_standstill=exact)
    control, noise = np.zeros(model.control_size), np.ones((model.control_size, model.control_size))
    kernel.control_covariance(setup_of(model), triple(control), 0.1, noise)
    np.testing.assert_allclose(noise, model.control_covariance(control, 0.1), rtol=1e-13)
    assert not exact or not noise.any()


@pytest.mark.parametrize("name", NAMES)
@given(
    speed=st.floats(-10, 10),
    turn=st.one_of(st.floats(-0.7, 0.7), st.floats(-3e-4, 3e-4)),
    dt=st.floats(1e-3, 1.0),
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_increment_jacobian(name, speed, turn, dt):
    """Oracle: central differences of the increment, also around the switch to the series at 1e-4 rad."""
    model = motions(0)[name]
    setup, c = setup_of(model), model.control_size
    control = np.array([speed, 0.3 * speed, turn]) if c == 3 else np.array([speed, turn])
    got = np.empty((3, c))
    kernel.increment_jacobian(setup, control, dt, got)
    steps = 1e-5 * np.eye(c)
    expected = [
        (increment_at(setup, control + d, dt) - increment_at(setup, control - d, dt)) / 2e-5 for d in steps
    ]
    np.testing.assert_allclose(got, np.array(expected).T, atol=2e-6 * (1 + abs(speed)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("biases", [1, 2, 3, 4])
def test_bias_jacobian(name, biases):
    """Oracle: central differences of the model's corrected control."""
    rng, model = np.random.default_rng(7), motions(biases)[name]
    biases = len(model.biases)  # a course offset turns the increment and not the control: its column is zero
    control = controls(rng, model, 1)[0][0]
    got = np.empty((model.control_size, biases))
    kernel.bias_jacobian(setup_of(model), control, model.control_size, got)
    steps = 1e-5 * np.eye(biases)
    expected = [(model.corrected(control, d) - model.corrected(control, -d)) / 2e-5 for d in steps]
    np.testing.assert_allclose(got, np.array(expected).T, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("biases", [0, 1, 3, 4])
def test_propagated_matrices_are_the_derivatives_of_the_propagated_mean(name, biases):
    """Oracle: central differences of the kernel's own mean over three samples, by pose and biases; and of the
    covariance the same derivatives by each sample's control, times its noise."""
    rng, model = np.random.default_rng(biases), motions(biases)[name]
    setup, d = setup_of(model), 3 + len(model.biases)
    samples, durations = controls(rng, model, 3)
    c, mean = model.control_size, np.r_[1.0, -2.0, 0.8, rng.normal(0, 0.05, d - 3)]

    def carried(mean, samples):
        end, packed, phi = mean.copy(), np.zeros(d * (d + 1) // 2), np.eye(d)
        noise = np.tile(0.01 * np.eye(c), (3, 1, 1))
        assert motion.propagate(setup, end, packed, phi, samples, durations, noise) == layout.OK
        return end, packed, phi

    steps = 1e-5 * np.eye(d)
    by_state = np.array(
        [(carried(mean + e, samples)[0] - carried(mean - e, samples)[0]) / 2e-5 for e in steps]
    ).T
    _, packed, phi = carried(mean, samples)
    np.testing.assert_allclose(phi, by_state, atol=1e-8)
    expected = np.zeros((d, d))
    for at in np.ndindex(samples.shape):
        moved = np.zeros_like(samples)
        moved[at] = 1e-5
        column = (carried(mean, samples + moved)[0] - carried(mean, samples - moved)[0]) / 2e-5
        expected += 0.01 * np.outer(column, column)
    np.testing.assert_allclose(packed, expected[np.tril_indices(d)], atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("rule", [0, 2])
def test_propagate_leaves_everything_alone_after_an_error(name, rule):
    """Oracle: the arguments as they were. The second sample's noise is not a covariance."""
    rng, model = np.random.default_rng(1), motions(0)[name]
    setup, c = setup_of(model), model.control_size
    setup[layout.RULE], setup[layout.RULE_A] = rule, 3**0.5
    samples, durations = controls(rng, model, 2)
    noise = np.stack([np.eye(c), np.full((c, c), np.nan)])
    mean, packed, phi = np.zeros(3), np.array([1.0, 0.1, 1.0, 0, 0, 1.0]), np.eye(3)
    before = mean.copy(), packed.copy(), phi.copy()
    assert motion.propagate(setup, mean, packed, phi, samples, durations, noise) != layout.OK
    for array, kept in zip((mean, packed, phi), before, strict=True):
        np.testing.assert_array_equal(array, kept)
