"""The ACFR utility car, which recorded Victoria Park and the car park: geometry, sensor, conventions."""

from __future__ import annotations

import numpy as np

from kalmap.records import AssociationConfig, MotionConfig, RunConfig, SensorConfig

MOUNT = (3.78, 0.5)
"""m: the laser and the GPS antenna in the rear axle's frame (forward, left)."""

MOTION = MotionConfig(
    model="ackermann",
    wheelbase=2.83,
    encoder_offset=0.76,
    sigma_speed=0.3,
    sigma_steering_deg=2.0,
    sample_time=0.025,
    biases=("steering_offset", "steering_scale", "speed_scale"),
)

SENSOR = SensorConfig(
    mount_x=MOUNT[0],
    mount_y=MOUNT[1],
    sigma_range=0.1,
    sigma_bearing_deg=1.0,
    max_range=80.0,
    field_of_view_deg=180.0,
)

NO_RETURN = 80.0
"""m: the SICK writes 81.83 to 81.91 where nothing came back."""

BEAMS = 361

BEAM_BEARINGS = np.deg2rad(0.5 * np.arange(BEAMS)) - np.pi / 2
"""rad: beam k points at k / 2 degrees from the right; the middle one is straight ahead."""


def defaults(*, identified: bool) -> RunConfig:
    """What the car's logs start from; association by the log's ids where it has them."""
    method = (
        AssociationConfig(method="known") if identified else AssociationConfig(method="likelihood", confirm=3)
    )
    return RunConfig(motion=MOTION, sensor=SENSOR, association=method)


def ahead(bearings: np.ndarray) -> np.ndarray:
    """The files' bearings, pi / 2 straight ahead, to 0 straight ahead, rad."""
    return bearings - np.pi / 2


def returns(ranges: np.ndarray) -> np.ndarray:
    """The scanner's ranges with +inf where nothing came back, m."""
    return np.where(ranges > NO_RETURN, np.inf, ranges)
