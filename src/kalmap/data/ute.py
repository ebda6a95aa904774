"""The ACFR utility car, which recorded Victoria Park and the car park: geometry, sensor, conventions."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.records import AssociationConfig, MotionConfig, PerceptionConfig, RunConfig, SensorConfig
from kalmap.records.config import DetectorName

MOUNT = (3.78, 0.5)
"""m: the laser and the GPS antenna in the rear axle's frame (forward, left)."""

MOUNT_HEADING_DEG = -0.5
"""deg: where the laser's straight ahead points, seen from the way that the car goes.

Nobody measured it; the files' bearings do not agree with the driven way, in either log of this car. Estimated
as a state (`course_offset`) it comes out as 0.3 deg in the car park and 1.1 deg in Victoria Park; one beam is
0.5 deg.
"""

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
    mount_heading_deg=MOUNT_HEADING_DEG,
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


TREES = AssociationConfig(method="likelihood", management="trial", confirm=6, confirm_window=30, extent=0.2)
"""Trunks, up to a metre thick, whose centres look different from different sides, among bushes and parked cars: a
landmark must be seen for more than a second. Whether a tree is seen depends on the side it is seen from for
seconds on end, so that a counter of misses would remove real ones; none is used."""

POLES = AssociationConfig(method="likelihood", management="trial", confirm=3, confirm_window=30, extent=0.05)
"""Reflective poles, 6 cm thick; a reflector is rarely anything else."""


def defaults(association: AssociationConfig, detector: DetectorName, *, identified: bool) -> RunConfig:
    """What the car's logs start from; association by the log's ids where it has them."""
    if identified:
        association = msgspec.structs.replace(association, method="known")
    return RunConfig(
        motion=MOTION,
        sensor=SENSOR,
        association=association,
        perception=PerceptionConfig(detector=detector),
    )


def ahead(bearings: np.ndarray) -> np.ndarray:
    """The files' bearings, pi / 2 straight ahead, to 0 straight ahead, rad."""
    return bearings - np.pi / 2


def returns(ranges: np.ndarray) -> np.ndarray:
    """The scanner's ranges with +inf where nothing came back, m."""
    return np.where(ranges > NO_RETURN, np.inf, ranges)
