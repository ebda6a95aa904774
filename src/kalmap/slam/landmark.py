"""Landmark SLAM by the Kalman family: one filter, whatever the lineariser, scope and error coordinates."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from kalmap.association import Associator, KnownIds, Mda
from kalmap.gaussian import Belief, CentralDifference, Lineariser, NotPositiveError
from kalmap.models import MotionModel, RangeBearing, SensorModel, VelocitySteering
from kalmap.perception import Detector
from kalmap.records import (
    Association,
    ConfigError,
    Estimate,
    EstimationError,
    Event,
    EventError,
    Fix,
    Frame,
    Landmarks,
    Odometry,
    Sightings,
)
from kalmap.slam.checkpoint import load_filter, save_filter
from kalmap.slam.checks import (
    block_diagonal,
    check_frame,
    check_odometry,
    check_sightings,
    check_time,
    checked_start,
    sighted,
)
from kalmap.slam.engines import BadSampleError, CompiledEngine, Engine, GeneralEngine
from kalmap.slam.map_state import MapState
from kalmap.slam.predicted import PredictedMap
from kalmap.slam.window import Revisions, Window


class LandmarkSlam(MapState):
    """EKF, UKF, CDKF or CKF SLAM, O(n^2) or O(n^3), in additive or right-invariant error coordinates.

    motion, sensor: models. lineariser: `Jacobian()`, `Unscented()`, `CentralDifference()`, `Cubature()` or any
    object of that protocol. association: an `Associator`. detector: turns scans into sightings, if scans come.
    scope: "reduced" hands only what a function reads to the lineariser (Chen & Cheng 2012), "full" the whole
    state. coordinates: "invariant" or "additive". use: "joint" or "sequential" use of a frame's sightings.
    start, start_covariance: (3,) pose and its (3, 3), zero for a known start.

    An event that cannot be used raises EventError and leaves the state as it was; a covariance that is no longer
    positive definite raises EstimationError with the step's number.
    """

    numbers_per_sighting = 2  # range and bearing

    def __init__(
        self,
        motion: MotionModel | None = None,
        sensor: SensorModel | None = None,
        lineariser: Lineariser | None = None,
        association: Associator | None = None,
        *,
        scope: str = "reduced",
        coordinates: str = "invariant",
        use: str = "joint",
        start: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
        start_covariance: np.ndarray | None = None,
        detector: Detector | None = None,
    ) -> None:
        self.motion = VelocitySteering() if motion is None else motion
        self.sensor = RangeBearing() if sensor is None else sensor
        self.lineariser = CentralDifference() if lineariser is None else lineariser
        self.detector = detector
        self.scope, self.coordinates, self.use = scope, coordinates, use
        pose, covariance = checked_start(start, start_covariance)
        biases = self.motion.biases
        belief = Belief(
            np.concatenate([pose, [bias.mean for bias in biases]]),
            block_diagonal(covariance, np.array([bias.sigma**2 for bias in biases])),
        )
        super().__init__(self._make_engine(), belief, KnownIds() if association is None else association)
        self._window = Window(self) if isinstance(self.association, Mda) else None
        self.frame_revisions: Revisions = {}
        self._time = float("-inf")
        self._moved = False
        self.step_number = 0
        self._changes = 0  # events taken, so that a snapshot knows whether it is still current
        self.frame_nis, self.frame_used = float("nan"), 0
        self.frame_association = Association(np.zeros(0, dtype=np.int64))
        self.frame_labels = np.zeros(0, dtype=np.int64)
        self.frame_sightings: Sightings | None = None
        self.labels = not self.association.uses_ids
        self.explain = False
        self.frame_decision: Frame | None = None
        self.association_seconds = 0.0

    def _make_engine(self) -> Engine:
        for name, value, known in (
            ("scope", self.scope, ("reduced", "full")),
            ("coordinates", self.coordinates, ("invariant", "additive")),
            ("use", self.use, ("joint", "sequential")),
        ):
            if value not in known:
                raise ConfigError(f"{name}: {value!r} is none of {', '.join(known)}")
        full, invariant, sequential = (
            self.scope == "full",
            self.coordinates == "invariant",
            self.use == "sequential",
        )
        if full and not getattr(self.lineariser, "samples", True):
            raise ConfigError(
                "scope: a Jacobian draws no points, so 'full' would be the same filter: take 'reduced'"
            )
        built_in = getattr(self.motion, "compiled", False) and getattr(self.sensor, "compiled", False)
        if built_in and not full and hasattr(self.lineariser, "rule"):
            return CompiledEngine(self.motion, self.sensor, self.lineariser, invariant, sequential)  # type: ignore[arg-type]
        return GeneralEngine(self.motion, self.sensor, self.lineariser, invariant, sequential, full)

    # --- the filter -------------------------------------------------------------------------------------------

    def step(self, event: Event) -> None:
        """Take one event: odometry predicts, sightings and scans correct, a fix from outside is not used."""
        check_time(event, self._time)
        try:
            if isinstance(event, Odometry):
                self._predict(event)
            elif not isinstance(event, Fix):
                self._observe(sighted(event, self.detector))
        except NotPositiveError as problem:
            raise EstimationError(f"step {self.step_number}, t = {event.time:.6g} s: {problem}") from problem
        self.took(event.time)

    def took(self, time: float) -> None:
        """Note that an event of that time has been taken."""
        self._time = time
        self._changes += 1

    def _predict(self, event: Odometry) -> None:
        check_odometry(event, self.motion)
        try:
            self._engine.predict(self._belief, event)
        except BadSampleError as problem:
            raise EventError(str(problem), time=event.time, field="values") from problem
        if self._window is not None:
            self._window.moved(event)
        self.step_number += len(event.values)
        self._moved = True

    def noises_of(self, frame: Sightings) -> np.ndarray:
        """(M, 2, 2) of a frame. Raises EventError or NotPositiveError if it cannot be used."""
        check_frame(frame, self._moved)
        noises, bad = self._engine.noises(frame.values)
        check_sightings(frame, bad)
        return noises if frame.covariance is None else frame.covariance

    def _observe(self, frame: Sightings) -> None:
        """One frame: associate, update, found new landmarks, retire spurious ones."""
        noises = self.noises_of(frame)
        begin = time.perf_counter()
        if self._window is None:
            association = self.association.associate(self._memory, frame, self.predicted(frame, noises))
        else:
            association, self.frame_revisions = self._window.decide(frame, noises)
        self.association_seconds += time.perf_counter() - begin
        self.take_decided(frame, noises, association)
        if self._window is not None:
            self._window.keep()

    def predicted(self, frame: Sightings, noises: np.ndarray) -> PredictedMap:
        """The map as it should look at a frame that has come now."""
        return PredictedMap(self._engine, self._belief, self.sensor, self._index, frame, noises, self.explain)

    def take_decided(self, frame: Sightings, noises: np.ndarray, association: Association) -> None:
        """Carry out what was decided about a frame: update, found, confirm, merge, remove."""
        before = None
        if association.why is not None:
            before = self.predicted(frame, noises).look(association.why, self._ids)
        self.frame_nis, self.frame_used = self._apply(frame, noises, association)
        self.frame_association, self.frame_sightings = association, frame
        self._settle(association)
        if not self.association.uses_ids:
            self.frame_labels = self._labels_of(association.matched)
        self.frame_decision = (
            None if before is None else self._decision(association, self.frame_labels, before)
        )
        self._tidy(association)

    def twin(self) -> LandmarkSlam:
        """A fresh filter with the same settings, at the origin."""
        return LandmarkSlam(
            self.motion,
            self.sensor,
            self.lineariser,
            self.association,
            scope=self.scope,
            coordinates=self.coordinates,
            use=self.use,
        )

    def successor(self) -> LandmarkSlam:
        """A fresh filter at the origin, with no map, that goes on in time and in numbers where this one is.

        What is known of the vehicle's constant errors it knows too.
        """
        slam, robot = self.twin(), self._belief.robot
        known = np.zeros((robot, robot))
        known[3:, 3:] = self._belief.robot_covariance()[3:, 3:]
        slam._belief = Belief(np.concatenate([np.zeros(3), self._belief.mean[3:robot]]), known)
        slam.detector, slam.explain, slam.association_seconds = (
            self.detector,
            self.explain,
            self.association_seconds,
        )
        slam._time, slam._moved, slam.step_number = self._time, self._moved, self.step_number
        slam._frames, slam._founded = self._frames, self._founded
        slam.frame_nis, slam.frame_used = self.frame_nis, self.frame_used
        slam.frame_association, slam.frame_decision = self.frame_association, self.frame_decision
        slam.frame_labels, slam.frame_sightings = self.frame_labels, self.frame_sightings
        return slam

    def confirmed_map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Mean (3 + 2 N,) and joint covariance of pose and confirmed landmarks; their ids and sightings, (N,)."""
        kept = self._confirmed()
        entries = np.concatenate(
            [np.arange(3), (self._belief.robot + 2 * kept[:, None] + np.arange(2)).ravel()]
        )
        self._belief.flush()
        ids, counts = np.array(self._ids, dtype=np.int64), np.array(self._counts, dtype=np.int64)
        return self._belief.mean[entries], self._belief.block(entries), ids[kept], counts[kept]

    def _confirmed(self) -> np.ndarray:
        """Indices of the landmarks that are not on trial."""
        return np.array(
            [i for i, number in enumerate(self._ids) if number not in self._on_trial], dtype=np.int64
        )

    def copy(self) -> LandmarkSlam:
        """A filter of its own in the same state: O(n^2)."""
        twin = self.twin()
        twin.detector, twin.explain = self.detector, self.explain
        twin.restore(self.snapshot())
        twin._time, twin._moved, twin._changes = self._time, self._moved, self._changes
        twin.step_number = self.step_number
        return twin

    @property
    def memory(self) -> Any:
        """What the associator remembers."""
        return self._memory

    @property
    def attribute_names(self) -> tuple[str, ...]:
        """Which attributes of sightings its association reads."""
        return tuple(each.name for each in getattr(self.association, "attributes", ()))

    # --- saving -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that the filter knows, so that `load` goes on bit for bit. Built-in parts only."""
        save_filter(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, detector: Detector | None = None) -> LandmarkSlam:
        """The filter that `save` wrote. Raises LogError if the file is not one of these or is damaged."""
        return load_filter(cls, path, detector)

    # --- what it says -----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the last event, s; -inf before the first."""
        return self._time

    @property
    def pose(self) -> np.ndarray:
        """(3,) x m, y m, heading rad; a copy."""
        return self._belief.mean[:3].copy()

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3); a copy."""
        return self._belief.robot_covariance()[:3, :3]

    def _existence(self) -> np.ndarray:
        """(N,) of all landmarks, as the associator has it."""
        known = getattr(self.association, "existence", None)
        return np.ones(len(self._ids)) if known is None else np.array(known(self._memory), dtype=float)

    @property
    def frames_taken(self) -> int:
        """How many frames of sightings were taken."""
        return self._frames

    @property
    def landmark_count(self) -> int:
        """How many confirmed landmarks the map holds."""
        return len(self._ids) - len(self._on_trial)

    def estimate(self) -> Estimate:
        """A snapshot of everything but the joint covariance, which it computes when asked in time.

        Landmarks on trial are left out: marginalised, which changes nothing else.
        """
        belief = self._belief
        belief.flush()
        robot, n, stamp = belief.robot, belief.n, self._changes
        covariance = belief.robot_covariance()
        kept = self._confirmed()
        landmarks = Landmarks(
            ids=np.array(self._ids, dtype=np.int64)[kept],
            positions=belief.mean[robot:n].reshape(-1, 2)[kept],
            covariances=belief.landmark_covariances()[kept],
            sightings=np.array(self._counts, dtype=np.int64)[kept],
            existence=self._existence()[kept],
        )
        entries = np.concatenate([np.arange(robot), (robot + 2 * kept[:, None] + np.arange(2)).ravel()])

        def joint() -> tuple[np.ndarray, np.ndarray]:
            if stamp != self._changes:
                raise EstimationError("the filter has moved on: ask the joint covariance of a fresh estimate")
            return belief.mean[entries], belief.covariance()[np.ix_(entries, entries)]

        biases = {
            bias.name: (float(belief.mean[3 + i]), float(np.sqrt(covariance[3 + i, 3 + i])))
            for i, bias in enumerate(self.motion.biases)
        }
        return Estimate(
            time=self._time,
            pose=self.pose,
            covariance=covariance[:3, :3].copy(),
            landmarks=landmarks,
            biases=biases,
            joint=joint,
            coordinates=self.coordinates,
        )
