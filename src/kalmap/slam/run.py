"""The run loop: a log through a filter, with everything kept that a result needs, whatever happens."""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec
import numpy as np

from kalmap.gaussian import Jacobian
from kalmap.models.motion import BuiltInMotion
from kalmap.records import (
    Estimate,
    EventError,
    Frame,
    KalmapError,
    Log,
    LogError,
    Odometry,
    Scan,
    Sightings,
    Skipped,
    Trace,
)
from kalmap.slam.contours.rehearsal import rehearse
from kalmap.slam.contours.slam import ContourSlam
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.map_course import CourseKeeper, MapCourse
from kalmap.slam.protocol import Slam

KEPT_SKIPS = 1000  # records listed one by one; the rest is counted


class Outcome(msgspec.Struct, frozen=True):
    """What a run came to, also if it was interrupted or met an error: then up to that point.

    frames: how many frames of sightings came; sightings: how many sightings they held; runtime: s inside the filter.
    labels: for each sighting the landmark that it belongs to in the end (SPURIOUS: none): mergers followed, landmarks
    never confirmed left out; labels_at_once: as it was decided in its frame (or window);
    truth_ids: the identity that the log gives it, -1 where a frame has none; times (K,) s and values (K, 2) of the
    sightings themselves. All four are empty where association was given, truth_ids also where the log has none.
    association_seconds: s of the runtime spent in the association. decisions: the audit trail, one entry a frame, if
    it was asked for. dead_reckoning: times (K,) and poses (K, 3) of odometry alone, if asked for. course: of the map,
    where it is a random finite set. recovered: how often all particles had lost all weight, None without particles.
    """

    estimate: Estimate
    trace: Trace
    frames: int
    sightings: int
    runtime: float
    skipped: list[Skipped]
    skipped_total: int
    truth_ids: np.ndarray
    labels: np.ndarray
    labels_at_once: np.ndarray
    times: np.ndarray
    values: np.ndarray
    association_seconds: float
    decisions: list[Frame]
    dead_reckoning: tuple[np.ndarray, np.ndarray] | None
    course: MapCourse | None
    recovered: int | None
    error: KalmapError | None
    interrupted: bool


class Recorder:
    """Rows of the trace; an event at the time of the row before replaces it. numbers: of a sighting."""

    def __init__(self, numbers: int) -> None:
        self.numbers = numbers
        self.times: list[float] = []
        self.rows: list[tuple[np.ndarray, np.ndarray, float, int, int]] = []
        self.step_seconds: list[np.ndarray] = []
        self.step_times: list[np.ndarray] = []
        self.reckoned: list[np.ndarray] = []

    def row(self, slam: Slam, nis: float, used: int, reckoned: np.ndarray) -> None:
        """Keep what the filter says now."""
        entry = (slam.pose, slam.pose_covariance, nis, used, slam.landmark_count)
        if self.times and self.times[-1] == slam.time:
            self.rows[-1], self.reckoned[-1] = entry, reckoned
        else:
            self.times.append(slam.time)
            self.rows.append(entry)
            self.reckoned.append(reckoned)

    def samples(self, event: Odometry, seconds: float) -> None:
        """Share a block's time among its samples."""
        count = len(event.durations)
        if count:
            self.step_seconds.append(np.full(count, seconds / count))
            self.step_times.append(event.time - event.durations.sum() + np.cumsum(event.durations))

    def frame(self, seconds: float) -> None:
        """A frame's update belongs to the sample before it."""
        if self.step_seconds:
            self.step_seconds[-1][-1] += seconds

    def trace(self) -> Trace:
        """Everything as arrays."""
        used = np.array([row[3] for row in self.rows], dtype=np.int64)
        return Trace(
            times=np.array(self.times),
            poses=np.array([row[0] for row in self.rows]).reshape(-1, 3),
            covariances=np.array([row[1] for row in self.rows]).reshape(-1, 3, 3),
            nis=np.array([row[2] for row in self.rows], dtype=float),
            nis_dof=self.numbers * used,
            landmarks=np.array([row[4] for row in self.rows], dtype=np.int64),
            sightings=used,
            step_seconds=np.concatenate(self.step_seconds) if self.step_seconds else np.zeros(0),
            step_times=np.concatenate(self.step_times) if self.step_times else np.zeros(0),
        )


def run(
    slam: Slam,
    log: Log,
    *,
    tolerant: bool = False,
    progress: Callable[[float], None] | None = None,
    reckon: bool = True,
    explain: bool = False,
) -> Outcome:
    """Feed every event of the log to the filter.

    tolerant: pass bad records over, listed and counted; else the first one ends the run and is the outcome's
    `error`. progress: called with the time reached, about a hundred times a second at most. reckon: integrate
    the odometry alone beside the filter. explain: keep the audit trail of an association by place. Ctrl-C ends
    the run with what there is.
    """
    loop = _Loop(slam, log, tolerant, reckon)
    slam.explain = explain and slam.labels
    error: KalmapError | None = None
    interrupted = False
    shown = 0.0
    try:
        warm_up(slam)
        for event in log.open(loop.skip if tolerant else None):
            loop.take(event)
            if progress is not None and (now := time.perf_counter()) - shown > 0.01:
                shown = now
                progress(float(event.time))
    except KeyboardInterrupt:
        interrupted = True
    except KalmapError as problem:
        error = problem
    return loop.outcome(error, interrupted)


def warm_up(slam: Slam) -> None:
    """Load the compiled kernels through a throw-away filter like this one, so that no step pays for it."""
    twin = slam.twin()
    if isinstance(twin, ContourSlam):
        rehearse(twin)
        return
    motion = np.full((2, slam.motion.control_size), 1e-3)
    values = np.array([[5.0, 0.1], [5.2, 0.1], [8.0, -0.3]])  # two of them compete
    attributes = {name: np.ones(len(values)) for name in slam.attribute_names}
    for number in range(3):
        twin.step(Odometry(float(number), motion, np.full(2, 0.01)))
        twin.step(
            Sightings(float(number), values, np.arange(len(values), dtype=np.int64), attributes=attributes)
        )


class _Loop:
    """The state of one run."""

    def __init__(self, slam: Slam, log: Log, tolerant: bool, reckon: bool) -> None:
        self.slam, self.log, self.tolerant = slam, log, tolerant
        self.recorder = Recorder(slam.numbers_per_sighting)
        self.first = slam.frames_taken
        self.frames = self.sightings = self.skipped_total = 0
        self.runtime = 0.0
        self.skipped: list[Skipped] = []
        self.truth: list[np.ndarray] = []
        self.labels: list[np.ndarray] = []
        self.named = False  # whether any frame came with identities
        self.times: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self.associated = slam.association_seconds  # before this run
        self.decisions: list[Frame] = []
        self.scored = slam.labels
        self.keeper = CourseKeeper(slam) if isinstance(slam, FiniteSetSlam) else None
        self.recovered = slam.recovered if isinstance(slam, FiniteSetSlam) else 0  # before this run
        self.reckoner = _reckoner(slam, log) if reckon else None

    def skip(self, record: Skipped) -> None:
        """Count a bad record; list the first thousand."""
        self.skipped_total += 1
        if len(self.skipped) < KEPT_SKIPS:
            self.skipped.append(record)

    def take(self, event: object) -> None:
        """One event, timed."""
        begin = time.perf_counter()
        try:
            self.slam.step(event)  # type: ignore[arg-type]
        except EventError as problem:
            self._refused(event, problem)
            return
        seconds = time.perf_counter() - begin
        if isinstance(event, Odometry):
            self.runtime += seconds
            self.recorder.samples(event, seconds)
            if self.reckoner is not None:
                self.reckoner.step(event)
            self.recorder.row(self.slam, float("nan"), 0, self._reckoned())
        elif isinstance(event, (Sightings, Scan)):
            self.runtime += seconds
            self.recorder.frame(seconds)
            self.frames += 1
            self._count()
            if self.keeper is not None:
                self.keeper.frame()
            self.recorder.row(self.slam, self.slam.frame_nis, self.slam.frame_used, self._reckoned())

    def _count(self) -> None:
        seen = self.slam.frame_sightings
        assert seen is not None
        self.sightings += len(seen.values)
        for number, (labels, decision) in self.slam.frame_revisions.items():
            row = number - self.first
            if row >= 0:  # a frame that was seen before this run began has no row
                self.labels[row] = labels
                if decision is not None:
                    self.decisions[row] = decision
        if self.slam.frame_decision is not None:
            self.decisions.append(self.slam.frame_decision)
        if self.scored:
            many = len(seen.values)
            self.times.append(np.full(many, seen.time))
            self.values.append(seen.values)
            self.labels.append(self.slam.frame_labels)
            self.truth.append(np.full(many, -1, dtype=np.int64) if seen.ids is None else seen.ids)
            self.named |= self.log.truth_ids and seen.ids is not None

    def _reckoned(self) -> np.ndarray:
        return self.slam.pose if self.reckoner is None else self.reckoner.pose

    def _refused(self, event: object, problem: EventError) -> None:
        """Say where in the file the event came from; skip it or end the run."""
        record = getattr(event, "record", 0)
        file = getattr(event, "file", "") or self.log.source
        field = problem.field or type(event).__name__.lower()
        if self.tolerant:
            self.skip(Skipped(file=file, record=record, field=field, problem=str(problem)))
            return
        text = problem.problem if problem.time is None else f"t = {problem.time:.6g} s: {problem.problem}"
        raise LogError(text, file=file, record=record or None, field=field) from problem

    def outcome(self, error: KalmapError | None, interrupted: bool) -> Outcome:
        """Everything kept so far."""
        recorder = self.recorder
        at_once = np.concatenate(self.labels) if self.labels else np.zeros(0, dtype=np.int64)
        reckoned = None
        if self.reckoner is not None:
            reckoned = np.array(recorder.times), np.array(recorder.reckoned).reshape(-1, 3)
        recovered = self.slam.recovered - self.recovered if isinstance(self.slam, FiniteSetSlam) else None
        return Outcome(
            estimate=self.slam.estimate(),
            trace=recorder.trace(),
            frames=self.frames,
            sightings=self.sightings,
            runtime=self.runtime,
            skipped=self.skipped,
            skipped_total=self.skipped_total,
            truth_ids=np.concatenate(self.truth) if self.named else np.zeros(0, dtype=np.int64),
            labels=self.slam.settled_labels(at_once),
            labels_at_once=at_once,
            times=np.concatenate(self.times) if self.times else np.zeros(0),
            values=np.concatenate(self.values) if self.values else np.zeros((0, 2)),
            association_seconds=self.slam.association_seconds - self.associated,
            decisions=self.decisions,
            dead_reckoning=reckoned,
            course=None if self.keeper is None else self.keeper.course(),
            recovered=recovered,
            error=error,
            interrupted=interrupted,
        )


def _reckoner(slam: Slam, log: Log) -> LandmarkSlam | None:
    """A filter that only ever predicts: odometry as it is, without biases."""
    if not isinstance(slam.motion, BuiltInMotion):
        return None
    motion = msgspec.structs.replace(slam.motion, biases=())
    return LandmarkSlam(motion, slam.sensor, Jacobian(), start=log.start)
