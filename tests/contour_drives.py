"""Simulated floors driven through live local maps of contours, for their tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from kalmap.gaussian import Jacobian
from kalmap.geometry.se2 import compose, inverse
from kalmap.models.motion import motion_from_config
from kalmap.records import Log, Odometry, Scan
from kalmap.simulate.floor_run import simulate_floor
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.live import LiveMap, Rules, prepare, rules_of

SICK = {"scanner": "sick", "max_range": 80.0, "sigma_beam_ratio": 0.0, "quantum": 0.01, "speed": 0.5}
"""Overrides that put a SICK on a floor."""


def rules_for(log: Log, lineariser=None, coordinates="additive", **contour) -> Rules:
    """The rules of a log's own settings; contour: fields of `ContourConfig` to be changed."""
    config = log.defaults
    settings = msgspec.structs.replace(config.contour, **contour)
    motion = motion_from_config(config.motion)
    return rules_of(motion, lineariser or Jacobian(), coordinates, config.sensor, settings)


def used_scans(
    log: Log, rules: Rules, change: Callable[[Scan], Scan] | None = None
) -> Iterator[tuple[list[Odometry], Scan, np.ndarray]]:
    """The scans that are used, as the robot has moved far enough: the odometry before each, and the true pose (3,)."""
    truth, row = log.references[0], 0
    waiting, moved, first = [], np.zeros(3), True
    settings = rules.contour
    for event in log:
        if isinstance(event, Odometry):
            waiting.append(event)
            moved = compose(moved, event.values[0])
            continue
        pose = np.array([*truth.positions[row], truth.headings[row]])
        row += 1
        far = math.hypot(moved[0], moved[1]) >= settings.update_distance
        if first or far or abs(moved[2]) >= math.radians(settings.update_angle_deg):
            yield waiting, event if change is None else change(event), pose
            waiting, moved, first = [], np.zeros(3), False


def closed_of(live: LiveMap) -> ClosedMap:
    """A live map as it would be closed: without the scanner's calibration."""
    live.belief.flush()
    keep = np.r_[0:3, 5 : live.belief.n]
    covariance = live.belief.covariance()[np.ix_(keep, keep)]
    return ClosedMap(
        live.belief.mean[keep],
        covariance,
        live.normals.copy(),
        live.sightings.copy(),
        live.rules.contour.spacing,
    )


class Driven(msgspec.Struct):
    """What a drive left behind.

    live: the last map. maps: the closed ones; starts: (n, 3) their true frames. errors: (T, 3) of the pose in its own
    map's frame, covariances (T, 3, 3).
    """

    live: LiveMap
    maps: list[ClosedMap]
    starts: list[np.ndarray]
    errors: np.ndarray
    covariances: np.ndarray
    calibrations: list[np.ndarray]


def drive(
    log: Log,
    rules: Rules,
    *,
    change: Callable[[Scan], Scan] | None = None,
    most: int = 10**9,
    close: bool = True,
    on_closed: Callable[[ClosedMap], None] | None = None,
    jump: tuple[int, np.ndarray] | None = None,
    carry: bool = True,
) -> Driven:
    """Drive a log through local maps. most: scans used. jump: after so many scans an odometry step that never was."""
    live, start = LiveMap(rules), np.zeros(3)
    driven = Driven(live, [], [start], np.zeros((0, 3)), np.zeros((0, 3, 3)), [])
    errors, covariances, scans = [], [], 0
    for events, scan, truth in used_scans(log, rules, change):
        if scans == most:
            break
        if close and (
            live.count >= rules.contour.close_samples or live.length >= rules.contour.close_distance
        ):
            closed = closed_of(live)
            driven.maps.append(closed)
            start = before
            driven.starts.append(start)
            live = LiveMap(rules, live.calibration if carry else None)
            live.observe(prepare(last, rules, live.calibration.mean))
            if on_closed is not None:
                on_closed(closed)
        for event in events:
            live.predict(event)
        if jump is not None and jump[0] == scans:
            live.predict(Odometry(scan.time, jump[1][None], np.array([0.2])))
        live.observe(prepare(scan, rules, live.calibration.mean))
        before, last = truth, scan
        error = live.pose - compose(inverse(start), truth)
        error[2] = (error[2] + math.pi) % (2 * math.pi) - math.pi
        errors.append(error)
        covariances.append(live.belief.robot_covariance()[:3, :3])
        scans += 1
    driven.live, driven.errors, driven.covariances = live, np.array(errors), np.array(covariances)
    return driven


def drifted(scan: Scan, scale: float, offset: float) -> Scan:
    """A scan as a scanner would report it whose bearings are `scale` too wide and whose ranges `offset` m too long."""
    return msgspec.structs.replace(
        scan, bearings=scan.bearings * (1.0 + scale), ranges=np.asarray(scan.ranges) + offset
    )


def simulated(world, seed: int) -> Log:
    """A floor driven once."""
    return simulate_floor(world, seed)
