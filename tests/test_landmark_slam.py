"""LandmarkSlam as an object: blocks, memory, snapshots, models of one's own,
refused settings and refused events."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from kalmap.gaussian import CentralDifference, Jacobian
from kalmap.models import Bias, RangeBearing, Unicycle, VelocitySteering
from kalmap.records import (
    AssociationConfig,
    ConfigError,
    EstimationError,
    MotionConfig,
    Odometry,
    RunConfig,
    Sightings,
)
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, slam_from_config
from slam_problems import LINEARISERS, circle_events, feed, state_of

EVENTS = circle_events(2, frames=12)


def one_by_one(events: list) -> list:
    """The same events with every odometry block cut into its samples."""
    pieces = []
    for event in events:
        if not isinstance(event, Odometry):
            pieces.append(event)
            continue
        ends = event.time - event.durations[::-1].cumsum()[::-1] + event.durations
        for k, end in enumerate(ends):
            time = event.time if k == len(ends) - 1 else float(end)
            pieces.append(Odometry(time, event.values[k : k + 1], event.durations[k : k + 1]))
    return pieces


class OwnMotion(VelocitySteering, frozen=True):
    compiled = False


class OwnSensor(RangeBearing, frozen=True):
    compiled = False


class OwnLineariser:
    """A user's lineariser: the central-difference rule by delegation, unknown to the kernels."""

    def __call__(self, f, mean, cov):
        return CentralDifference()(f, mean, cov)


@pytest.mark.parametrize("name", LINEARISERS)
@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_a_block_is_its_samples_one_by_one(name, coordinates):
    """Oracle: the same samples handed over singly: bit for bit."""
    biased = VelocitySteering(biases=(Bias("steering_offset", 0.02),))
    block = LandmarkSlam(biased, None, LINEARISERS[name], coordinates=coordinates)
    single = LandmarkSlam(biased, None, LINEARISERS[name], coordinates=coordinates)
    feed(block, EVENTS)
    feed(single, one_by_one(EVENTS))
    assert state_of(block) == state_of(single)


@pytest.mark.parametrize("scope", ["reduced", "full"])
def test_a_block_is_its_samples_one_by_one_in_the_general_engine(scope):
    """Oracle: as above, to rounding."""
    a, b = (LandmarkSlam(OwnMotion(), None, CentralDifference(), scope=scope) for _ in range(2))
    feed(a, EVENTS[:10])
    feed(b, one_by_one(EVENTS[:10]))
    np.testing.assert_allclose(a.estimate().joint()[0], b.estimate().joint()[0], atol=1e-12)
    np.testing.assert_allclose(a.estimate().joint()[1], b.estimate().joint()[1], atol=1e-12)


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
@pytest.mark.parametrize("part", ["motion", "sensor", "lineariser"])
def test_parts_of_ones_own_work_like_the_built_in_ones(part, coordinates):
    """Oracle: the compiled filter with the same formulas."""
    own = {"motion": OwnMotion(), "sensor": OwnSensor(), "lineariser": OwnLineariser()}[part]
    slam = feed(LandmarkSlam(**{part: own}, coordinates=coordinates), EVENTS)
    twin = feed(LandmarkSlam(coordinates=coordinates), EVENTS)
    np.testing.assert_allclose(slam.estimate().joint()[0], twin.estimate().joint()[0], atol=1e-9)
    np.testing.assert_allclose(slam.estimate().joint()[1], twin.estimate().joint()[1], atol=1e-9)


# --- memory ---------------------------------------------------------------------------------------


def test_memory_is_little_more_than_the_triangle():
    """Oracle: 8 bytes times 1.3 n^2 for all buffers; tracemalloc:
    a step without new landmarks allocates O(n)."""
    rng, count = np.random.default_rng(0), 800
    slam = LandmarkSlam(Unicycle(), RangeBearing(max_range=1e3))
    z = np.c_[rng.uniform(5, 200, count), rng.uniform(-3, 3, count)]
    slam.step(Odometry(0.0, np.array([[0.1, 0.0]]), np.array([0.1])))
    for first in range(0, count, 16):
        slam.step(Sightings(0.0, z[first : first + 16], np.arange(first, first + 16)))
    belief, n = slam._belief, 3 + 2 * count

    def step(time):
        slam.step(Odometry(time, np.array([[0.1, 0.0]]), np.array([0.1])))
        slam.step(Sightings(time, z[:16], np.arange(16)))

    step(1.0)
    held = sum(a.nbytes for a in (belief.mean, belief.packed, belief.phi, belief.left, belief.right))
    assert belief.n == n and held <= 1.3 * n**2 * 8
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        step(2.0)
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert peak < 0.05 * n**2 * 8


# --- snapshots ------------------------------------------------------------------------------------


def test_estimates_are_frozen():
    """Oracle: copies of every array taken at once; the filter goes on and changes none of the snapshot's."""
    slam = feed(LandmarkSlam(VelocitySteering(biases=(Bias("speed_scale", 0.05),))), EVENTS[:10])
    estimate = slam.estimate()
    landmarks = estimate.landmarks
    arrays = [estimate.pose, estimate.covariance, landmarks.ids, landmarks.positions, landmarks.covariances]
    arrays += [landmarks.sightings, landmarks.existence, *estimate.joint()]
    kept, bias = [a.copy() for a in arrays], dict(estimate.biases)
    feed(slam, EVENTS[10:])
    for array, copy in zip(arrays, kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert estimate.biases == bias and set(bias) == {"speed_scale"}
    estimate.pose[:] = 1e9
    assert abs(slam.pose).max() < 1e3


def test_joint_holds_the_snapshot_in_order():
    """Oracle: the estimate's own pieces."""
    estimate = feed(LandmarkSlam(VelocitySteering(biases=(Bias("speed_scale", 0.05),))), EVENTS).estimate()
    mean, covariance = estimate.joint()
    np.testing.assert_array_equal(mean[:3], estimate.pose)
    np.testing.assert_array_equal(mean[4:].reshape(-1, 2), estimate.landmarks.positions)
    np.testing.assert_array_equal(covariance[:3, :3], estimate.covariance)
    value, sigma = estimate.biases["speed_scale"]
    assert mean[3] == value and covariance[3, 3] == pytest.approx(sigma**2, rel=1e-12)
    for k, block in enumerate(estimate.landmarks.covariances):
        np.testing.assert_array_equal(covariance[4 + 2 * k : 6 + 2 * k, 4 + 2 * k : 6 + 2 * k], block)


@pytest.mark.parametrize("taken", [5, 6], ids=["before a frame of the same time", "before odometry"])
def test_joint_asked_too_late_is_an_error(taken):
    """Oracle: the promise of Estimate.joint; a frame at the same time as its odometry moves the filter
    on too."""
    slam = feed(LandmarkSlam(), EVENTS[:taken])
    estimate = slam.estimate()
    slam.step(EVENTS[taken])
    with pytest.raises(EstimationError, match="moved on"):
        estimate.joint()


# --- refused settings -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"scope": "whole"}, "scope"),
        ({"coordinates": "left"}, "coordinates"),
        ({"use": "both"}, "use"),
        ({"lineariser": Jacobian(), "scope": "full"}, "draws no points"),
        ({"start": (0.0, np.nan, 0.0)}, "start"),
        ({"start": (0.0, 0.0)}, "start"),
        ({"start_covariance": np.diag([1.0, -1.0, 1.0])}, "start_covariance"),
        ({"start_covariance": np.full((3, 3), np.inf)}, "start_covariance"),
        ({"start_covariance": np.triu(np.ones((3, 3)))}, "start_covariance"),
        ({"start_covariance": np.eye(2)}, "start_covariance"),
    ],
)
def test_refused_settings(settings, reason):
    """Oracle: ConfigError naming the setting."""
    with pytest.raises(ConfigError, match=reason):
        LandmarkSlam(**settings)


@pytest.mark.parametrize(
    "config",
    [
        RunConfig(association=AssociationConfig(method="dowsing")),
        RunConfig(association=AssociationConfig(method="nearest", management="guild")),
        RunConfig(motion=MotionConfig(model="tank")),
    ],
)
def test_unknown_names_of_a_configuration_made_in_python(config):
    """Oracle: ConfigError; a name that nobody knows must not become some other method quietly."""
    log = simulate(world_by_name("course-35"), 1)
    with pytest.raises(ConfigError, match=r"dowsing|guild|tank"):
        slam_from_config(config, log)
