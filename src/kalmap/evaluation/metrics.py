"""One run, judged: a flat table of finite numbers (or None) that a study or a report can save."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.evaluation import consistency, trajectory
from kalmap.evaluation.association import Verdict, score_association, score_pairs
from kalmap.evaluation.contour_metrics import contour_metrics, contour_reference_metrics
from kalmap.evaluation.map_metrics import Metrics, map_metrics, set_cutoffs, set_metrics
from kalmap.evaluation.owners import score_landmarks
from kalmap.evaluation.relations import relation_errors, relation_metrics
from kalmap.evaluation.timing import step_times
from kalmap.records import Estimate, Log, Reference, SensorConfig, Trace, Trajectory, final_course

_FEWEST_ALIGNED = 3  # an alignment makes the error of one or two positions vanish

_COUNTS = tuple(verdict.name.lower() for verdict in Verdict)


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """How results are compared with a reference.

    max_gap: s, holes of the reference longer than this are not interpolated. distances: m, of the relative
    pose error. cutoff: m, within which a feature may be a reference's one where ids do not say so. trim:
    share of the largest position errors that the trimmed RMS leaves out.
    """

    max_gap: float = 2.0
    distances: tuple[float, ...] = (1.0, 5.0, 10.0, 50.0, 100.0)
    cutoff: float = 2.0
    trim: float = 0.1


def evaluate(
    trace: Trace,
    estimate: Estimate,
    log: Log,
    *,
    ids_known: bool = True,
    runtime_s: float | None = None,
    association: tuple[np.ndarray, np.ndarray] | None = None,
    dead_reckoning: tuple[np.ndarray, np.ndarray] | None = None,
    sensor: SensorConfig | None = None,
    options: Options | None = None,
) -> Metrics:
    """Judge a run. Every value is a finite number, or None where it is not known.

    ids_known: the estimate's landmark ids are the log's (association "known"); else, or if the log's ids
        are not the truth, features are paired with the reference's by distance.
    runtime_s: the run's own clock; None takes the sum of the steps.
    association: true id and assigned landmark of every sighting, in order of time, both (M,) ints and the
        landmarks by their number in `estimate.landmarks.ids`; see `score_association`.
    dead_reckoning: times (K,) and poses (K, 3) of the odometry alone, judged like the estimate's.
    sensor: which ranges of scans count, for a map of contours; None takes the log's own.

    Main keys, of the first reference: `position_rmse_m` and `heading_rmse_deg` over the trace's instants;
    `feature_rmse_m` over the last map. Where the reference is in a frame of its own, these come after the
    rigid alignment of the trajectory and `aligned` is True. `ate_*` are position errors as they are,
    `ate_aligned_*` after alignment; `feature_aligned_rmse_m` after the map's own best alignment.
    `nees_mean` is the mean of the pose's NEES (3 is right) in the estimate's coordinates, known only for a
    reference of poses in the map frame; `nees_band_*` one frame's 95 % band and `nees_inside` the share in
    it. `nis_mean` is the mean NIS per degree of freedom (1 is right); `nis_pooled` their sum over the sum
    of degrees of freedom, whose 95 % band is `nis_band_*`. Further references add the same keys behind
    their kind ("gps_position_rmse_m"; a second of the same kind "gps2_").

    `ospa_m` with its parts, `gospa_m` with the numbers of features missed and false, and `cardinality_error`
    (features too many; negative: too few) judge the last map as a set, in the frame that `feature_rmse_m` is
    judged in; see `set_cutoffs`.

    `association_accuracy` and the count of each `Verdict` (`association_right`, ...) judge the sightings,
    `association_precision`, `_recall` and `_f1` the pairs of them, `association_*_landmarks` and
    `association_missed_features` the last map. Whether a negative true id means "known to be no landmark" is
    the log's `false_ids`; where it does not, `association_spurious_landmarks` is not known.

    Where the estimate holds the whole drive as it is seen at the end (`Estimate.trajectory`), that is what is judged,
    and `online_*` is what was said at the time. `relations_*` judge it by motions known between pairs of instants (see
    `relation_metrics`). A map of contours has `contour_*`, `crispness_*`, `map_error_*` (to true walls) and
    `loop_error_*` instead of everything about landmarks.
    """
    options = options or Options()
    comparable = ids_known and log.truth_ids
    metrics = _run_metrics(trace, estimate, runtime_s)
    metrics |= _nis_metrics(trace)
    if estimate.contours is None:
        metrics |= _association_metrics(association, estimate.landmarks.ids, log.false_ids)
    metrics |= contour_metrics(estimate, sensor or log.defaults.sensor)
    cutoffs = set_cutoffs(log.defaults.sensor.max_range)
    seen: dict[str, int] = {}
    for number, reference in enumerate(log.references or (Reference(),)):
        seen[reference.kind] = seen.get(reference.kind, 0) + 1
        again = seen[reference.kind] if seen[reference.kind] > 1 else ""
        prefix = f"{reference.kind}{again}_" if number else ""
        judged = _reference_metrics(trace, estimate, reference, comparable, options, cutoffs)
        if estimate.trajectory is not None:
            judged |= _course_metrics("online", trace.times, trace.poses, reference, options)
        if dead_reckoning is not None:
            judged |= _course_metrics("dead_reckoning", *dead_reckoning, reference, options)
        # what a reference of relations says of them is named after them already
        metrics |= {key if key.startswith(prefix) else prefix + key: value for key, value in judged.items()}
    return {key: _finite(value) for key, value in metrics.items()}


def _finite(value: float | int | None) -> float | int | None:
    return value if value is None or math.isfinite(value) else None


def _run_metrics(trace: Trace, estimate: Estimate, runtime_s: float | None) -> Metrics:
    times = step_times(trace.step_seconds)
    return {
        "steps": len(trace.step_seconds),
        "frames": len(trace.times),
        "sightings": int(np.sum(trace.sightings)),
        **({"landmarks": len(estimate.landmarks)} if estimate.contours is None else {}),
        "runtime_s": float(np.sum(trace.step_seconds)) if runtime_s is None else float(runtime_s),
        "step_ms_mean": times.mean_ms if times else None,
        "step_ms_p50": times.p50_ms if times else None,
        "step_ms_p99": times.p99_ms if times else None,
        "step_ms_max": times.max_ms if times else None,
    }


def _nis_metrics(trace: Trace) -> Metrics:
    nis = consistency.nis_summary(trace.nis, trace.nis_dof)
    return {
        "nis_mean": nis.mean if nis else None,
        "nis_pooled": nis.pooled if nis else None,
        "nis_band_low": nis.low if nis else None,
        "nis_band_high": nis.high if nis else None,
        "nis_inside": nis.inside if nis else None,
    }


def _association_metrics(
    association: tuple[np.ndarray, np.ndarray] | None, landmark_ids: np.ndarray, false_ids: bool
) -> Metrics:
    if association is None:
        return {"association_accuracy": None}
    score = score_association(*association, false_ids=false_ids)
    pairs = score_pairs(*association, false_ids=false_ids)
    final = score_landmarks(*association, landmark_ids, false_ids=false_ids)
    metrics: Metrics = {
        "accuracy": score.accuracy,
        "accuracy_used": score.accuracy_used,
        "precision": pairs.precision,
        "recall": pairs.recall,
        "f1": pairs.f1,
        **{name: getattr(score, name) for name in _COUNTS},
        "spurious_landmarks": final.spurious,
        "duplicate_landmarks": final.duplicates,
        "unknown_landmarks": final.unknown,
        "missed_features": final.missed,
    }
    return {f"association_{key}": value for key, value in metrics.items()}


def _reference_metrics(
    trace: Trace,
    estimate: Estimate,
    reference: Reference,
    comparable: bool,
    options: Options,
    cutoffs: tuple[float, float],
) -> Metrics:
    """All that one reference says about a run."""
    course = final_course(estimate, trace)
    matched = trajectory.match(course.times, course.poses, reference, options.max_gap)
    metrics = _pose_metrics(matched, reference, options)
    relative = {error.distance: error for error in trajectory.relative_pose_error(matched, options.distances)}
    for distance in options.distances:
        error = relative.get(distance)
        metrics[f"rpe_{distance:g}m_m"] = error.translation_rmse if error else None
        metrics[f"rpe_{distance:g}m_deg"] = math.degrees(error.rotation_rmse) if error else None
    metrics |= _nees_metrics(course, estimate.coordinates, matched, reference)
    if reference.relations is not None:
        metrics |= relation_metrics(relation_errors(course.printed(), course.poses, reference.relations))
    if estimate.contours is not None:
        return metrics | contour_reference_metrics(estimate.contours, matched, reference)
    metrics |= map_metrics(estimate.landmarks, matched, reference, comparable, options.cutoff)
    return metrics | set_metrics(estimate.landmarks, matched, reference, comparable, cutoffs)


def _pose_metrics(matched: trajectory.Matched, reference: Reference, options: Options) -> Metrics:
    """Position and heading: the main numbers, and ATE before and after alignment."""
    elsewhere = reference.frame != "map"
    moved = trajectory.aligned(matched)[0] if elsewhere else matched
    if elsewhere and len(matched) < _FEWEST_ALIGNED:
        moved = trajectory.Matched(matched.rows[:0], matched.estimated[:0], matched.reference[:0])
    heading = trajectory.rms(trajectory.heading_errors(moved))
    metrics: Metrics = {
        "aligned": elsewhere,
        "matched_frames": len(matched),
        "position_rmse_m": trajectory.rms(trajectory.position_errors(moved)),
        "heading_rmse_deg": None if heading is None else math.degrees(heading),
    }
    for name, align_first in (("ate", False), ("ate_aligned", True)):
        known = len(matched) >= _FEWEST_ALIGNED if align_first else not elsewhere
        ate = trajectory.absolute_trajectory_error(matched, align_first=align_first, trim=options.trim)
        for key in ("rmse", "mean", "median", "max", "trimmed_rmse"):
            metrics[f"{name}_{key}_m"] = getattr(ate, key) if ate and known else None
    return metrics


def _nees_metrics(
    course: Trajectory, coordinates: str, matched: trajectory.Matched, reference: Reference
) -> Metrics:
    """NEES needs true poses of the vehicle's own origin, in the frame in which the estimate began.

    A batch solution is no truth: it is an estimate from the same data, with errors of its own.
    """
    mean = inside = low = high = None
    if reference.kind == "truth" and reference.frame == "map" and not np.any(reference.point):
        covariances = course.covariances[matched.rows]
        nees = consistency.pose_nees(matched.reference, matched.estimated, covariances, coordinates)
        mean = consistency.mean_nees(nees)
        if mean is not None:
            inside, (low, high) = consistency.share_inside(nees, 3), consistency.chi2_band(3)
    return {"nees_mean": mean, "nees_band_low": low, "nees_band_high": high, "nees_inside": inside}


def _course_metrics(
    name: str, times: np.ndarray, poses: np.ndarray, reference: Reference, options: Options
) -> Metrics:
    """The main numbers of another course of the same drive."""
    matched = trajectory.match(times, poses, reference, options.max_gap)
    judged = _pose_metrics(matched, reference, options)
    keys = ("position_rmse_m", "heading_rmse_deg", "ate_aligned_rmse_m")
    return {f"{name}_{key}": judged[key] for key in keys}
