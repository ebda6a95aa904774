"""Crispness, errors against true walls and of loops: distances by brute force, rooms smeared on purpose."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contour_samples import contours_of, floor_run
from kalmap.evaluation import crispness, evaluate, loop_error, map_error, match
from kalmap.geometry.se2 import compose
from kalmap.geometry.segments import segment_distances
from kalmap.records import Contours, Log, Reference, Relations, RunConfig, SensorConfig, Trajectory


def slowly(points, segments):
    """Distance of each point to the nearest of 20,001 places along every segment."""
    share = np.linspace(0, 1, 20_001)[:, None]
    best = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in segments:
        places = (1 - share) * [x1, y1] + share * [x2, y2]
        best = np.minimum(best, [np.hypot(*(places - point).T).min() for point in points])
    return best


@pytest.mark.parametrize("cutoff", [np.inf, 1.5, 0.2])
def test_distances_are_those_of_brute_force(cutoff):
    rng = np.random.default_rng(3)
    points = rng.uniform(-6, 6, (60, 2))
    starts = rng.uniform(-5, 5, (12, 2))
    segments = np.hstack([starts, starts + rng.normal(0, 3, (12, 2))])
    segments[0, 2:] = segments[0, :2]  # a point
    expected = slowly(points, segments)
    expected[expected > cutoff] = np.inf
    found = segment_distances(points, segments, cutoff)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert (found[np.isfinite(found)] <= expected[np.isfinite(found)] + 1e-9).all()


def test_a_far_point_among_many_near_middles_is_exact():
    """More middles lie near than are looked up at first, and the nearest piece's middle is not among them."""
    crowd = np.c_[np.linspace(-0.1, 0.1, 40), np.full(40, 0.45)]
    segments = np.vstack([np.hstack([crowd, crowd]), [0.0, 0.05, 0.95, 0.05]])
    assert segment_distances(np.zeros((1, 2)), segments)[0] == pytest.approx(0.05)


def test_no_points_and_no_segments():
    assert segment_distances(np.zeros((0, 2)), np.zeros((1, 4))).shape == (0,)
    assert segment_distances(np.zeros((2, 2)), np.zeros((0, 4))).tolist() == [np.inf, np.inf]


def test_crispness_counts_strangers_apart():
    contours = contours_of([np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), np.array([[5.0, 5.0]])])
    points = np.array([[0.5, 0.01], [1.5, -0.03], [2.0, 0.02], [5.0, 5.1], [9.0, 9.0], [0.0, 0.6]])
    crisp = crispness(points, contours)
    assert crisp.mean == pytest.approx(0.04)
    assert crisp.median == pytest.approx(0.025)
    assert crisp.p95 == pytest.approx(np.percentile([0.01, 0.03, 0.02, 0.1], 95))
    assert (crisp.points, crisp.beyond) == (6, pytest.approx(1 / 3))
    nothing = crispness(np.zeros((0, 2)), contours)
    assert (nothing.mean, nothing.points, nothing.beyond) == (None, 0, None)
    assert crispness(points, contours_of([])).beyond == 1.0


def test_many_points_are_thinned_evenly():
    contours = contours_of([np.array([[0.0, 0.0], [10.0, 0.0]])])
    points = np.c_[np.linspace(0, 10, 500_001), np.linspace(0, 0.1, 500_001)]
    crisp = crispness(points, contours)
    assert crisp.points == 166_667
    assert crisp.mean == pytest.approx(0.05, abs=1e-6)


def test_a_smeared_map_is_less_crisp():
    sharp, smeared = floor_run(poses=0.0), floor_run(poses=0.1)
    means = []
    for run in (sharp, smeared):
        points = run.estimate.sweeps().points(0.0, 8.0)
        means.append(crispness(points, run.estimate.contours).mean)
    assert 0.005 < means[0] < 0.02
    assert means[1] > 0.05


def walls_of(frame="map"):
    return Reference(frame=frame, walls=np.array([[0.0, 0.0, 4.0, 0.0]]))


def test_map_error_is_measured_to_the_walls():
    contours = contours_of([np.array([[0.0, 0.1], [2.0, -0.3], [4.3, 0.4]])])
    error = map_error(contours, walls_of(), match(np.zeros(0), np.zeros((0, 3)), walls_of()))
    assert (error.mean, error.rms) == (pytest.approx(0.3), pytest.approx(np.sqrt((0.01 + 0.09 + 0.25) / 3)))
    assert error.p95 == pytest.approx(np.percentile([0.1, 0.3, 0.5], 95))
    assert map_error(contours, Reference(), match(np.zeros(0), np.zeros((0, 3)), Reference())) is None
    empty = map_error(contours_of([]), walls_of(), match(np.zeros(0), np.zeros((0, 3)), walls_of()))
    assert (empty.mean, empty.rms, empty.p95) == (None, None, None)


def test_map_error_follows_the_alignment():
    times = np.arange(20.0)
    truth = np.c_[np.cos(times), np.sin(times), times]
    T_other_map = np.array([3.0, -2.0, 0.7])
    walls = np.array([[0.0, 0.0, 4.0, 0.0]])
    ends = compose(T_other_map, np.c_[walls.reshape(-1, 2), np.zeros(2)])[:, :2]
    moved = compose(T_other_map, truth)
    reference = Reference(
        frame="other", times=times, positions=moved[:, :2], headings=moved[:, 2], walls=ends.reshape(1, 4)
    )
    contours = contours_of([np.array([[0.0, 0.1], [2.0, -0.1]])])
    assert map_error(contours, reference, match(times, truth, reference)).mean == pytest.approx(0.1)
    assert map_error(contours, reference, match(times[:0], truth[:0], reference)) is None


def test_loop_error_is_of_the_whole_drive():
    times = np.arange(5.0)
    truth = np.c_[times, 0 * times, 0 * times]
    reference = Reference(times=times, positions=truth[:, :2], headings=truth[:, 2])
    estimate = compose(np.array([7.0, 1.0, 2.0]), truth)  # where it lies does not matter
    estimate[2] += 5.0  # nor what is between
    estimate[-1] = compose(estimate[-1], np.array([0.3, -0.4, -0.1]))
    translation, rotation = loop_error(match(times, estimate, reference))
    assert (translation, rotation) == (pytest.approx(0.5), pytest.approx(0.1))
    unknown = msgspec.structs.replace(reference, headings=np.full(5, np.nan))
    assert loop_error(match(times, estimate, unknown)) is None


def test_metrics_of_a_contour_map_judge_the_drive_as_seen_at_the_end():
    run, log = floor_run(poses=0.0), floor_log()
    estimate = run.estimate
    trajectory = estimate.trajectory
    metrics = evaluate(run.trace, estimate, log, dead_reckoning=(trajectory.times, trajectory.poses))
    assert metrics["position_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["online_position_rmse_m"] > 0.01
    assert metrics["contour_samples"] == len(estimate.contours)
    assert metrics["contour_runs"] == len(estimate.contours.strands())
    assert metrics["loops_closed"] == 2
    assert 0.005 < metrics["map_error_mean_m"] < metrics["map_error_p95_m"] < 0.03
    # one sample stands 2 m from every wall
    assert metrics["map_error_rms_m"] == pytest.approx(2.0 / np.sqrt(len(estimate.contours)), rel=0.1)
    assert (metrics["loop_error_m"], metrics["loop_error_deg"]) == (pytest.approx(0, abs=1e-9),) * 2
    assert metrics["relations_translation_mean_m"] == pytest.approx(0.1)
    assert metrics["relations_missed"] == 1
    strangers = ("landmark", "feature", "ospa", "gospa", "cardinality", "association")
    assert not [key for key in metrics if key.startswith(strangers)]
    assert all(value is None or np.isfinite(value) for value in metrics.values())


def floor_log():
    """The made-up floor's truth; its relations are by stamps, one of them of another drive."""
    run = floor_run(poses=0.0)
    trajectory: Trajectory = run.estimate.trajectory
    poses = trajectory.poses
    relations = Relations(
        trajectory.stamps[[5, 9]],
        np.array([trajectory.stamps[5], -50.0]),
        np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    )
    reference = Reference(
        times=trajectory.times,
        positions=poses[:, :2],
        headings=poses[:, 2],
        walls=run.reference.walls,
        relations=relations,
    )
    defaults = RunConfig(sensor=SensorConfig(max_range=8.0))
    return Log("floor", "made up", defaults, lambda skip: iter(()), (reference,))


def test_strands_keep_the_order_of_the_rows():
    runs = np.array([4, 1, 4, 1, 9])
    positions = np.arange(10.0).reshape(5, 2)
    contours = Contours(positions, np.zeros((5, 2, 2)), positions, runs, runs)
    assert [rows.tolist() for rows in contours.strands()] == [[1, 3], [0, 2], [4]]
    assert contours.segments().tolist() == [[2, 3, 6, 7], [0, 1, 4, 5], [8, 9, 8, 9]]
