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
from kalmap.records import AssociationConfig, FilterConfig, Log, RunConfig
from kalmap.simulate import World, simulate
from kalmap.slam import Outcome, run, slam_from_config

# what is kept of `judge`'s metrics, in the order of the tables
METRICS = (
    "position_rmse_m",
    "heading_rmse_deg",
    "feature_rmse_m",
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
    """A filter, and perhaps an association of its own, under the name that tables and figures give it."""

    name: str
    filter: FilterConfig
    association: AssociationConfig | None = None


class Case(msgspec.Struct, frozen=True, eq=False):
    """A method in a world with a seed: everything that its result depends on, beside the program itself.

    association: of methods that have none of their own; None is the world's own. keep_joint: keep the last
        joint mean and covariance too, to set two filters side by side.
    """

    world: World
    method: Method
    seed: int
    association: AssociationConfig | None = None
    keep_joint: bool = False

    def config(self) -> RunConfig:
        """The world's own noise and sensor, with this filter and this association."""
        own = self.world.defaults()
        association = self.method.association or self.association or own.association
        return msgspec.structs.replace(
            own, filter=self.method.filter, association=association, seed=self.seed
        )


class Joint(msgspec.Struct, frozen=True):
    """The last state of a run: mean (n,) and covariance (n, n) of pose and landmarks."""

    mean: list[float]
    covariance: list[list[float]]


class RunRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a study keeps of a run.

    metrics: the `METRICS` of `judge`, and `association_ms`, the time of the association for a frame, in ms;
        position and heading RMS are over the run's frames (every 200 ms in Bailey's world), as in the papers'
        tables. Empty where the filter gave up.
    times: s, about 200 instants, the same for all runs in a world. position_squared m^2, heading_squared
        rad^2: squared errors at these instants.
    error: why the filter gave up, else None. joint: the last state, where the case asked for it.
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


def outcome_of(case: Case) -> tuple[Outcome, Log]:
    """A case's run, with its log. Raises as `run_case` does."""
    log = simulate(case.world, case.seed)
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
    metrics = judge(outcome, log, config)
    joint = None
    if case.keep_joint:
        mean, covariance = outcome.estimate.joint()
        joint = Joint(mean.tolist(), covariance.tolist())
    metrics["association_ms"] = association_ms(outcome, config)
    kept = {key: metrics.get(key) for key in METRICS}
    return RunRecord(*names, kept, *_curves(outcome, log), joint=joint)


def association_ms(outcome: Outcome, config: RunConfig) -> float | None:
    """Time of the association for a frame; None where it was given, or no frame came."""
    if config.association.method == "known" or not outcome.frames:
        return None
    return 1e3 * outcome.association_seconds / outcome.frames


def judge(outcome: Outcome, log: Log, config: RunConfig) -> dict[str, float | int | None]:
    """All metrics of a run (see `kalmap.evaluation.evaluate`)."""
    known = config.association.method == "known"
    association = None if known else _identities(outcome, log)
    at_once = None
    if association is not None:
        truth = association[0]
        at_once = score_association(truth, outcome.labels_at_once, false_ids=log.false_ids).accuracy
    return evaluate(
        outcome.trace,
        outcome.estimate,
        log,
        ids_known=known,
        runtime_s=outcome.runtime,
        association=association,
        dead_reckoning=outcome.dead_reckoning,
    ) | {
        "frames": outcome.frames,
        "sightings": outcome.sightings,
        "skipped": outcome.skipped_total,
        "association_accuracy_at_once": at_once,
        "association_s": None if known else outcome.association_seconds,
    }


def _identities(outcome: Outcome, log: Log) -> tuple[np.ndarray, np.ndarray] | None:
    """True identity and given landmark of every sighting; None where nobody knows the truth."""
    if len(outcome.truth_ids):
        return outcome.truth_ids, outcome.labels
    if log.sighting_truth is None or not len(outcome.labels):
        return None
    return sighting_identities(outcome.times, outcome.values, log.sighting_truth), outcome.labels


def _curves(outcome: Outcome, log: Log) -> tuple[list[float], list[float], list[float]]:
    trace = outcome.trace
    kept = np.linspace(0, len(trace.times) - 1, min(len(trace.times), CURVE_POINTS)).round().astype(int)
    times, poses = trace.times[kept], trace.poses[kept]
    matched = match(times, poses, log.references[0])
    position, heading = position_errors(matched) ** 2, heading_errors(matched) ** 2
    return times[matched.rows].tolist(), position.tolist(), heading.tolist()
