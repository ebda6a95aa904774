"""Motion and sensor models against fine integration, each other and their configuration."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalmap.geometry.angles import wrap
from kalmap.models import Ackermann, Bias, Increments, RangeBearing, Unicycle, VelocitySteering
from kalmap.models.charts import NewLandmark, NextPose, SeenLandmark, twist_matrix
from kalmap.models.motion import motion_from_config
from kalmap.models.sensor import sensor_from_config
from kalmap.records import ConfigError, MotionConfig, SensorConfig
from slam_problems import MOUNTED, controls, motions

NONE = np.zeros(0)


def euler(speed: float, rate: float, dt: float, steps: int = 20000) -> np.ndarray:
    """Body increment of a constant twist by midpoint steps: the independent oracle of an arc."""
    headings = rate * dt * (np.arange(steps) + 0.5) / steps
    h = speed * dt / steps
    return np.array([h * np.cos(headings).sum(), h * np.sin(headings).sum(), rate * dt])


@pytest.mark.parametrize("rate", [0.0, 1e-7, 1e-3, 0.4, -2.0])
def test_unicycle_arc_is_the_integral(rate):
    """Oracle: 20,000 midpoint steps."""
    got = Unicycle().increment(np.array([2.0, rate]), NONE, 0.7)
    np.testing.assert_allclose(got, euler(2.0, rate, 0.7), atol=1e-9)


@pytest.mark.parametrize("steering", [0.0, 1e-6, 0.1, -0.5])
@pytest.mark.parametrize("offset", [0.0, 0.76])
def test_ackermann_arc_is_the_integral(steering, offset):
    """Oracle: 20,000 midpoint steps of the rear axle; the wheel at `offset` to the left rolls v (1 - w
    offset / v)."""
    model, speed = Ackermann(wheelbase=2.83, encoder_offset=offset), 4.0
    rate = speed * np.tan(steering) / 2.83
    wheel = speed - rate * offset  # speed of a point `offset` to the left of the axle's centre
    got = model.increment(np.array([wheel, steering]), NONE, 0.5)
    np.testing.assert_allclose(got, euler(speed, rate, 0.5), atol=1e-9)


def test_velocity_steering_is_baileys_step():
    """Oracle: the formula of the simulator, in the map frame, turned back into the body."""
    v, g, dt, phi = 3.0, 0.2, 0.025, 0.7
    world = np.array([v * dt * np.cos(g + phi), v * dt * np.sin(g + phi)])
    c, s = np.cos(phi), np.sin(phi)
    got = VelocitySteering(wheelbase=4.0).increment(np.array([v, g]), NONE, dt)
    np.testing.assert_allclose(
        got, [c * world[0] + s * world[1], c * world[1] - s * world[0], v * dt * np.sin(g) / 4]
    )


@pytest.mark.parametrize("name", ["velocity-steering", "ackermann", "unicycle", "increments"])
def test_biases_correct_the_control(name):
    """Oracle: a model without biases, given the control corrected by hand."""
    rng = np.random.default_rng(0)
    plain, biased = motions(0)[name], motions(3)[name]
    control, bias = (
        controls(rng, plain, 1)[0][0],
        np.array([0.03, -0.1, 0.2]),
    )  # offset, speed scale, turn scale
    by_hand = control.copy()
    by_hand[:-1] *= 0.9
    by_hand[-1] = 1.2 * control[-1] + 0.03
    expected = plain.increment(by_hand, NONE, 0.1)
    np.testing.assert_allclose(biased.increment(control, bias, 0.1), expected, rtol=1e-13)
    batch = biased.increment(np.repeat(control[None], 3, 0), np.repeat(bias[None], 3, 0), 0.1)
    np.testing.assert_allclose(batch, np.repeat(expected[None], 3, 0), rtol=1e-13)


@pytest.mark.parametrize("name", ["velocity-steering", "ackermann"])
@pytest.mark.parametrize("course", [0.0, 0.03, -2.0])
def test_a_course_offset_turns_the_way_and_nothing_else(name, course):
    """Oracle: the increment with the other three errors, its way turned by a rotation matrix; the turn stays."""
    rng = np.random.default_rng(1)
    model, without = motions(4)[name], motions(3)[name]
    control, bias = controls(rng, model, 1)[0][0], np.array([0.03, -0.1, 0.2, course])
    expected = without.increment(control, bias[:3], 0.1)
    c, s = np.cos(course), np.sin(course)
    expected[:2] = np.array([[c, -s], [s, c]]) @ expected[:2]
    np.testing.assert_allclose(model.increment(control, bias, 0.1), expected, rtol=1e-13)
    np.testing.assert_array_equal(model.corrected(control, bias), without.corrected(control, bias[:3]))
    batch = model.increment(np.repeat(control[None], 3, 0), bias + np.zeros((3, 1)), 0.1)
    np.testing.assert_allclose(batch, np.repeat(expected[None], 3, 0), rtol=1e-13)


def test_a_course_offset_is_a_sensor_askew():
    """Oracle: a vehicle with the sensor's heading as its own, whose sensor looks straight ahead: the same path and
    the same sightings, the frame turned by the angle."""
    askew, course = np.array([3.0, 0.2]), 0.25
    model = VelocitySteering(biases=(Bias("course_offset", 0.1),))
    straight, turned = np.array([1.0, 2.0, 0.4]), np.array([1.0, 2.0, 0.4 - course])
    mounted, plain, landmark = RangeBearing(mount=(0.0, 0.0, -course)), RangeBearing(), np.array([9.0, 7.0])
    for _ in range(5):
        pair = []
        for pose, bias in ((straight, 0.0), (turned, course)):
            step, (c, s) = model.increment(askew, np.array([bias]), 0.1), (np.cos(pose[2]), np.sin(pose[2]))
            pair.append(pose + [c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        straight, turned = pair
        np.testing.assert_allclose(turned, straight - [0.0, 0.0, course], atol=1e-12)
        np.testing.assert_allclose(
            plain.predict(turned, landmark), mounted.predict(straight, landmark), atol=1e-12
        )


def test_control_noise_by_hand():
    """Oracle: the sums of MotionConfig's docstring."""
    model = Unicycle(
        sigma_speed=0.3, ratio_speed=0.1, sigma_turn_rate=0.2, ratio_turn_rate=0.5, sample_time=0.1
    )
    q = model.control_covariance(np.array([2.0, 0.4]), 0.05)
    np.testing.assert_allclose(q, 2.0 * np.diag([0.3**2 + 0.2**2, 0.2**2 + 0.2**2]))
    model = Increments(ratio_distance=0.1, sigma_rotation=0.02, ratio_rotation=0.5)
    q = model.control_covariance(np.array([3.0, 4.0, 0.1]), 0.05)
    np.testing.assert_allclose(q, np.diag([0.25, 0.25, 0.02**2 + 0.05**2]))


@given(
    pose=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-4, 4)).map(np.array),
    distance=st.floats(0.1, 80),
    bearing=st.floats(-3.1, 3.1),
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_sensor_predicts_what_it_locates(pose, distance, bearing):
    """Oracle: predict and locate are inverse to each other, with a mounted sensor."""
    z = np.array([distance, bearing])
    back = MOUNTED.predict(pose, MOUNTED.locate(pose, z))
    np.testing.assert_allclose(back[0], distance, rtol=1e-9)
    assert abs(wrap(back[1] - bearing)) < 1e-9


def test_sensor_mount_by_hand():
    """Oracle: a robot facing north, its sensor 1 m ahead and looking left:
    a landmark 2 m west of the sensor."""
    sensor = RangeBearing(mount=(1.0, 0.0, np.pi / 2))
    z = sensor.predict(np.array([5.0, 5.0, np.pi / 2]), np.array([3.0, 6.0]))
    np.testing.assert_allclose(z, [2.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize("kind", ["next", "next askew", "seen", "new"])
def test_charts_are_zero_at_the_mean_and_read_leading_entries_only(kind, invariant):
    """Oracle: a deviation of zero, and Theorem 1: further entries change nothing and have no derivative."""
    rng = np.random.default_rng(3)
    pose, landmark = np.array([1.0, 2.0, 0.7]), np.array([8.0, -3.0])
    chart = {
        "next": NextPose(
            motions(2)["unicycle"], pose, np.array([0.01, 0.02]), np.array([3.0, 0.2]), 0.1, invariant
        ),
        "next askew": NextPose(
            motions(4)["ackermann"], pose, np.full(4, 0.05), np.array([3.0, 0.2]), 0.1, invariant
        ),
        "seen": SeenLandmark(MOUNTED, pose, landmark, invariant),
        "new": NewLandmark(MOUNTED, pose, np.array([7.0, 0.4]), invariant),
    }[kind]
    np.testing.assert_allclose(chart(np.zeros(chart.size)), 0.0, atol=1e-12)
    x = 0.1 * rng.standard_normal(chart.size + 4)
    np.testing.assert_array_equal(chart(x), chart(np.concatenate([x[: chart.size], np.zeros(4)])))
    np.testing.assert_array_equal(chart.jacobian(np.zeros(len(x)))[:, chart.size :], 0.0)


def test_invariant_sighting_does_not_see_a_common_twist():
    """Oracle: moving robot and landmark by the same twist leaves range and bearing as they are."""
    chart = SeenLandmark(MOUNTED, np.array([1.0, 2.0, 0.7]), np.array([8.0, -3.0]), True)
    common = np.array([0.5, -0.3, 0.4, 0.5, -0.3])
    np.testing.assert_allclose(chart(common), 0.0, atol=1e-12)


def test_twist_matrix_by_hand():
    """Oracle: xi_l = d_l - J (l - c) d_theta."""
    change = twist_matrix(5, np.array([1.0, 1.0]), {3: np.array([4.0, 5.0])})
    np.testing.assert_allclose(change @ np.array([0, 0, 0.1, 2.0, 3.0]), [0, 0, 0.1, 2.4, 2.7])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("velocity-steering", VelocitySteering),
        ("ackermann", Ackermann),
        ("unicycle", Unicycle),
        ("increments", Increments),
    ],
)
def test_configurations_name_the_models(name, kind):
    """Oracle: the class, and degrees turned into radians by hand."""
    model = motion_from_config(MotionConfig(model=name, biases=("speed_scale",), prior_speed_scale=0.07))
    assert isinstance(model, kind) and model.biases == (Bias("speed_scale", 0.07),)
    sensor = sensor_from_config(
        SensorConfig(mount_heading_deg=90.0, sigma_bearing_deg=2.0, field_of_view_deg=120.0)
    )
    np.testing.assert_allclose([sensor.mount[2], sensor.sigma_bearing], [np.pi / 2, np.pi / 90])
    np.testing.assert_allclose(sensor.field_of_view, 2 * np.pi / 3)


def test_a_course_offset_is_configured_in_degrees():
    """Oracle: degrees turned into radians by hand, prior and mean."""
    config = MotionConfig(biases=("course_offset",), prior_course_offset_deg=2.0, mean_course_offset_deg=-3.0)
    (bias,) = motion_from_config(config).biases
    assert bias.name == "course_offset"
    np.testing.assert_allclose([bias.sigma, bias.mean], [np.pi / 90, -np.pi / 60])


def test_biases_that_a_model_does_not_have_are_refused():
    """Oracle: the error names the field."""
    for model, biases in (
        ("ackermann", ("turn_rate_offset",)),
        ("ackermann", ("speed_scale", "speed_scale")),
        ("unicycle", ("course_offset",)),
        ("increments", ("course_offset",)),
    ):
        with pytest.raises(ConfigError, match=r"motion\.biases"):
            motion_from_config(MotionConfig(model=model, biases=biases))


def test_unknown_keys_are_refused():
    """Oracle: msgspec's error names the key."""
    with pytest.raises(msgspec.ValidationError, match="sigma_sped"):
        msgspec.convert({"sigma_sped": 0.3}, MotionConfig)
    with pytest.raises(msgspec.ValidationError, match=r"model"):
        msgspec.convert({"model": "hovercraft"}, MotionConfig)


@pytest.mark.parametrize("config", [MotionConfig(model="hovercraft"), MotionConfig(biases=("drift",))])
def test_unknown_names_built_in_python_are_refused(config):
    """Oracle: ConfigError naming what is wrong, not another model quietly and not a KeyError."""
    with pytest.raises(ConfigError, match=r"hovercraft|drift"):
        motion_from_config(config)
