"""What a simulated floor consists of: walls, columns, furniture, people, a robot's way, its wheels and its scanner."""

from __future__ import annotations

import math
import sys

import msgspec
import numpy as np

from kalmap.records import ConfigError, ContourConfig, FilterConfig, MotionConfig, RunConfig, SensorConfig
from kalmap.simulate.raycast import SICK_180, URG, Scanner

URG_REPORTED = 5.6
"""m, up to which a URG-04LX reports what it can; it is rated for 4 m."""

FLOOR_SCANNERS = {"urg": URG, "sick": SICK_180}
"""The scanners that a floor can have, by name."""

_POSITIVE = ("speed", "turn_rate_deg", "turn_radius", "rate", "max_range", "person_radius", "person_speed")
_NOT_NEGATIVE = (
    "stand",
    "sigma_beam",
    "sigma_beam_ratio",
    "quantum",
    "sigma_distance_ratio",
    "sigma_rotation_deg",
    "sigma_rotation_ratio",
    "furniture",
)
_FINITE = ("distance_scale", "heading_bias_deg", "mount_x", "mount_y", "mount_heading_deg")
_SHARES = ("dropout", "mixed_pixels")
_ARRAYS = {"walls": 4, "columns": 3, "areas": 5, "waypoints": 2}
_MOST_PEOPLE = 1_000
# a scanner's bearings are exact here; an estimator is told a quarter of the finest spacing of beams
_SIGMA_BEARING_DEG = 0.09


class FloorWorld(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A floor that a robot with two wheels and a laser scanner drives through.

    walls: (S, 4) m, segments from x, y to x, y; curved ones are chains of short segments. columns: (C, 3) x, y,
        radius m.
    areas: (A, 5) x low, y low, x high, y high m, and how many pieces of furniture stand in that box on average; the
        seed says which and where. furniture: factor on all these numbers.
    waypoints: (W, 2) m; the robot starts at the first and looks to the second. stand: s that it stands before it goes.
    speed: m/s. turn_rate_deg: deg/s, the most. turn_radius: m, of its bends at way-points.
    walkways: closed ways (K, 2) m that people walk along. people: how many. person_speed: m/s, person_radius: m.

    scanner: one of `FLOOR_SCANNERS`. rate: scans a second. mount_x, mount_y: m, mount_heading_deg: the scanner in the
        robot's frame. upside_down: it hangs upside down, so that its sweep runs from left to right and its bearings
        fall.
    max_range: m, beyond which nothing is reported. sigma_beam: m, sigma_beam_ratio: share of the range; the variances
        add. quantum: m, in which ranges are reported. dropout: share of beams without a return although there is
        something; beyond the range that a scanner is rated for it rises straight to 1 at max_range.
    mixed_pixels: share of the beams beside an edge that report a range between the two sides.

    sigma_distance_ratio, sigma_rotation_deg, sigma_rotation_ratio: noise of one increment of the wheels' odometry, as
        `MotionConfig` has it; wheels that stand still say so exactly. distance_scale: share by which the odometry
        says too much of every way; heading_bias_deg: deg that it turns too far to the left on every metre.

    Raises `ConfigError` for wrong shapes and values that no robot, scanner or person can have.
    """

    name: str
    walls: np.ndarray
    waypoints: np.ndarray
    columns: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3)))
    areas: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 5)))
    walkways: tuple[np.ndarray, ...] = ()
    furniture: float = 1.0
    stand: float = 0.0
    speed: float = 0.4
    turn_rate_deg: float = 45.0
    turn_radius: float = 0.4
    people: int = 0
    person_speed: float = 1.2
    person_radius: float = 0.25
    scanner: str = "urg"
    rate: float = 5.0
    mount_x: float = 0.1
    mount_y: float = 0.0
    mount_heading_deg: float = 0.0
    upside_down: bool = False
    max_range: float = URG_REPORTED
    sigma_beam: float = 0.01
    sigma_beam_ratio: float = 0.01
    quantum: float = 0.001
    dropout: float = 0.01
    mixed_pixels: float = 0.2
    sigma_distance_ratio: float = 0.1
    sigma_rotation_deg: float = 0.5
    sigma_rotation_ratio: float = 0.1
    distance_scale: float = 0.01
    heading_bias_deg: float = 0.1

    def __post_init__(self) -> None:
        problem = _array_problem(self) or _number_problem(self)
        if problem:
            raise ConfigError(f"floor {self.name}: {problem}")

    @property
    def device(self) -> Scanner:
        """The scanner itself: its beams, and the range that it is rated for."""
        return FLOOR_SCANNERS[self.scanner]

    @property
    def mount(self) -> np.ndarray:
        """(3,) the scanner in the robot's frame."""
        return np.array([self.mount_x, self.mount_y, math.radians(self.mount_heading_deg)])

    def defaults(self) -> RunConfig:
        """The settings of an estimator that knows this robot and scanner and their noise, but not their systematic
        errors: those of the odometry, mixed pixels, people."""
        return RunConfig(
            filter=FilterConfig(name="ekf"),
            motion=MotionConfig(
                model="increments",
                sigma_distance_ratio=self.sigma_distance_ratio,
                sigma_rotation_deg=self.sigma_rotation_deg,
                sigma_rotation_ratio=self.sigma_rotation_ratio,
                exact_standstill=True,
            ),
            sensor=SensorConfig(
                mount_x=self.mount_x,
                mount_y=self.mount_y,
                mount_heading_deg=self.mount_heading_deg,
                sigma_range=max(self.sigma_beam, 0.001),
                sigma_range_ratio=self.sigma_beam_ratio,
                sigma_bearing_deg=_SIGMA_BEARING_DEG,
                max_range=self.max_range,
                field_of_view_deg=math.degrees(2.0 * np.abs(self.device.bearings).max()),
            ),
            contour=ContourConfig(
                method="dc-slasem", clear_range=min(ContourConfig().clear_range, self.device.max_range)
            ),
        )


def _array_problem(world: FloorWorld) -> str | None:
    """What is wrong with a floor's arrays, if anything."""
    for field, columns in _ARRAYS.items():
        rows = getattr(world, field)
        if np.ndim(rows) != 2 or np.shape(rows)[1] != columns:
            return f"{field} must be (n, {columns}), got {np.shape(rows)}"
        if not np.isfinite(rows).all():
            return f"{field} must be finite"
    if len(world.waypoints) < 1:
        return "waypoints must be one or more"
    if (world.columns[:, 2] <= 0).any():
        return "columns must have positive radii"
    if (world.areas[:, 4] < 0).any() or (world.areas[:, 2:4] <= world.areas[:, :2]).any():
        return "areas must be boxes with zero or more pieces of furniture"
    for way in world.walkways:
        if np.ndim(way) != 2 or np.shape(way)[1] != 2 or len(way) < 2 or not np.isfinite(way).all():
            return f"walkways must be (n, 2) and finite, two points or more, got {np.shape(way)}"
    if world.people and not world.walkways:
        return "people need walkways"
    return None


def _number_problem(world: FloorWorld) -> str | None:
    for field in _POSITIVE + _NOT_NEGATIVE:
        value = getattr(world, field)
        if not 0 <= value <= sys.float_info.max or (value == 0 and field in _POSITIVE):
            return f"{field} must be {'positive' if field in _POSITIVE else 'zero or more'}, got {value}"
    for field in _FINITE:
        if not abs(getattr(world, field)) <= sys.float_info.max:
            return f"{field} must be finite, got {getattr(world, field)}"
    for field in _SHARES:
        if not 0 <= getattr(world, field) <= 1:
            return f"{field} must be a share, 0 to 1, got {getattr(world, field)}"
    if world.scanner not in FLOOR_SCANNERS:
        return f"unknown scanner {world.scanner!r}; known are {', '.join(FLOOR_SCANNERS)}"
    if not isinstance(world.people, int) or not 0 <= world.people <= _MOST_PEOPLE:
        return f"people must be a whole number, 0 to {_MOST_PEOPLE}, got {world.people}"
    if not world.distance_scale > -1:
        return f"distance_scale must be above -1, got {world.distance_scale}"
    return None
