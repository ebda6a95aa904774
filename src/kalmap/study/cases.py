"""One run of a study: a method in a world with a seed, and what is kept of it."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.evaluation import (
    evaluate,
    heading_errors,
    match,
    position_errors,
    score_association,
    sighting_identities,
)
from kalmap.evaluation.trajectory import aligned
from kalmap.perception import share_on_contours
from kalmap.records import AssociationConfig, FilterConfig, FiniteSetConfig, Log, RunConfig, final_course
from kalmap.records.config import ContourMethod
from kalmap.simulate import FloorWorld, World, simulate
from kalmap.slam import Outcome, run, slam_from_config
from kalmap.study.recorded import Recorded
from kalmap.study.set_course import JudgedCourse, course_metrics, judge_course

# what is kept of `judge`'s metrics, in the order of the tables
METRICS = (
    "position_rmse_m",
    "heading_rmse_deg",
    "feature_rmse_m",
    "ospa_m",
    "gospa_m",
    "cardinality_error",
    "ospa_course_m",
    "cardinality_course_error",
    "nees_mean",
    "nees_inside",
    "nis_mean",
    "nis_pooled",
    "association_accuracy",
    "association_accuracy_at_once",
    "association_precision",
    "association_recall",
    "association_f1",
    "association_spurious_landmarks",
    "association_duplicate_landmarks",
    "association_s",
    "association_ms",
    "landmarks",
    "frames",
    "steps",
    "runtime_s",
    "step_ms_mean",
    "step_ms_p99",
)
CURVE_POINTS = 200


class Method(msgspec.Struct, frozen=True):
    """A filter, and perhaps an association of its own, under the name that tables and figures give it.

    finite_set: of a method of random finite sets, for which filter and association mean nothing. contour: of a map of
    contours from raw scans; None: landmarks are mapped.
    """

    name: str
    filter: FilterConfig = FilterConfig()
    association: AssociationConfig | None = None
    finite_set: FiniteSetConfig | None = None
    contour: ContourMethod | None = None

    def on(self, base: RunConfig) -> RunConfig:
        """The settings with this method's in place of their own."""
        return msgspec.structs.replace(
            base,
            filter=self.filter,
            association=self.association or base.association,
            finite_set=self.finite_set or msgspec.structs.replace(base.finite_set, method=None),
            contour=msgspec.structs.replace(base.contour, method=self.contour),
        )


class Case(msgspec.Struct, frozen=True, eq=False):
    """A method in a world with a seed: everything that its result depends on, beside the program itself.

    association: of methods that have none of their own; None is the world's own. keep_joint: keep the last
        joint mean and covariance too, to set two filters side by side.
    """

    world: World | FloorWorld | Recorded
    method: Method
    seed: int
    association: AssociationConfig | None = None
    keep_joint: bool = False

    def config(self) -> RunConfig:
        """The world's own noise and sensor, with this filter and this association."""
        own = self.world.defaults()
        association = self.association or own.association
        return self.method.on(msgspec.structs.replace(own, association=association, seed=self.seed))


class Joint(msgspec.Struct, frozen=True):
    """The last state of a run: mean (n,) and covariance (n, n) of pose and landmarks."""

    mean: list[float]
    covariance: list[list[float]]


class SetRecord(msgspec.Struct, frozen=True):
    """The course of a map as a random finite set at K instants (s): as of `kalmap.evaluation.SetCourse`."""

    times: list[float]
    estimated: list[int]
    true: list[int]
    ospa: list[float]
    localisation: list[float]
    cardinality: list[float]


class RunRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a study keeps of a run.

    metrics: the `METRICS` of `judge`, and `association_ms`, the time of the association for a frame, in ms;
        position and heading RMS are over the run's frames (every 200 ms in Bailey's world), as in the papers'
        tables. Empty where the filter gave up.
    times: s, about 200 instants, the same for all runs in a world. position_squared m^2, heading_squared
        rad^2: squared errors at these instants; after an alignment where the reference is in a frame of its own, and
        headings only where it knows them throughout.
    error: why the filter gave up, else None. joint: the last state, where the case asked for it. sets: of a map that
        is a random finite set, where there is a true one.
    """

    world: str
    method: str
    seed: int
    metrics: dict[str, float | None]
    times: list[float]
    position_squared: list[float]
    heading_squared: list[float]
    error: str | None = None
    joint: Joint | None = None
    sets: SetRecord | None = None


def outcome_of(case: Case) -> tuple[Outcome, Log]:
    """A case's run, with its log. Raises as `run_case` does."""
    log = case.world.log() if isinstance(case.world, Recorded) else simulate(case.world, case.seed)
    outcome = run(slam_from_config(case.config(), log), log, reckon=False)
    if outcome.interrupted:
        raise KeyboardInterrupt
    return outcome, log


def run_case(case: Case) -> RunRecord:
    """Simulate, run and judge. The log depends on world and seed only, so methods are paired by seed.

    A filter that gives up makes a record with `error`. Raises `ConfigError` for a filter that does not exist
    and `KeyboardInterrupt` if the run was interrupted.
    """
    outcome, log = outcome_of(case)
    config = case.config()
    names = (case.world.name, case.method.name, case.seed)
    if outcome.error is not None:
        return RunRecord(*names, {}, [], [], [], str(outcome.error))
    judged = judge_course(outcome, log, config)
    metrics = judge(outcome, log, config) | course_metrics(judged)
    joint = None
    if case.keep_joint:
        mean, covariance = outcome.estimate.joint()
        joint = Joint(mean.tolist(), covariance.tolist())
    metrics["association_ms"] = association_ms(outcome, config)
    kept = {key: metrics.get(key) for key in METRICS}
    return RunRecord(*names, kept, *_curves(outcome, log), joint=joint, sets=_set_record(judged))


def _set_record(judged: JudgedCourse | None) -> SetRecord | None:
    if judged is None:
        return None
    errors = judged.errors
    columns = (errors.estimated, errors.true, errors.ospa, errors.localisation, errors.cardinality)
    return SetRecord(judged.times.tolist(), *(column.tolist() for column in columns))


def association_ms(outcome: Outcome, config: RunConfig) -> float | None:
    """Time of the association for a frame; None where it was given, or no frame came."""
    if not config.by_place or not outcome.frames:
        return None
    return 1e3 * outcome.association_seconds / outcome.frames


def judge(outcome: Outcome, log: Log, config: RunConfig) -> dict[str, float | int | None]:
    """All metrics of a run (see `kalmap.evaluation.evaluate`)."""
    association = _identities(outcome, log) if config.by_place else None
    at_once = None
    if association is not None:
        truth = association[0]
        at_once = score_association(truth, outcome.labels_at_once, false_ids=log.false_ids).accuracy
    return evaluate(
        outcome.trace,
        outcome.estimate,
        log,
        ids_known=config.by_ids,
        runtime_s=outcome.runtime,
        association=association,
        dead_reckoning=outcome.dead_reckoning,
        sensor=config.sensor,
    ) | {
        "frames": outcome.frames,
        "sightings": outcome.sightings,
        "skipped": outcome.skipped_total,
        "recovered": outcome.recovered,
        "association_accuracy_at_once": at_once,
        "association_s": outcome.association_seconds if config.by_place else None,
        **_of_scans(outcome, config),
    }


def _of_scans(outcome: Outcome, config: RunConfig) -> dict[str, float | int | None]:
    """What the scans of a contour map are like."""
    sweeps = outcome.estimate.sweeps
    if sweeps is None:
        return {}
    return {"ranges_on_contours_share": share_on_contours(sweeps().scans, config.sensor)}


def _identities(outcome: Outcome, log: Log) -> tuple[np.ndarray, np.ndarray] | None:
    """True identity and given landmark of every sighting; None where nobody knows the truth."""
    if len(outcome.truth_ids):
        return outcome.truth_ids, outcome.labels
    if log.sighting_truth is None or not len(outcome.labels):
        return None
    return sighting_identities(outcome.times, outcome.values, log.sighting_truth), outcome.labels


def _curves(outcome: Outcome, log: Log) -> tuple[list[float], list[float], list[float]]:
    course = final_course(outcome.estimate, outcome.trace)
    kept = np.linspace(0, len(course.times) - 1, min(len(course.times), CURVE_POINTS)).round().astype(int)
    times, poses = course.times[kept], course.poses[kept]
    matched = match(times, poses, log.references[0])
    if log.references[0].frame != "map":
        matched = aligned(matched)[0]
    position, heading = position_errors(matched) ** 2, heading_errors(matched) ** 2
    known = heading.tolist() if len(heading) == len(position) else []
    return times[matched.rows].tolist(), position.tolist(), known
