"""Simulated floors driven through live local maps of contours, for their tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from kalmap.gaussian import Jacobian
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels import contour_state as state
from kalmap.models.motion import motion_from_config
from kalmap.records import Log, Odometry, Scan
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.live import LiveMap
from kalmap.slam.contours.seen import Rules, prepare, rules_of

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
    keep = np.r_[0:3, state.SAMPLES : live.belief.n]
    covariance = live.belief.covariance()[np.ix_(keep, keep)]
    return ClosedMap(
        live.belief.mean[keep],
        covariance,
        live.normals.copy(),
        live.sightings.copy(),
        live.rules.contour.spacing,
    )


class Drive:
    """A log driven through local maps.

    live: the last map; maps: the closed ones. starts: their true frames (3,). errors, covariances: of the pose in its
    own map's frame, after every scan. jump: after how many scans the odometry says a step (3,) that never was.
    frame: (3,) on the robot, of what is estimated.
    """

    def __init__(
        self,
        log: Log,
        rules: Rules,
        *,
        change=None,
        most=10**9,
        close=True,
        on_closed=None,
        jump=None,
        frame=(0.0, 0.0, 0.0),
    ):
        self.rules, self.close, self.on_closed = rules, close, on_closed
        self.live, self.starts = LiveMap(rules), [np.array(frame, dtype=float)]
        self.maps: list[ClosedMap] = []
        errors, covariances = [], []
        last, before = None, None
        for number, (moves, scan, truth) in enumerate(used_scans(log, rules, change)):
            truth = compose(truth, np.asarray(frame))
            if number == most:
                break
            if number:
                self._close_if_full(last, before)
            for event in moves:
                self.live.predict(event)
            if jump is not None and jump[0] == number:
                self.live.predict(Odometry(scan.time, jump[1][None], np.array([0.2])))
            self.live.observe(prepare(scan, rules, self.live.calibration.mean, np.zeros(3)))
            last, before = scan, truth
            error = self.live.pose - compose(inverse(self.starts[-1]), truth)
            errors.append([error[0], error[1], wrap(error[2])])
            covariances.append(self.live.belief.robot_covariance()[:3, :3])
        self.errors, self.covariances = np.array(errors), np.array(covariances)

    def _close_if_full(self, last: Scan, truth: np.ndarray) -> None:
        """Close the map, and begin the next one with the scan that was the last."""
        live, settings = self.live, self.rules.contour
        if not self.close or (live.count < settings.close_samples and live.length < settings.close_distance):
            return
        closed = closed_of(live)
        self.maps.append(closed)
        self.starts.append(truth)
        self.live = LiveMap(self.rules, live.calibration, live.noise)
        self.live.observe(prepare(last, self.rules, live.calibration.mean, np.zeros(3)))
        if self.on_closed is not None:
            self.on_closed(closed)

    def nees(self) -> np.ndarray:
        """(T,) of the poses, from the scan on at which their covariance has full rank."""
        full = np.linalg.eigvalsh(self.covariances)[:, 0] > 1e-12
        return np.einsum(
            "ti,tij,tj->t", self.errors[full], np.linalg.inv(self.covariances[full]), self.errors[full]
        )


def drifted(scan: Scan, scale: float, offset: float) -> Scan:
    """A scan as a scanner would report it whose bearings are `scale` too wide and whose ranges `offset` m too long."""
    return msgspec.structs.replace(
        scan, bearings=scan.bearings * (1.0 + scale), ranges=np.asarray(scan.ranges) + offset
    )
