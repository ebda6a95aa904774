"""What a simulated world consists of: features, way-points, a vehicle and a sensor."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.records import ConfigError, MotionConfig, RunConfig, SensorConfig

_POSITIVE = (
    "speed",
    "max_steering_deg",
    "steering_rate_deg",
    "wheelbase",
    "dt",
    "at_waypoint",
    "max_range",
    "field_of_view_deg",
    "sigma_range",
    "sigma_bearing_deg",
)
_NOT_NEGATIVE = ("sigma_speed", "sigma_steering_deg")
_COUNTS = ("observe_every", "laps")


class World(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A world by the rules of Bailey and Nieto's EKF-SLAM simulator; the defaults are theirs.

    Change single values with `msgspec.structs.replace(world, sigma_speed=0.6)`.

    landmarks: (N, 2) m; a feature's identity is its row. waypoints: (K, 2) m, driven in order, `laps`
        times over, from the start pose (0, 0, 0).
    speed: m/s. max_steering_deg, steering_rate_deg: deg, deg/s. wheelbase: m. dt: s a control step.
    observe_every: control steps from one look of the sensor to the next.
    at_waypoint: m, nearer than this a way-point counts as reached.
    max_range: m. field_of_view_deg: the full angle, centred ahead; 180 is the half plane ahead.
    sigma_speed m/s, sigma_steering_deg, sigma_range m, sigma_bearing_deg: standard deviations of the
        noise of one control sample and one sighting.

    Raises `ConfigError` for wrong shapes and for values that no vehicle or sensor can have.
    """

    name: str
    landmarks: np.ndarray
    waypoints: np.ndarray
    speed: float = 3.0
    max_steering_deg: float = 30.0
    steering_rate_deg: float = 20.0
    wheelbase: float = 4.0
    dt: float = 0.025
    observe_every: int = 8
    at_waypoint: float = 1.0
    laps: int = 2
    max_range: float = 30.0
    field_of_view_deg: float = 180.0
    sigma_speed: float = 0.3
    sigma_steering_deg: float = 3.0
    sigma_range: float = 0.1
    sigma_bearing_deg: float = 1.0

    def __post_init__(self) -> None:
        for field, least in (("landmarks", 0), ("waypoints", 1)):
            points = getattr(self, field)
            if np.ndim(points) != 2 or np.shape(points)[1] != 2 or len(points) < least:
                raise ConfigError(f"world {self.name}: {field} must be (n, 2), got {np.shape(points)}")
            if not np.isfinite(points).all():
                raise ConfigError(f"world {self.name}: {field} must be finite")
        for field in _POSITIVE + _NOT_NEGATIVE:
            value = getattr(self, field)
            if not math.isfinite(value) or value < 0 or (value == 0 and field in _POSITIVE):
                sign = "positive" if field in _POSITIVE else "zero or more"
                raise ConfigError(f"world {self.name}: {field} must be {sign}, got {value}")
        for field in _COUNTS:
            if getattr(self, field) < 1:
                raise ConfigError(f"world {self.name}: {field} must be 1 or more")
        if self.max_steering_deg >= 90 or self.field_of_view_deg > 360:
            raise ConfigError(
                f"world {self.name}: max_steering_deg must be below 90 and field_of_view_deg at most 360"
            )

    def defaults(self) -> RunConfig:
        """The settings of an estimator that knows this world's vehicle, sensor and noise exactly."""
        return RunConfig(
            motion=MotionConfig(
                model="velocity-steering",
                wheelbase=self.wheelbase,
                sigma_speed=self.sigma_speed,
                sigma_steering_deg=self.sigma_steering_deg,
                sample_time=0.0,
            ),
            sensor=SensorConfig(
                sigma_range=self.sigma_range,
                sigma_bearing_deg=self.sigma_bearing_deg,
                max_range=self.max_range,
                field_of_view_deg=self.field_of_view_deg,
            ),
        )
