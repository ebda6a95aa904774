"""What happens in a log: the four events that every estimator understands.

All are immutable. Arrays are float64 and C-contiguous; times are seconds on the log's own clock.
"""

from __future__ import annotations

import msgspec
import numpy as np


class Odometry(msgspec.Struct, frozen=True, gc=False):
    """One or more samples of the vehicle's own motion, the last of which ends at `time`.

    A block of samples is the same as its samples one by one, only cheaper to hand over.

    time: s, the end of the last sample.
    values: (T, c), c as the motion model wants it: speed m/s and steering rad; speed m/s and turn
        rate rad/s; or dx m, dy m, dtheta rad.
    durations: (T,) s, how long each sample holds. Zero or more.
    covariance: (T, c, c) where the log itself states the noise of each sample, else None.
    record, file: where the block's first sample stands (row from 1) and in which file, for messages.
    """

    time: float
    values: np.ndarray
    durations: np.ndarray
    covariance: np.ndarray | None = None
    record: int = 0
    file: str = ""


class Scan(msgspec.Struct, frozen=True, gc=False):
    """One sweep of a laser scanner.

    time: s. ranges: (B,) m, +inf where nothing came back. bearings: (B,) rad, 0 ahead, positive left.
    intensities: (B,) in the scanner's own units, or None.
    stamp: s, what the log itself printed, where its stamps are not in the order of the events and `time` had to be
        put right; NaN: `time` is the stamp.
    """

    time: float
    ranges: np.ndarray
    bearings: np.ndarray
    intensities: np.ndarray | None = None
    record: int = 0
    file: str = ""
    stamp: float = float("nan")


class Sightings(msgspec.Struct, frozen=True, gc=False):
    """Landmarks seen at one instant, in the sensor's frame.

    time: s.
    values: (M, 2) range m, bearing rad (0 ahead of the sensor, positive to the left).
    ids: (M,) int64 identity as the log gives it, -1 where it does not say; None if it never says.
    covariance: (M, 2, 2) of (range, bearing) where the log states it, else None.
    attributes: name -> (M,) further measurements (trunk diameter m, reflectivity, ...).
    scan: the sweep that the sightings were found in, where there is one: it tells what stood in the way.
    record, file: where the frame begins (row from 1) and in which file, for messages.
    """

    time: float
    values: np.ndarray
    ids: np.ndarray | None = None
    covariance: np.ndarray | None = None
    attributes: dict[str, np.ndarray] | None = None
    record: int = 0
    file: str = ""
    scan: Scan | None = None


class Fix(msgspec.Struct, frozen=True, gc=False):
    """A position from outside (GPS, motion capture), in the reference's own frame.

    time: s. x, y: m. heading: rad, NaN where it is not measured.
    """

    time: float
    x: float
    y: float
    heading: float = float("nan")
    record: int = 0
    file: str = ""


Event = Odometry | Sightings | Scan | Fix
