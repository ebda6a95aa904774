"""What a simulated world consists of: features, way-points, a vehicle, a sensor, and what confuses it."""

from __future__ import annotations

import math
import sys

import msgspec
import numpy as np

from kalmap.records import (
    AssociationConfig,
    ConfigError,
    FiniteSetConfig,
    MotionConfig,
    PerceptionConfig,
    RunConfig,
    SensorConfig,
)
from kalmap.simulate.raycast import SICK, URG

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
    "mover_speed",
    "mover_radius",
)
_NOT_NEGATIVE = ("sigma_speed", "sigma_steering_deg", "min_range", "clutter", "sigma_beam")
_COUNTS = ("observe_every", "laps")
_PROBABILITIES = ("detection_probability", "detection_far", "doubles")
# far beyond what any frame holds, and what still fits into memory
_MOST = {"movers": 10_000, "clutter": 1_000}

# m; among trees that stand as close as two metres a park's three would leave most of them out
_CLEARANCE = 1.0

SCANNERS = {"sick": SICK, "urg": URG}
"""The scanners that a world can have, by name."""


class World(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A world by the rules of Bailey and Nieto's EKF-SLAM simulator; the defaults are theirs.

    Change single values with `msgspec.structs.replace(world, sigma_speed=0.6)`.

    landmarks: (N, 2) m; a feature's identity is its row. waypoints: (K, 2) m, driven in order, `laps`
        times over, from the start pose (0, 0, 0).
    speed: m/s. max_steering_deg, steering_rate_deg: deg, deg/s. wheelbase: m. dt: s a control step.
    observe_every: control steps from one look of the sensor to the next.
    at_waypoint: m, nearer than this a way-point counts as reached.
    min_range, max_range: m, what is nearer or farther is not seen. field_of_view_deg: the full angle, centred
        ahead; 180 is the half plane ahead.
    sigma_speed m/s, sigma_steering_deg, sigma_range m, sigma_bearing_deg: standard deviations of the
        noise of one control sample and one sighting.

    What breaks data association; all off by default:

    movers: how many pedestrians walk about among the features and are sighted like them. They start anywhere,
        turn slowly and at random, and are thrown back at the borders of the box that holds the features.
        mover_speed: m/s. mover_radius: m, for scanners.
    clutter: mean number of false sightings in a frame, a Poisson number, uniform in range and bearing.
    detection_probability: that what is in view is sighted; of every feature and mover in every frame by itself.
    detection_far: None, or that probability at `max_range`; it then changes with the range, straight from
        detection_probability at the sensor itself.
    doubles: probability that a sighted feature gives a second sighting in the frame, with its own noise.

    Whole scans instead of sightings:

    scanner: None, or one of `SCANNERS`: its beams are cast, so that things stand in each other's way and trunks are
        thick. max_range and field_of_view_deg may narrow it. radii: (N,) m, the trunks'. sigma_beam: m, noise of
        one beam; sigma_range and sigma_bearing_deg are then what may be expected of a trunk's centre as a
        detector finds it.

    Raises `ConfigError` for wrong shapes, for values that no vehicle or sensor can have, and for a scanner with
    clutter, doubles, a detection probability or a min_range, which are for sightings only.
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
    min_range: float = 0.0
    max_range: float = 30.0
    field_of_view_deg: float = 180.0
    sigma_speed: float = 0.3
    sigma_steering_deg: float = 3.0
    sigma_range: float = 0.1
    sigma_bearing_deg: float = 1.0
    movers: int = 0
    mover_speed: float = 1.4
    mover_radius: float = 0.25
    clutter: float = 0.0
    detection_probability: float = 1.0
    detection_far: float | None = None
    doubles: float = 0.0
    scanner: str | None = None
    radii: np.ndarray | None = None
    sigma_beam: float = 0.01

    def __post_init__(self) -> None:
        problem = _shape_problem(self) or _number_problem(self) or _scanner_problem(self)
        if problem:
            raise ConfigError(f"world {self.name}: {problem}")

    def defaults(self) -> RunConfig:
        """The settings of an estimator that knows this world's vehicle, sensor, noise, P_D and clutter exactly.

        Where P_D falls with the range, the one stated is that at half the range.

        Scans carry no ids: there the association is by likelihood, of trunks that the detector of trees finds.
        """
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
                min_range=self.min_range,
                max_range=self.max_range,
                field_of_view_deg=self.field_of_view_deg,
            ),
            association=AssociationConfig(method="known" if self.scanner is None else "likelihood"),
            perception=PerceptionConfig()
            if self.scanner is None
            else PerceptionConfig(detector="trees", clearance=_CLEARANCE),
            finite_set=self._finite_set(),
        )

    def _finite_set(self) -> FiniteSetConfig:
        """P_D and clutter as they are; of scans, what a detector finds in them, nobody knows exactly."""
        if self.scanner is not None:
            return FiniteSetConfig()
        far = self.detection_probability if self.detection_far is None else self.detection_far
        return FiniteSetConfig(
            detection=0.5 * (self.detection_probability + far), clutter=float(self.clutter)
        )


def _shape_problem(world: World) -> str | None:
    """What is wrong with a world's arrays, if anything."""
    for field, least in (("landmarks", 0), ("waypoints", 1)):
        points = getattr(world, field)
        if np.ndim(points) != 2 or np.shape(points)[1] != 2 or len(points) < least:
            return f"{field} must be (n, 2), got {np.shape(points)}"
        if not np.isfinite(points).all():
            return f"{field} must be finite"
    if world.radii is not None:
        if np.shape(world.radii) != (len(world.landmarks),):
            return f"radii must be one to a landmark ({len(world.landmarks)}), got {np.shape(world.radii)}"
        if not (np.isfinite(world.radii) & (np.asarray(world.radii) > 0)).all():
            return "radii must be finite and positive"
    return None


def _number_problem(world: World) -> str | None:
    for field in _POSITIVE + _NOT_NEGATIVE:
        value = getattr(world, field)
        # compared with the largest float, not asked whether finite: a whole number may be beyond every float
        if not 0 <= value <= sys.float_info.max or (value == 0 and field in _POSITIVE):
            return f"{field} must be {'positive' if field in _POSITIVE else 'zero or more'}, got {value}"
    for field in _COUNTS:
        if getattr(world, field) < 1:
            return f"{field} must be 1 or more"
    if world.max_steering_deg >= 90 or world.field_of_view_deg > 360:
        return "max_steering_deg must be below 90 and field_of_view_deg at most 360"
    if world.min_range >= world.max_range:
        return f"min_range must be below max_range ({world.max_range:g} m), got {world.min_range:g}"
    for field in _PROBABILITIES:
        value = getattr(world, field)
        if field == "detection_far" and value is None:
            continue
        if not 0 <= value <= 1:
            return f"{field} must be a probability, 0 to 1, got {value}"
    if not isinstance(world.movers, int) or world.movers < 0:
        return f"movers must be a whole number, 0 or more, got {world.movers}"
    for field, most in _MOST.items():
        if getattr(world, field) > most:
            return f"{field} must be at most {most}, got {getattr(world, field)}"
    return None


def _scanner_problem(world: World) -> str | None:
    if world.scanner is None:
        return None
    if world.scanner not in SCANNERS:
        return f"unknown scanner {world.scanner!r}; known are {', '.join(SCANNERS)}"
    if world.radii is None:
        return "a scanner needs the radii of the landmarks"
    scanner = SCANNERS[world.scanner]
    if world.max_range > scanner.max_range:
        return f"max_range must be at most the scanner's {scanner.max_range:g} m, got {world.max_range:g}"
    width = math.degrees(2.0 * np.abs(scanner.bearings).max())
    if world.field_of_view_deg > width + 1e-6:
        return f"field_of_view_deg must be at most the scanner's {width:.4g}, got {world.field_of_view_deg:g}"
    missed = world.detection_probability < 1 or world.detection_far is not None
    if world.clutter or world.doubles or missed or world.min_range:
        return "clutter, doubles, detection and min_range are for sightings: a scanner has none of them"
    return None
