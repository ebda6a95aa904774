"""The last map of a run against the reference's: errors of its features, and the whole as a set."""

from __future__ import annotations

import numpy as np

from kalmap.evaluation import trajectory
from kalmap.evaluation.landmarks import MapScore, Motion, pair_by_id, score_by_id, score_by_nearest
from kalmap.evaluation.sets import pair_sets
from kalmap.geometry.alignment import align, apply
from kalmap.records import Landmarks, Reference

Metrics = dict[str, float | int | None]

# m: of OSPA and GOSPA, for sensors that reach so far or farther
_OSPA_CUTOFF, _GOSPA_CUTOFF, _FAR = 10.0, 20.0, 15.0

_SET_KEYS = (
    "ospa_m",
    "ospa_localisation_m",
    "ospa_cardinality_m",
    "ospa_cutoff_m",
    "gospa_m",
    "gospa_missed",
    "gospa_false",
    "gospa_cutoff_m",
    "cardinality_error",
)

_STAY: Motion = (0.0, np.zeros(2))


def map_metrics(
    landmarks: Landmarks,
    matched: trajectory.Matched,
    reference: Reference,
    comparable: bool,
    cutoff: float,
) -> Metrics:
    """The last map against the reference's; None throughout if the reference has no features."""
    score: MapScore | None = None
    if len(reference.landmarks):
        motion = _into_frame(landmarks, matched, reference, comparable)
        ids, positions = np.asarray(landmarks.ids), landmarks.positions
        if comparable:
            score = score_by_id(ids, positions, reference.landmark_ids, reference.landmarks, motion)
        else:
            # a map drifts with its trajectory: look for its features where the aligned trajectory puts them
            driven = trajectory.aligned(matched)[1] if len(matched) else motion
            score = score_by_nearest(positions, reference.landmarks, cutoff, motion, driven)
    return {
        "feature_rmse_m": score.rmse if score else None,
        "feature_aligned_rmse_m": score.aligned_rmse if score else None,
        "landmarks_matched": score.matched if score else None,
        "landmarks_missed": score.missed if score else None,
        "landmarks_spurious": score.spurious if score else None,
        "landmarks_doubled": score.doubled if score else None,
    }


def set_cutoffs(max_range: float) -> tuple[float, float]:
    """Cut-offs of OSPA and GOSPA, m, both of order 2, for a sensor that reaches so far (m).

    10 and 20 m where it reaches 15 m or more. In smaller worlds, such as a room, every two features are nearer than
    that to each other, and both shrink with the sensor's range.
    """
    share = min(1.0, max_range / _FAR)
    return share * _OSPA_CUTOFF, share * _GOSPA_CUTOFF


def set_metrics(
    landmarks: Landmarks,
    matched: trajectory.Matched,
    reference: Reference,
    comparable: bool,
    cutoffs: tuple[float, float],
) -> Metrics:
    """The last map as a set against the reference's; None throughout if the reference has no features."""
    true = reference.landmarks[np.isfinite(reference.landmarks).all(axis=1)]
    metrics: Metrics = dict.fromkeys(_SET_KEYS)
    if not len(true) or not np.isfinite(landmarks.positions).all():
        return metrics
    positions = apply(*_into_frame(landmarks, matched, reference, comparable), landmarks.positions)
    near = pair_sets(positions, true, order=2.0, cutoff=cutoffs[0]).ospa()
    far = pair_sets(positions, true, order=2.0, cutoff=cutoffs[1]).gospa()
    values = (
        *(near.value, near.localisation, near.cardinality, cutoffs[0]),
        *(far.value, far.missed_count, far.false_count, cutoffs[1]),
        len(positions) - len(true),
    )
    return dict(zip(_SET_KEYS, values, strict=True))


def _into_frame(
    landmarks: Landmarks, matched: trajectory.Matched, reference: Reference, comparable: bool
) -> Motion:
    """The motion from the estimate's frame into the reference's: none if they are the same, else that of
    the trajectory, or of the named features where the reference (a survey) has no trajectory."""
    if reference.frame == "map":
        return _STAY
    if len(matched) or not comparable:
        return trajectory.aligned(matched)[1]
    rows, columns = pair_by_id(landmarks.ids, reference.landmark_ids)
    return align(landmarks.positions[rows], reference.landmarks[columns])
