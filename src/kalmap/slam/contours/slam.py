"""Mapping from raw scans: the sampled environment map of Sun et al. 2010, whole or divided, as a `Slam`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from kalmap.gaussian import Jacobian, Lineariser, NotPositiveError
from kalmap.models import Increments, RangeBearing
from kalmap.models.motion import BuiltInMotion
from kalmap.records import (
    ConfigError,
    ContourConfig,
    Estimate,
    EstimationError,
    Event,
    EventError,
    Frame,
    JointTooLargeError,
    Landmarks,
    Odometry,
    Scan,
    SensorConfig,
    Sightings,
    Sweeps,
)
from kalmap.slam.checks import check_odometry, check_scan, check_time, checked_start
from kalmap.slam.contours import wheels
from kalmap.slam.contours.closed import ENOUGH
from kalmap.slam.contours.held import holding
from kalmap.slam.contours.late import Clock, Late
from kalmap.slam.contours.leg import Leg, OpenLeg, composed
from kalmap.slam.contours.live import PUNCTUAL, LiveMap
from kalmap.slam.contours.loops import FLOOR, Loops
from kalmap.slam.contours.seen import LATENCY_BIAS, Rules, later, prepare, rules_of
from kalmap.slam.contours.whole import whole_contours, whole_sweeps, whole_trajectory
from kalmap.slam.contours.witness import Witness
from kalmap.slam.contours.worker import Joined, Placed, Worker, closed, relaid
from kalmap.slam.engines import BadSampleError
from kalmap.slam.window import Revisions


class ContourSlam:
    """A drive's pose and the contours around it, from odometry and raw scans; no landmarks, no identities.

    motion: any built-in model without biases. sensor: the scanner's mounting, ranges and noise. settings: see
    `ContourConfig`; its method "slasem" keeps one map, "dc-slasem" closes local maps and finds their loops. lineariser,
    coordinates: as in `LandmarkSlam`. start, start_covariance: (3,) pose and its (3, 3).

    An event that cannot be used raises EventError and leaves the state as it was.
    """

    explain = False
    labels = False
    frame_decision: Frame | None = None
    attribute_names: tuple[str, ...] = ()
    association_seconds = 0.0
    numbers_per_sighting = 1  # a sample's signed distance

    def __init__(
        self,
        motion: BuiltInMotion | None = None,
        sensor: SensorConfig | None = None,
        settings: ContourConfig | None = None,
        lineariser: Lineariser | None = None,
        coordinates: str = "invariant",
        *,
        start: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
        start_covariance: np.ndarray | None = None,
    ) -> None:
        self.motion = Increments() if motion is None else motion
        self.scanner = SensorConfig(sigma_range=0.02) if sensor is None else sensor
        self.settings = ContourConfig(method="dc-slasem") if settings is None else settings
        self.lineariser = Jacobian() if lineariser is None else lineariser
        self.coordinates = coordinates
        if self.motion.biases:
            raise ConfigError("motion.biases: mapping from scans estimates no errors of the odometry")
        if coordinates not in ("invariant", "additive"):
            raise ConfigError(f"filter.coordinates: expected invariant or additive, got {coordinates!r}")
        if not hasattr(self.lineariser, "rule"):
            raise ConfigError("filter.name: mapping from scans takes one of the built-in linearisers")
        self.rules: Rules = rules_of(self.motion, self.lineariser, coordinates, self.scanner, self.settings)
        self.sensor = RangeBearing()
        self._start, self._start_covariance = checked_start(start, start_covariance)
        self._live = LiveMap(self.rules)
        self._leg = OpenLeg()
        self._ends: list[tuple[np.ndarray, np.ndarray]] = []  # of the closed maps
        self._worker = Worker(Joined(Loops(), []), self.settings.background)
        self._time = float("-inf")
        self._moved = False
        self._way, self._turn = 0.0, 0.0  # since the last scan that was used
        self._clock = Clock(self.motion)
        self._twist = np.zeros(3)  # m/s, m/s, rad/s of the vehicle, where the last scan was taken
        self._changes = self._frames = 0
        self._estimate: tuple[int, Estimate] | None = None
        self._framed: tuple[Placed, int, np.ndarray, np.ndarray] | None = (
            None  # what was last told, to tell it again
        )
        self._told: tuple[int, np.ndarray, np.ndarray, np.ndarray] | None = None
        self.frame_nis, self.frame_used = float("nan"), 0
        self.frame_labels = np.zeros(0, dtype=np.int64)
        self.frame_sightings: Sightings | None = None
        self.frame_revisions: Revisions = {}

    # --- the filter -------------------------------------------------------------------------------------------

    def step(self, event: Event) -> None:
        """Take one event: odometry predicts, a scan corrects if the vehicle has moved enough; nothing else is used."""
        check_time(event, self._time)
        if isinstance(event, Odometry):
            self._predict(event)
        elif isinstance(event, Scan):
            self._observe(event)
        elif isinstance(event, Sightings):
            raise EventError("is of landmarks, and the map is of contours", time=event.time, field="values")
        self._time = event.time
        self._changes += 1

    def _predict(self, event: Odometry) -> None:
        check_odometry(event, self.motion)
        try:
            if self._timed:
                self._move(*self._clock.shifted(event, self._latency))
            else:
                self._move(event)
        except BadSampleError as problem:
            raise EventError(str(problem), time=event.time, field="values") from problem
        except NotPositiveError as problem:
            raise EstimationError(f"t = {event.time:.6g} s: {problem}") from problem
        self._moved = True

    def _move(self, event: Odometry, effect: np.ndarray = PUNCTUAL, late: Late | None = None) -> None:
        """Predict by odometry of the scans' time; late: what is known of the odometry then."""
        before = self._live.pose
        self._live.predict(event, effect)
        after = self._live.pose
        self._way += float(np.hypot(*(after[:2] - before[:2])))
        self._turn += abs(math.remainder(after[2] - before[2], 2.0 * math.pi))
        self._clock.late = late or self._clock.late

    @property
    def _timed(self) -> bool:
        """Whether it matters when something was, and not only in which order."""
        return bool(self.scanner.beam_time or self.settings.sigma_latency or self.settings.sigma_stamp)

    @property
    def _latency(self) -> float:
        return float(self._live.calibration.mean[4])

    def _observe(self, scan: Scan) -> None:
        if not self._moved:
            raise EventError("a scan before any odometry", time=scan.time, field="time")
        check_scan(scan)
        self._catch_up(scan)
        used = not self._live.scans or self._far_enough()
        self.frame_nis, self.frame_used = float("nan"), 0
        if used:
            self._use(scan)
        self._leg.append(scan, self._live.pose, self._live.pose_covariance, self._twist)
        self.frame_sightings = Sightings(
            scan.time, np.zeros((self.frame_used, 2)), record=scan.record, file=scan.file
        )
        self._frames += 1
        if used and self._full():
            self._close(scan)

    def _catch_up(self, scan: Scan) -> None:
        """Go on to where the scan was taken, if that is after the odometry, and see how fast the vehicle went there."""
        if not self._timed:
            return
        further = self._clock.up_to(scan.time, self._latency)
        if further is not None:
            self._move(*further)
        late = self._clock.late
        twist = late.twist(late.told - self._latency, self.scanner.beam_time * len(scan.ranges))
        self._twist = twist * self._live.scales

    def _use(self, scan: Scan) -> None:
        """Correct the local map by a scan."""
        seen = prepare(scan, self.rules, self._live.calibration.mean, self._twist)
        driven = self._live.driven
        try:
            self._live.observe(seen, self.settings.sigma_stamp * self._twist)
        except NotPositiveError as problem:
            raise EstimationError(f"t = {scan.time:.6g} s: {problem}") from problem
        self._leg.driven += driven
        self._way = self._turn = 0.0
        self.frame_nis, self.frame_used = self._live.nis, self._live.used

    def _far_enough(self) -> bool:
        settings = self.settings
        return self._way >= settings.update_distance or self._turn >= math.radians(settings.update_angle_deg)

    def _full(self) -> bool:
        if self.settings.method == "slasem":
            return False
        return (
            self._live.count >= self.settings.close_samples
            or self._live.length >= self.settings.close_distance
        )

    def _close(self, scan: Scan) -> None:
        """Close the local map, and start the next one where the vehicle is, with the scan at hand."""
        live = self._live
        self._worker.close(live, self._leg.leg())
        self._ends.append((live.pose, live.end_covariance))
        self._live = LiveMap(self.rules, later(live.calibration), live.noise, live.earlier + 1)
        self._leg = OpenLeg()
        seen = prepare(scan, self.rules, live.calibration.mean, self._twist)
        self._live.observe(seen, self.settings.sigma_stamp * self._twist)

    # --- what it says -----------------------------------------------------------------------------------------

    def _frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the local map's frame is now, and its covariance, by the newest map that has been joined."""
        placed = self._worker.placed
        if self._framed is None or self._framed[0] is not placed or self._framed[1] != len(self._ends):
            pose, covariance = composed(self._start, self._start_covariance, placed.pose, placed.covariance)
            for end, spread in self._ends[max(0, placed.count - 1) :]:
                pose, covariance = composed(pose, covariance, end, placed.scale * (spread + FLOOR))
            self._framed = placed, len(self._ends), pose, covariance
        return self._framed[2], self._framed[3]

    def _now(self) -> tuple[np.ndarray, np.ndarray]:
        """The pose in the newest joined frame, and its covariance."""
        frame, spread = self._frame()
        if self._told is None or self._told[0] != self._changes or self._told[1] is not frame:
            there = composed(frame, spread, self._live.pose, self._live.pose_covariance)
            self._told = self._changes, frame, *there
        return self._told[2], self._told[3]

    @property
    def time(self) -> float:
        """Time of the last event, s; -inf before the first."""
        return self._time

    @property
    def pose(self) -> np.ndarray:
        """(3,) x m, y m, heading rad, in the newest joined frame; a copy.

        With a latency it is where the vehicle was so long ago, and so are all poses at the stamps of their scans.
        """
        return self._now()[0].copy()

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3); a copy."""
        return self._now()[1].copy()

    @property
    def landmark_count(self) -> int:
        """How many samples the local map holds."""
        return self._live.count

    @property
    def frames_taken(self) -> int:
        """How many scans came."""
        return self._frames

    def estimate(self) -> Estimate:
        """A snapshot with everything joined that has been closed, and the local map behind it. Waits for the joins."""
        if self._estimate is None or self._estimate[0] != self._changes:
            self._estimate = self._changes, self._whole()
        return self._estimate[1]

    def _whole(self) -> Estimate:
        joined = self._worker.settled()
        loops, legs = joined.loops.copy(), list(joined.legs)
        if self._live.scans:
            legs.append(relaid(self._live, self._leg.leg()))
        witness = Witness(legs, self.rules)
        if joined.witness is not None:
            witness.adopt(joined.witness)
        if self._live.scans:
            loops.close(closed(self._live), witness)
        loops.finish(witness)
        frames, covariances = self._placed(loops)
        trajectory = whole_trajectory(legs, frames, covariances)
        frame, spread = (
            (frames[-1], covariances[-1]) if len(frames) else (self._start, self._start_covariance)
        )
        pose, covariance = composed(frame, spread, self._live.pose, self._live.pose_covariance)
        contours = whole_contours(loops.maps, frames, covariances, self.settings.spacing, self._enough())
        rules, calibration = self.rules, self._live.calibration.mean

        @cache  # the map is judged by them, and the grid drawn
        def sweeps() -> Sweeps:
            return whole_sweeps(legs, frames, rules, calibration)

        def joint() -> tuple[np.ndarray, np.ndarray]:
            raise JointTooLargeError("contours of several local maps have covariances of their own only")

        return Estimate(
            time=self._time, pose=pose, covariance=covariance, landmarks=_no_landmarks(), biases={}, joint=joint,
            coordinates=self.coordinates, contours=contours, trajectory=trajectory,
            sweeps=sweeps,
            counts=self._counts(loops, legs) | holding(legs, frames),
        )  # fmt: skip

    def _enough(self) -> int:
        """Scans that must have seen a sample that is told of: one, where no more than one was used."""
        return ENOUGH if self._ends or self._live.scans > 1 else 1

    def _placed(self, loops: Loops) -> tuple[np.ndarray, np.ndarray]:
        """Frames (n, 3) of all local maps and their covariances (n, 3, 3)."""
        count = len(loops.maps)
        own = loops.own_covariances()[:count]
        return composed(self._start, self._start_covariance, loops.graph.frames[:count], own)

    def _counts(self, loops: Loops, legs: Sequence[Leg]) -> dict[str, float]:
        calibration = self._live.calibration
        deviations = np.sqrt(np.diagonal(calibration.covariance))
        latency = math.hypot(deviations[4], LATENCY_BIAS) if deviations[4] else 0.0
        way, turn = np.where(deviations[5:] > 0.0, np.hypot(deviations[5:], wheels.BIAS), 0.0)
        return {
            "local_maps": sum(
                len(leg.scans) > 0 for leg in legs
            ),  # none of its own in one that was just begun
            "loops": sum(relation.loop for relation in loops.graph.relations),
            "loops_open": len(loops.open),
            "covariance_scale": loops.told_scale,
            "bearing_scale": float(calibration.mean[0]),
            "bearing_scale_sigma": float(deviations[0]),
            "range_offset_m": float(calibration.mean[1]),
            "range_offset_sigma_m": float(deviations[1]),
            "lever_x_m": float(calibration.mean[2]),
            "lever_x_sigma_m": float(deviations[2]),
            "lever_y_m": float(calibration.mean[3]),
            "lever_y_sigma_m": float(deviations[3]),
            "way_scale": float(calibration.mean[5]),
            "way_scale_sigma": float(way),
            "turn_scale": float(calibration.mean[6]),
            "turn_scale_sigma": float(turn),
            "scan_noise_factor": self._live.noise,
            "latency_s": float(calibration.mean[4]),
            "latency_sigma_s": latency,
        }

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """Contours have no labels."""
        return labels

    def twin(self) -> ContourSlam:
        """A fresh estimator with the same settings, at the origin."""
        return ContourSlam(self.motion, self.scanner, self.settings, self.lineariser, self.coordinates)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that is known, so that `load` goes on bit for bit. Waits for the joins."""
        from kalmap.slam.contours.checkpoint import save_contours

        save_contours(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], **_: Any) -> ContourSlam:
        """The estimator that `save` wrote. Raises LogError if the file is not one of these or is damaged."""
        from kalmap.slam.contours.checkpoint import load_contours

        return load_contours(cls, path)


def _no_landmarks() -> Landmarks:
    return Landmarks(
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
    )
