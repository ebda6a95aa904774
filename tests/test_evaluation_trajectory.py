import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmap.evaluation import (
    Matched,
    absolute_trajectory_error,
    heading_errors,
    match,
    position_errors,
    relative_errors,
    relative_pose_error,
)
from kalmap.geometry.alignment import apply
from kalmap.geometry.angles import wrap
from kalmap.records import Reference


def wander(count, seed=0):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.1, count))
    steps = np.column_stack([np.cos(heading), np.sin(heading)]) * rng.uniform(0.1, 0.5, (count, 1))
    return np.column_stack([np.cumsum(steps, axis=0), wrap(heading)])


def noisy(poses, seed=1):
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0, 0.03, poses.shape), axis=0) * [1, 1, 0.1]
    return np.column_stack([poses[:, :2] + drift[:, :2], wrap(poses[:, 2] + drift[:, 2])])


def reference_of(times, poses, **fields):
    return Reference(times=times, positions=poses[:, :2].copy(), headings=poses[:, 2].copy(), **fields)


def pair(count=300):
    truth = wander(count)
    return Matched(np.arange(count), noisy(truth), truth)


def test_the_reference_is_interpolated_linearly_and_the_short_way_round():
    reference = Reference(
        times=np.array([0.0, 1.0]),
        positions=np.array([[0.0, 0.0], [4.0, 2.0]]),
        headings=np.array([np.pi - 0.1, -np.pi + 0.3]),
    )
    found = match(np.array([0.0, 0.25, 1.0]), np.zeros((3, 3)), reference)
    np.testing.assert_allclose(found.reference[:, :2], [[0, 0], [1, 0.5], [4, 2]])
    np.testing.assert_allclose(
        wrap(found.reference[:, 2] - [np.pi - 0.1, np.pi, -np.pi + 0.3]), 0, atol=1e-12
    )


def test_times_outside_and_in_holes_are_left_out_but_the_edges_count():
    times = np.array([1.0, 2.0, 10.0, 11.0])
    reference = reference_of(times, np.arange(12.0).reshape(4, 3) / 10)
    asked = np.array([0.9, 1.0, 1.5, 2.0, 2.5, 9.9, 10.0, 10.5, 11.0, 11.1])
    found = match(asked, np.zeros((10, 3)), reference, max_gap=2.0)
    assert asked[found.rows].tolist() == [1.0, 1.5, 2.0, 10.0, 10.5, 11.0]
    assert len(match(asked, np.zeros((10, 3)), reference, max_gap=8.0)) == 8


def test_bad_reference_samples_are_passed_over():
    poses = np.array([[0.0, 0, np.nan], [np.nan, 0, 0], [2.0, 0, 0.5]])
    found = match(np.array([0.0, 1.0, 2.0]), np.zeros((3, 3)), reference_of(np.arange(3.0), poses))
    np.testing.assert_allclose(found.reference[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(np.isfinite(found.reference[:, 2]), [False, False, True])
    assert len(heading_errors(found)) == 1


@pytest.mark.parametrize("count", [0, 1])
def test_references_of_no_and_one_sample(count):
    reference = reference_of(np.zeros(count), np.ones((count, 3)))
    found = match(np.array([0.0, 0.1]), np.zeros((2, 3)), reference)
    assert len(found) == count
    assert (absolute_trajectory_error(found, align_first=True) is None) == (count == 0)
    assert relative_pose_error(found, (1.0,)) == []


def test_a_stamp_that_repeats_does_no_harm():
    found = match(
        np.array([0.5, 1.0, 1.5]), np.zeros((3, 3)), reference_of(np.array([0.0, 1, 1, 2]), np.zeros((4, 3)))
    )
    assert len(found) == 3 and (position_errors(found) == 0).all()


def test_the_point_on_the_vehicle_is_what_is_compared():
    poses = wander(50)
    forward, left = 2.0, -0.5
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    seen = poses.copy()
    seen[:, :2] += np.column_stack([forward * c - left * s, forward * s + left * c])
    times = np.arange(50.0)
    found = match(times, poses, reference_of(times, seen, point=np.array([forward, left])))
    assert position_errors(found).max() < 1e-12


@given(angle=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_a_rigid_motion_of_the_estimate_changes_neither_aligned_ate_nor_rpe(angle, x, y):
    plain = pair(80)
    moved = np.column_stack(
        [apply(angle, np.array([x, y]), plain.estimated[:, :2]), wrap(plain.estimated[:, 2] + angle)]
    )
    other = Matched(plain.rows, moved, plain.reference)
    first, second = (absolute_trajectory_error(each, align_first=True) for each in (plain, other))
    assert first.rmse == pytest.approx(second.rmse, abs=1e-9)
    for a, b in zip(
        relative_pose_error(plain, (1.0, 5.0)), relative_pose_error(other, (1.0, 5.0)), strict=True
    ):
        assert a.translation_rmse == pytest.approx(b.translation_rmse, abs=1e-9)
        assert a.rotation_rmse == pytest.approx(b.rotation_rmse, abs=1e-9)


def test_summary_by_hand():
    errors = np.zeros((10, 3))
    errors[:, 0] = np.arange(1, 11)
    summary = absolute_trajectory_error(
        Matched(np.arange(10), errors, np.zeros((10, 3))), align_first=False, trim=0.1
    )
    assert (summary.mean, summary.median, summary.max) == (5.5, 5.5, 10.0)
    assert summary.rmse == pytest.approx(np.sqrt(38.5))
    assert summary.trimmed_rmse == pytest.approx(np.sqrt(np.mean(np.arange(1.0, 10.0) ** 2)))


def test_pairs_over_a_distance_are_those_that_a_slow_search_finds():
    matched = pair(120)
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(matched.reference[:, :2], axis=0).T))])
    (found,) = relative_pose_error(matched, (5.0,))
    pairs = []
    for i in range(len(way)):
        later = [j for j in range(i, len(way)) if way[j] >= way[i] + 5.0]
        if later:
            pairs.append((i, later[0]))
    assert found.pairs == len(pairs)
    translation, rotation = relative_errors(matched, *np.array(pairs).T)
    assert found.translation_rmse == pytest.approx(np.sqrt(np.mean(translation**2)))
    assert found.rotation_rmse == pytest.approx(np.sqrt(np.mean(rotation**2)))
    assert relative_pose_error(matched, (1e6,)) == []


def evo_trajectory(poses):
    trajectory = pytest.importorskip("evo.core.trajectory")
    half = poses[:, 2] / 2
    zero = np.zeros(len(poses))
    return trajectory.PoseTrajectory3D(
        positions_xyz=np.column_stack([poses[:, :2], zero]),
        orientations_quat_wxyz=np.column_stack([np.cos(half), zero, zero, np.sin(half)]),
        timestamps=np.arange(len(poses), dtype=float),
    )


@pytest.mark.parametrize("align_first", [False, True])
def test_ate_agrees_with_evo(align_first):
    metrics = pytest.importorskip("evo.core.metrics")
    matched = pair()
    reference, estimate = evo_trajectory(matched.reference), evo_trajectory(matched.estimated)
    if align_first:
        estimate.align(reference, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    theirs = ape.get_all_statistics()
    ours = absolute_trajectory_error(matched, align_first=align_first)
    for key in ("rmse", "mean", "median", "max"):
        assert getattr(ours, key) == pytest.approx(theirs[key], rel=1e-9)


def test_rpe_agrees_with_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    matched = pair()
    both = evo_trajectory(matched.reference), evo_trajectory(matched.estimated)
    first = np.arange(len(matched) - 10)
    ours = relative_errors(matched, first, first + 10)
    relations = (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad)
    for errors, relation in zip(ours, relations, strict=True):
        rpe = metrics.RPE(relation, delta=10, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data(both)
        np.testing.assert_allclose(np.abs(errors), rpe.error, atol=1e-7)
