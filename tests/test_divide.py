"""Divide and conquer over a landmark filter: against the plain filter, in the background, stopped and resumed."""

from __future__ import annotations

import os

import msgspec
import numpy as np
import pytest

from command import kalmap_inside
from damage import cuts, refused_cuts
from kalmap.data.native_map import read_map_file
from kalmap.gaussian import Jacobian
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, rotate
from kalmap.models import Increments, RangeBearing
from kalmap.records import (
    AssociationConfig,
    ConfigError,
    DivideConfig,
    FiniteSetConfig,
    LogError,
    Odometry,
    RunConfig,
    Sightings,
)
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, run, slam_from_config
from kalmap.slam.submaps.divide import DivideAndConquer
from kalmap.study.cases import judge
from slam_problems import circle_events, feed

SMALL = DivideConfig(on=True, close_landmarks=8, close_distance=12.0)


@pytest.fixture(scope="module")
def course():
    return simulate(world_by_name("course-35"), 11)


TWELVE = DivideConfig(on=True, close_landmarks=12)


def _run(log, divide=TWELVE, **changes):
    config = msgspec.structs.replace(log.defaults, divide=divide, **changes)
    slam = slam_from_config(config, log)
    outcome = run(slam, log, reckon=False)
    assert outcome.error is None
    return slam, outcome, config


def test_the_divided_run_ends_where_the_plain_one_does(course):
    """Independent: the plain filter. Both are estimates, so they agree to a part of what either is unsure of."""
    slam, divided, _ = _run(course)
    _, plain, _ = _run(course, DivideConfig())
    assert slam.maps_closed > 8 and slam.refusals == 0
    ours, theirs = divided.estimate, plain.estimate
    assert sorted(ours.landmarks.ids) == sorted(theirs.landmarks.ids)
    sigma = np.sqrt(np.diagonal(theirs.covariance))
    assert (np.abs(ours.pose - theirs.pose) < 0.5 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diagonal(ours.covariance)), sigma, rtol=0.1)
    order = [np.argsort(each.landmarks.ids) for each in (ours, theirs)]
    apart = ours.landmarks.positions[order[0]] - theirs.landmarks.positions[order[1]]
    spread = theirs.landmarks.covariances[order[1]]
    assert np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart).max() < 1.0


@pytest.mark.slow
def test_the_divided_map_is_as_unsure_as_it_is_wrong():
    """Truth over KALMAP_SLOW_SEEDS seeds (default 10): the joint NEES of all landmarks inside its 99.9 % band for 70
    numbers a seed."""
    from scipy.stats import chi2

    total, count = 0.0, 0
    for seed in range(int(os.environ.get("KALMAP_SLOW_SEEDS", "10"))):
        log = simulate(world_by_name("course-35"), 100 + seed)
        estimate = _run(log)[1].estimate
        mean, covariance = estimate.joint()
        error = mean[3:] - log.references[0].landmarks[estimate.landmarks.ids].ravel()
        total += float(error @ np.linalg.solve(covariance[3:, 3:], error))
        count += len(error)
    low, high = chi2.ppf([0.0005, 0.9995], count)
    assert low < total < high


def test_joins_in_the_background_come_to_the_same_numbers(course):
    _, inline, _ = _run(course)
    slam, beside, _ = _run(course, DivideConfig(on=True, close_landmarks=12, background=True))
    assert slam.finished().apart == 1
    for name in ("pose", "covariance"):
        assert getattr(inline.estimate, name).tobytes() == getattr(beside.estimate, name).tobytes()
    assert inline.estimate.landmarks.positions.tobytes() == beside.estimate.landmarks.positions.tobytes()


def test_the_open_map_stays_small_and_the_drive_is_told_as_it_is_seen_in_the_end(course):
    slam, outcome, _ = _run(course)
    assert slam.live.landmark_count <= 12 + 20
    trajectory = outcome.estimate.trajectory
    assert len(trajectory.times) == outcome.frames
    reference = course.references[0]
    rows = np.searchsorted(reference.times, trajectory.times - 1e-9)
    error = trajectory.poses[:, :2] - reference.positions[rows]
    live = outcome.trace.poses[np.searchsorted(outcome.trace.times, trajectory.times)][:, :2]
    live = live - reference.positions[rows]
    assert (error**2).sum() < (live**2).sum()  # loops closed reach back over the drive
    assert np.linalg.eigvalsh(trajectory.covariances).min() > -1e-12


def test_by_place_the_maps_find_each_other(course):
    slam, outcome, config = _run(course, association=AssociationConfig(method="jcbb"))
    metrics = judge(outcome, course, config)
    assert metrics["association_accuracy"] > 0.98
    assert len(outcome.estimate.landmarks) == 35
    assert slam.finished().apart == 1
    settled = np.unique(outcome.labels[outcome.labels >= 0])
    assert set(settled.tolist()) <= set(outcome.estimate.landmarks.ids.tolist())


@pytest.mark.parametrize("start_covariance", [None, 1e-6 * np.diag([4.0, 2.0, 1.0])])
def test_a_drive_in_one_local_map_is_the_plain_filter_wherever_it_starts(start_covariance):
    """Independent: the plain filter, which carries the start in its state. The EKF is the same in every frame."""
    settings = {"start": (3.0, -2.0, 0.8), "start_covariance": start_covariance, "coordinates": "additive"}
    slams = [LandmarkSlam(lineariser=Jacobian(), **settings) for _ in range(2)]
    divided = DivideAndConquer(slams[0], DivideConfig(on=True, close_landmarks=5000, close_distance=1e9))
    events = circle_events(3, frames=12)
    feed(slams[1], events)
    feed(divided, events)
    ours, theirs = divided.estimate(), slams[1].estimate()
    np.testing.assert_allclose(ours.pose, theirs.pose, atol=1e-3 if start_covariance is not None else 1e-9)
    mean, covariance = ours.joint()
    expected, spread = theirs.joint()
    np.testing.assert_allclose(mean, expected, atol=1e-3 if start_covariance is not None else 1e-9)
    scale = np.sqrt(np.outer(np.diagonal(spread), np.diagonal(spread)))
    assert (np.abs(covariance - spread) / scale).max() < (2e-2 if start_covariance is not None else 1e-6)
    np.testing.assert_allclose(divided.pose_covariance, ours.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("stop", [9, 30, 47])
def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path, stop):
    """Oracle: the run that never stopped."""
    events = circle_events(4, frames=30)
    slam = DivideAndConquer(LandmarkSlam(start=(1.0, 0.0, 0.2)), SMALL)
    feed(slam, events[:stop])
    slam.save(tmp_path / "state")
    resumed = DivideAndConquer.load(tmp_path / "state")
    feed(slam, events[stop:])
    feed(resumed, events[stop:])
    assert slam.maps_closed == resumed.maps_closed > 1
    ours, theirs = slam.estimate(), resumed.estimate()
    for name in ("pose", "covariance"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    assert ours.landmarks.positions.tobytes() == theirs.landmarks.positions.tobytes()
    assert ours.landmarks.covariances.tobytes() == theirs.landmarks.covariances.tobytes()
    assert ours.trajectory.poses.tobytes() == theirs.trajectory.poses.tobytes()


def test_a_damaged_file_is_refused(tmp_path):
    slam = DivideAndConquer(LandmarkSlam(), SMALL)
    feed(slam, circle_events(4, frames=20))
    slam.save(tmp_path / "state")
    content = (tmp_path / "state").read_bytes()
    lengths = cuts(content, len(content) // 20)
    assert refused_cuts(content, tmp_path / "broken", DivideAndConquer.load, lengths) == lengths
    LandmarkSlam().save(tmp_path / "plain")
    with pytest.raises(LogError, match="no saved filter"):
        DivideAndConquer.load(tmp_path / "plain")


def _two_maps(moved: float, gate: float | None):
    """Straight ahead past ten landmarks with a map closed half way; between the maps all landmarks turn about."""
    rng = np.random.default_rng(2)
    landmarks = np.column_stack([np.linspace(0.0, 18.0, 10), 4.0 * (-1.0) ** np.arange(10)])
    slam = LandmarkSlam(Increments(), RangeBearing(sigma_range=0.05, sigma_bearing=0.005))
    divided = DivideAndConquer(
        slam, DivideConfig(on=True, close_distance=4.0, close_landmarks=5000, gate=gate)
    )
    pose, covariance = np.zeros(3), np.diag([1e-4, 1e-4, 1e-5])[None]
    for number in range(8):
        step = np.array([0.9, 0.0, 0.0])
        pose = compose(pose, step)
        noisy = step + 1e-2 * rng.standard_normal(3) * [1.0, 1.0, 0.3]
        divided.step(Odometry(number + 1.0, noisy[None], np.ones(1), covariance=covariance))
        here = landmarks + (rotate(1.5 * np.arange(10.0), np.array([moved, 0.0])) if number >= 5 else 0.0)
        local = rotate(-pose[2], here - pose[:2])
        z = np.column_stack([np.hypot(*local.T), wrap(np.arctan2(local[:, 1], local[:, 0]))])
        divided.step(Sightings(number + 1.0, z + rng.standard_normal(z.shape) * [0.05, 0.005], np.arange(10)))
    return divided


def test_a_join_that_would_be_inconsistent_is_refused_and_the_maps_stay_side_by_side():
    good = _two_maps(0.0, 0.9999)
    assert good.maps_closed == 1 and good.finished().apart == 1
    bad = _two_maps(3.0, 0.9999)
    assert bad.finished().apart == 2
    estimate = bad.estimate()
    assert sorted(estimate.landmarks.ids) == list(range(10))
    assert np.isfinite(estimate.joint()[1]).all()
    np.testing.assert_allclose(estimate.pose[:2], [7.2, 0.0], atol=0.3)


def test_a_robot_that_never_moves_closes_no_map():
    slam = DivideAndConquer(
        LandmarkSlam(Increments(sigma_rotation=0.0)), DivideConfig(on=True, close_landmarks=3)
    )
    for number in range(20):
        slam.step(Odometry(float(number), np.zeros((1, 3)), np.ones(1), covariance=np.zeros((1, 3, 3))))
        slam.step(Sightings(float(number), np.array([[5.0, 0.1], [4.0, -0.5], [6.0, 0.7]]), np.arange(3)))
    assert slam.maps_closed == 0
    assert len(slam.estimate().landmarks) == 3
    assert np.isfinite(slam.estimate().joint()[1]).all()


def test_nothing_seen_at_all_is_an_estimate_too():
    slam = DivideAndConquer(LandmarkSlam(), SMALL)
    assert len(slam.estimate().landmarks) == 0
    assert len(slam.estimate().trajectory.times) == 0


def test_settings_that_contradict_each_other_are_refused(course):
    for changes in (
        {"association": AssociationConfig(method="mda")},
        {"finite_set": FiniteSetConfig(method="rb-phd")},
    ):
        config = msgspec.structs.replace(RunConfig(), divide=DivideConfig(on=True), **changes)
        with pytest.raises(ConfigError, match="divide"):
            slam_from_config(config, course)


def test_a_map_too_large_for_its_joint_covariance_is_written_without_it(course, tmp_path, monkeypatch):
    from datetime import UTC, datetime

    from kalmap.slam.submaps import finished
    from kalmap.study.present import save_run

    monkeypatch.setattr(finished, "JOINT_LIMIT", 20)
    _, outcome, config = _run(course)
    save_run(tmp_path / "out", outcome, course, config, started=datetime.now(UTC), figures=False)
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert "landmarks.csv" in written and "map.kalmap" not in written


def test_the_command_divides(tmp_path):
    answer = kalmap_inside("run", "course-35", "--divide", "--no-figures", "--out", tmp_path / "out")
    assert answer.code == 0 and "divided" in answer.out
    assert len(read_map_file(tmp_path / "out" / "map.kalmap").landmark_ids) == 35
    refused = kalmap_inside("run", "course-35", "--divide", "--method", "rb-phd", "--out", tmp_path / "no")
    assert refused.code == 2 and "--divide" in refused.error


@pytest.mark.slow
def test_the_live_step_does_not_grow_and_does_not_wait():
    """Steps of the first and of the last fifth of a lawn, joins in the background: the same time, medians and most."""
    log = simulate(world_by_name("lawn-1000"), 1)
    config = msgspec.structs.replace(log.defaults, divide=DivideConfig(on=True, background=True))
    outcome = run(slam_from_config(config, log), log, reckon=False)
    assert outcome.error is None
    seconds = outcome.trace.step_seconds
    first, last = seconds[: len(seconds) // 5], seconds[-len(seconds) // 5 :]
    assert np.mean(last) < 2.0 * np.mean(first)
    assert np.percentile(last, 99) < 0.2
