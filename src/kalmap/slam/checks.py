"""What every estimator asks of an event before it uses any of it."""

from __future__ import annotations

import math

import numpy as np

from kalmap.gaussian import NotPositiveError
from kalmap.kernels.sensing import first_bad_noise
from kalmap.models import MotionModel
from kalmap.perception import Detector
from kalmap.records import ConfigError, Event, EventError, Odometry, Scan, Sightings


def check_time(event: Event, now: float) -> None:
    """Raise EventError for an event that comes late or at no time."""
    if event.time < now:
        raise EventError(f"comes late: the filter is already at {now:.6g} s", time=event.time, field="time")
    if not math.isfinite(event.time):
        raise EventError("is not a finite number", time=event.time, field="time")


def check_odometry(event: Odometry, motion: MotionModel) -> None:
    """Raise EventError unless the samples are as the motion model wants them."""
    values = event.values
    if values.ndim != 2 or values.shape != (len(event.durations), motion.control_size):
        raise EventError(
            f"expected {len(event.durations)} samples of {motion.control_size} numbers, got {values.shape}",
            time=event.time,
            field="values",
        )
    if event.covariance is not None:
        _check_shape(event.covariance, (*values.shape, values.shape[1]), event.time)


def check_frame(frame: Sightings, moved: bool) -> None:
    """Raise EventError unless a frame comes after odometry and its arrays fit together.

    Raises NotPositiveError for a noise that is no covariance.
    """
    z = frame.values
    if not moved:
        raise EventError("a sighting before any odometry", time=frame.time, field="time")
    if z.ndim != 2 or z.shape[1] != 2:
        raise EventError(f"expected (M, 2) sightings, got {z.shape}", time=frame.time, field="values")
    if frame.ids is not None and len(frame.ids) != len(z):
        raise EventError(f"{len(frame.ids)} identities for {len(z)} sightings", time=frame.time, field="ids")
    if frame.covariance is not None:
        _check_shape(frame.covariance, (len(z), 2, 2), frame.time)
        if first_bad_noise(frame.covariance) >= 0:  # before any of the frame is used
            raise NotPositiveError("the noise of a sighting is not positive semi-definite")


def check_scan(scan: Scan) -> None:
    """Raise EventError unless a scan has a row of ranges, and as many bearings."""
    ranges, bearings = np.shape(scan.ranges), np.shape(scan.bearings)
    if len(ranges) != 1 or ranges != bearings:
        problem = f"{ranges} ranges and {bearings} bearings: expected a row of each, as long"
        raise EventError(problem, time=scan.time, field="ranges")


def check_sightings(frame: Sightings, bad: int) -> None:
    """Raise EventError for the sighting number `bad`, if that is not -1."""
    if bad >= 0:
        z = frame.values
        raise EventError(
            f"sighting {bad + 1} is {z[bad, 0]:g} m, {z[bad, 1]:g} rad: expected finite numbers and a range >= 0",
            time=frame.time,
            field="bearing" if np.isfinite(z[bad, 0]) and z[bad, 0] >= 0.0 else "range",
        )


def sighted(event: Event, detector: Detector | None) -> Sightings:
    """A frame as it is, or as it is found in a scan. Raises EventError for anything else."""
    if isinstance(event, Scan):
        if detector is None:
            raise EventError("a scan came, but the filter has no detector", time=event.time)
        return detector(event)
    if not isinstance(event, Sightings):
        raise EventError(f"{type(event).__name__} is no event that this filter knows", time=event.time)
    return event


def checked_start(start: object, covariance: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The start pose (3,) and its covariance (3, 3), zero for None. Raises ConfigError for what is neither."""
    pose = np.array(start, dtype=float)
    block = np.zeros((3, 3)) if covariance is None else np.array(covariance, dtype=float)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ConfigError("start: expected a finite pose (x, y, heading)")
    if block.shape != (3, 3) or not np.isfinite(block).all() or not np.allclose(block, block.T, atol=1e-12):
        raise ConfigError("start_covariance: expected a finite symmetric 3 x 3 matrix")
    values = np.linalg.eigvalsh(block)
    if values[0] < -1e-12 * max(1.0, float(values[-1])):
        raise ConfigError("start_covariance: is not positive semi-definite")
    return pose, block


def block_diagonal(first: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """(d, d) and (k,) -> (d + k, d + k)."""
    d = len(first)
    whole = np.zeros((d + len(variances), d + len(variances)))
    whole[:d, :d] = first
    whole[range(d, len(whole)), range(d, len(whole))] = variances
    return whole


def _check_shape(covariance: np.ndarray, shape: tuple[int, ...], time: float) -> None:
    if covariance.shape != shape:
        raise EventError(f"expected shape {shape}, got {covariance.shape}", time=time, field="covariance")
