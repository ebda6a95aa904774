"""The course of a run's map as a set, judged by the landmarks that have been in view so far."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.evaluation import SetCourse, match, seen_so_far, set_cutoffs, set_errors_over_time
from kalmap.evaluation.trajectory import aligned
from kalmap.geometry.alignment import apply
from kalmap.geometry.se2 import compose
from kalmap.records import Log, Reference, RunConfig, SensorConfig
from kalmap.slam import Outcome


class JudgedCourse(msgspec.Struct, frozen=True, eq=False):
    """times: (K,) s. errors: at these instants, by OSPA of order 2. cutoff: m, its cut-off (`set_cutoffs`)."""

    times: np.ndarray
    errors: SetCourse
    cutoff: float


def judge_course(outcome: Outcome, log: Log, config: RunConfig) -> JudgedCourse | None:
    """None where no course was kept, or the first reference has no landmarks.

    In view is meant from the true poses; where these are not known in full, from the estimated ones, and the map is
    first brought into the reference's frame as the trajectory is.
    """
    course, trace = outcome.course, outcome.trace
    reference = log.references[0] if log.references else Reference()
    true = reference.landmarks[np.isfinite(reference.landmarks).all(axis=1)]
    if course is None or not len(course.times) or not len(true):
        return None
    matched = match(trace.times, trace.poses, reference)
    places, motion = course.places, (0.0, np.zeros(2))
    if reference.frame != "map":
        motion = aligned(matched)[1]
        places = [apply(*motion, each) for each in places]
    times, poses = trace.times, _moved(trace.poses, motion)
    whole = reference.frame == "map" and not reference.point.any()
    if whole and len(matched) and np.isfinite(matched.reference).all():
        times, poses = trace.times[matched.rows], matched.reference
    sensor = config.sensor
    view = np.deg2rad(sensor.field_of_view_deg)
    seen = seen_so_far(_sensor_poses(poses, sensor), true, sensor.max_range, float(view))
    rows = np.searchsorted(times, course.times, side="right") - 1
    seen = np.where((rows >= 0)[:, None], seen[np.maximum(rows, 0)], False)
    cutoff = set_cutoffs(log.defaults.sensor.max_range)[0]
    errors = set_errors_over_time(places, true, seen, order=2.0, cutoff=cutoff)
    return JudgedCourse(course.times, errors, cutoff)


def course_metrics(judged: JudgedCourse | None) -> dict[str, float | int | None]:
    """Means over the course: OSPA, and how many features the map is off, too many or too few."""
    if judged is None:
        return {"ospa_course_m": None, "cardinality_course_error": None}
    off = np.abs(judged.errors.estimated - judged.errors.true)
    return {
        "ospa_course_m": float(judged.errors.ospa.mean()),
        "cardinality_course_error": float(off.mean()),
    }


def _moved(poses: np.ndarray, motion: tuple[float, np.ndarray]) -> np.ndarray:
    """Poses (F, 3) after a rigid motion."""
    return np.column_stack([apply(*motion, poses[:, :2]), poses[:, 2] + motion[0]])


def _sensor_poses(poses: np.ndarray, sensor: SensorConfig) -> np.ndarray:
    """(F, 3) of the sensor, from those of the vehicle."""
    mount = np.array([sensor.mount_x, sensor.mount_y, np.deg2rad(sensor.mount_heading_deg)])
    return np.asarray(compose(poses, mount))
