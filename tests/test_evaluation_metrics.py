import math

import msgspec
import numpy as np
import pytest

from kalmap.evaluation import evaluate
from kalmap.geometry.alignment import apply
from kalmap.geometry.angles import wrap
from kalmap.records import Estimate, Landmarks, Reference, Sightings, Trace
from kalmap.simulate import course_world, simulate

SPREAD = np.array([0.2, 0.3, 0.01])


@pytest.fixture(scope="module")
def log():
    return simulate(course_world(35, laps=1), 1)


def result_of(log, errors=None):
    """A trace that is off the truth by `errors` (F, 3), and a map that is right."""
    truth = log.references[0]
    rows = [round(event.time / 0.025) for event in log if isinstance(event, Sightings)]
    poses = np.column_stack([truth.positions, truth.headings])[rows]
    count = len(rows)
    if errors is None:
        errors = np.random.default_rng(2).normal(size=(count, 3)) * SPREAD
    poses = poses + errors
    poses[:, 2] = wrap(poses[:, 2])
    trace = Trace(
        times=truth.times[rows],
        poses=poses,
        covariances=np.broadcast_to(np.diag(SPREAD**2), (count, 3, 3)),
        nis=np.where(np.arange(count) % 10 == 0, np.nan, 2.0),
        nis_dof=np.where(np.arange(count) % 10 == 0, 0, 2),
        landmarks=np.full(count, 35),
        sightings=np.full(count, 1),
        step_seconds=np.full(8 * count, 1e-4),
        step_times=truth.times[1 : 8 * count + 1],
    )
    landmarks = Landmarks(
        truth.landmark_ids, truth.landmarks, np.tile(np.eye(2), (35, 1, 1)), np.ones(35, int), np.ones(35)
    )
    estimate = Estimate(
        float(trace.times[-1]),
        poses[-1],
        np.diag(SPREAD**2),
        landmarks,
        {},
        lambda: (np.zeros(0), np.zeros((0, 0))),
    )
    return trace, estimate


def moved(log, angle=0.7, translation=(10.0, -4.0), **fields):
    truth = log.references[0]
    reference = Reference(
        frame="other",
        times=truth.times,
        positions=apply(angle, np.array(translation), truth.positions),
        headings=wrap(truth.headings + angle),
        landmark_ids=truth.landmark_ids,
        landmarks=apply(angle, np.array(translation), truth.landmarks),
    )
    return msgspec.structs.replace(reference, **fields)


def test_the_main_numbers(log):
    trace, estimate = result_of(log)
    metrics = evaluate(trace, estimate, log)
    assert metrics["steps"] == 8 * metrics["frames"] and metrics["sightings"] == metrics["frames"]
    assert metrics["landmarks"] == metrics["landmarks_matched"] == 35
    assert metrics["landmarks_missed"] == metrics["landmarks_spurious"] == metrics["landmarks_doubled"] == 0
    assert metrics["position_rmse_m"] == pytest.approx(math.hypot(0.2, 0.3), rel=0.05)
    assert metrics["position_rmse_m"] == metrics["ate_rmse_m"] >= metrics["ate_aligned_rmse_m"]
    assert metrics["heading_rmse_deg"] == pytest.approx(math.degrees(0.01), rel=0.06)
    assert metrics["feature_rmse_m"] == 0 and metrics["aligned"] is False
    assert metrics["nees_mean"] == pytest.approx(3, abs=0.3)
    assert metrics["nees_inside"] == pytest.approx(0.95, abs=0.03)
    assert metrics["nis_mean"] == metrics["nis_pooled"] == 1
    assert metrics["nis_band_low"] < 1 < metrics["nis_band_high"]
    assert metrics["step_ms_mean"] == pytest.approx(0.1) and metrics["association_accuracy"] is None
    assert metrics["rpe_100m_m"] > 0 and metrics["rpe_1m_deg"] > 0
    assert metrics["runtime_s"] == pytest.approx(metrics["steps"] * 1e-4)
    assert evaluate(trace, estimate, log, runtime_s=3.0)["runtime_s"] == 3.0


def test_a_reference_elsewhere_is_aligned_first(log):
    trace, estimate = result_of(log)
    other = msgspec.structs.replace(log, references=(moved(log),))
    here, there = evaluate(trace, estimate, log), evaluate(trace, estimate, other)
    assert there["aligned"] is True and there["ate_rmse_m"] is None and there["nees_mean"] is None
    for key in ("ate_aligned_rmse_m", "ate_aligned_median_m", "ate_aligned_trimmed_rmse_m", "rpe_10m_m"):
        assert there[key] == pytest.approx(here[key], rel=1e-6)
    assert there["position_rmse_m"] == there["ate_aligned_rmse_m"]
    assert there["heading_rmse_deg"] == pytest.approx(here["heading_rmse_deg"], rel=0.05)
    assert there["feature_rmse_m"] < 0.1 and there["feature_aligned_rmse_m"] < 1e-9


def test_further_references_stand_behind_their_kind(log):
    trace, estimate = result_of(log)
    gps = moved(log, kind="gps", landmarks=np.zeros((0, 2)), landmark_ids=np.zeros(0, dtype=int))
    gps = msgspec.structs.replace(gps, headings=np.full(len(gps.times), np.nan))
    metrics = evaluate(trace, estimate, msgspec.structs.replace(log, references=(*log.references, gps, gps)))
    assert metrics["gps_position_rmse_m"] == pytest.approx(metrics["ate_aligned_rmse_m"])
    assert (
        metrics["gps_heading_rmse_deg"] is metrics["gps_rpe_10m_m"] is metrics["gps_feature_rmse_m"] is None
    )
    assert metrics["gps2_position_rmse_m"] == metrics["gps_position_rmse_m"]


def test_features_without_names_are_paired_by_distance(log):
    trace, estimate = result_of(log)
    landmarks = estimate.landmarks
    shuffled = msgspec.structs.replace(landmarks, positions=landmarks.positions[::-1] + 0.05)
    metrics = evaluate(trace, msgspec.structs.replace(estimate, landmarks=shuffled), log, ids_known=False)
    assert metrics["landmarks_matched"] == 35
    assert metrics["feature_rmse_m"] == pytest.approx(0.05 * math.sqrt(2))
    untrue = msgspec.structs.replace(log, truth_ids=False)
    assert (
        evaluate(trace, msgspec.structs.replace(estimate, landmarks=shuffled), untrue)["landmarks_matched"]
        == 35
    )


def test_a_survey_of_features_alone_aligns_on_them(log):
    trace, estimate = result_of(log)
    survey = moved(log, kind="survey", times=np.zeros(0), positions=np.zeros((0, 2)), headings=np.zeros(0))
    metrics = evaluate(trace, estimate, msgspec.structs.replace(log, references=(survey,)))
    assert metrics["position_rmse_m"] is None and metrics["feature_rmse_m"] < 1e-9


def test_dead_reckoning_and_association_are_judged_when_given(log):
    trace, estimate = result_of(log)
    truth = log.references[0]
    poses = np.column_stack([truth.positions, truth.headings]) + [3.0, 4.0, 0.0]
    metrics = evaluate(
        trace,
        estimate,
        log,
        dead_reckoning=(truth.times, poses),
        association=(np.array([1, 1]), np.array([0, 0])),
    )
    assert metrics["dead_reckoning_position_rmse_m"] == pytest.approx(5)
    assert metrics["dead_reckoning_ate_aligned_rmse_m"] < 1e-9
    assert metrics["association_accuracy"] == 1 and metrics["association_right_new"] == 1


def test_all_is_finite_or_none_and_can_be_saved(log):
    trace, estimate = result_of(log)
    broken = msgspec.structs.replace(
        trace,
        poses=np.full_like(trace.poses, np.nan),
        covariances=np.zeros_like(trace.covariances),
        nis=np.full_like(trace.nis, np.nan),
    )
    empty = Trace(
        np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), *[np.zeros(0)] * 4, np.zeros(0), np.zeros(0)
    )
    nowhere = msgspec.structs.replace(log, references=())
    keys = set(evaluate(trace, estimate, log))
    for each, where in ((trace, log), (broken, log), (empty, log), (trace, nowhere)):
        metrics = evaluate(each, estimate, where)
        assert set(metrics) == keys
        assert all(value is None or math.isfinite(value) for value in metrics.values())
        assert msgspec.json.decode(msgspec.json.encode(metrics)) == metrics


def test_nees_uses_the_estimates_own_coordinates(log):
    trace, estimate = result_of(log, errors=np.tile([2.0, -1.0, 0.5], (frames(log), 1)))
    additive = evaluate(trace, estimate, log)["nees_mean"]
    invariant = evaluate(trace, msgspec.structs.replace(estimate, coordinates="invariant"), log)["nees_mean"]
    assert additive == pytest.approx((2 / 0.2) ** 2 + (1 / 0.3) ** 2 + (0.5 / 0.01) ** 2)
    assert abs(additive - invariant) > 1


def frames(log):
    return sum(isinstance(event, Sightings) for event in log)


def test_a_map_that_drifted_with_its_trajectory_still_finds_its_features(log):
    trace, estimate = result_of(log)
    angle, translation = 0.05, np.array([4.0, 3.0])
    poses = np.column_stack([apply(angle, translation, trace.poses[:, :2]), wrap(trace.poses[:, 2] + angle)])
    landmarks = msgspec.structs.replace(
        estimate.landmarks, positions=apply(angle, translation, estimate.landmarks.positions)
    )
    metrics = evaluate(
        msgspec.structs.replace(trace, poses=poses),
        msgspec.structs.replace(estimate, landmarks=landmarks),
        log,
        ids_known=False,
    )
    assert metrics["landmarks_matched"] == 35 and metrics["landmarks_doubled"] == 0
    assert metrics["feature_aligned_rmse_m"] < 1e-9 and metrics["feature_rmse_m"] > 3
