"""Scans stamped late or early. Oracles: shifted clocks, interpolation, numerical differences, dense algebra."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from contour_rooms import block_log, events_of, mapper
from kalmap.data.coreslam import evened
from kalmap.data.drive import Drive, interpolated
from kalmap.data.laser_classes import stamps_tell
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels import contour_state as state
from kalmap.kernels.packed import pack, unpack
from kalmap.models import Increments
from kalmap.records import Odometry, Scan
from kalmap.slam.contours.late import Late

MOTION = Increments()


def odometry(steps, durations, covariance=None) -> Odometry:
    return Odometry(0.0, np.array(steps, dtype=float), np.array(durations, dtype=float), covariance)


def wild_steps(count, seed):
    """Steps of a vehicle whose speed changes all the time, and how long each took."""
    rng = np.random.default_rng(seed)
    return rng.normal([0.1, 0.0, 0.0], [0.05, 0.01, 0.15], (count, 3)), rng.uniform(0.03, 0.2, count)


def fed(steps, durations, latency, covariance=None):
    """The events as they are after the shift, and what is known in the end."""
    late, events = Late(), []
    for k, (step, took) in enumerate(zip(steps, durations, strict=True)):
        event = odometry([step], [took], None if covariance is None else covariance[k : k + 1])
        after = late.after(event, MOTION)
        events.append(shifted(late, after, event, latency, MOTION)[0])
        late = after
    return events, late


def way_of(events):
    way = np.zeros(3)
    for event in events:
        for values in event.values:
            way = compose(way, values)
    return way


@pytest.mark.parametrize("latency", [0.02, 0.1, 0.35])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_way_is_that_of_a_clock_set_back(latency, seed):
    """Oracle: the poses of all steps, interpolated at the earlier instants."""
    steps, durations = wild_steps(60, seed)
    times, poses = np.concatenate([[0.0], np.cumsum(durations)]), [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    events, _ = fed(steps, durations, latency)
    for count in (20, 45, 60):
        expected = interpolated(times, np.array(poses), times[count : count + 1] - latency)[0][0]
        found = way_of(events[:count])
        assert np.allclose(found[:2], expected[:2], atol=1e-12) and abs(wrap(found[2] - expected[2])) < 1e-12
    assert all(len(event.values) <= 1 for event in events)


def test_no_latency_changes_nothing():
    steps, durations = wild_steps(5, 3)
    for event, step in zip(fed(steps, durations, 0.0)[0], steps, strict=True):
        assert event.values.tobytes() == step[None].tobytes()


@pytest.mark.parametrize("latency", [-0.2, -0.05])
def test_early_stamps_look_ahead_at_the_speed_of_the_moment(latency):
    """Oracle: at a constant twist the way is the same as ever; behind a stop nothing of what was guessed is left."""
    steps = [[0.1, 0.0, 0.05]] * 20 + [[0.0, 0.0, 0.0]] * 20
    events, _ = fed(steps, [0.1] * 40, latency)
    for event in events[3:20]:
        assert np.allclose(event.values, [steps[0]], atol=1e-12)
    whole = np.zeros(3)
    for step in steps:
        whole = compose(whole, np.array(step))
    assert np.allclose(way_of(events), whole, atol=1e-12)


@pytest.mark.parametrize("latency", [0.13, 0.31])
def test_what_a_second_of_latency_would_change(latency):
    """Oracle: numerical differences of the shifted way; the speed changes slowly against what it is averaged on."""
    t = np.arange(200) * 0.02
    steps = 0.02 * np.column_stack([0.5 + 0.3 * np.sin(t), np.zeros(200), 0.8 * np.cos(1.3 * t)])
    late = Late()
    for step in steps[:-1]:
        late = late.after(odometry([step], [0.02]), MOTION)
    event = odometry([steps[-1]], [0.02])
    after = late.after(event, MOTION)
    _, effect = shifted(late, after, event, latency, MOTION)
    less, more = (way_of([shifted(late, after, event, latency + d, MOTION)[0]]) for d in (-0.01, 0.01))
    assert np.allclose(effect, (more - less) / 0.02, atol=2e-4)
    assert np.abs(effect).max() > 2e-3


def test_stated_covariances_move_along():
    """Two thirds of a step's covariance come with the first event behind it, the rest with the second."""
    covariance = np.zeros((3, 3, 3))
    covariance[1] = np.diag([0.9, 0.6, 0.3])
    events, _ = fed([[0.1, 0.0, 0.0]] * 3, [0.1] * 3, 0.1 / 3.0, covariance)
    given = [event.covariance.sum(axis=0) for event in events]
    assert np.allclose(given[1], covariance[1] * 2.0 / 3.0) and np.allclose(given[2], covariance[1] / 3.0)


def test_covariances_that_only_some_steps_state():
    """What nobody states is the motion model's own."""
    late = Late().after(odometry([[0.1, 0.0, 0.0]], [0.1]), MOTION)
    event = odometry([[0.2, 0.0, 0.1]], [0.1], np.diag([0.3, 0.2, 0.1])[None])
    moved, _ = shifted(late, late.after(event, MOTION), event, 0.05, MOTION)
    assert np.allclose(moved.values[0], [0.05, 0.0, 0.0]) and len(moved.values) == 2
    assert np.allclose(moved.covariance[0], MOTION.control_covariance(moved.values[0], 0.05))
    assert np.allclose(moved.covariance[1], np.diag([0.15, 0.1, 0.05]))


def test_blame_of_the_latency():
    """Oracle: F P F' with dense matrices."""
    rng = np.random.default_rng(5)
    n = state.SAMPLES + 6
    root = rng.standard_normal((n, n))
    dense, packed = root @ root.T, np.empty(n * (n + 1) // 2)
    pack(dense, n, packed)
    effect = np.array([0.3, -0.2, 0.7])
    state.blame_latency(packed, n, effect)
    turned, found = np.eye(n), np.empty((n, n))
    turned[:3, state.LATENCY] += effect
    unpack(packed, n, found)
    assert np.allclose(found, turned @ dense @ turned.T, rtol=1e-13, atol=1e-13)


def late_events(log, latency, scans=None):
    """The events of a log whose scanner's stamps are `latency` s late: the odometry is that of the later instants."""
    events = [event for event in events_of(log, scans) if isinstance(event, Scan)]
    steps = [event for event in events_of(log, scans) if isinstance(event, Odometry)]
    times, poses = np.array([scan.time for scan in events]), np.zeros((len(events), 3))
    for k, event in enumerate(steps[1:], start=1):
        poses[k] = compose(poses[k - 1], way_of([event]))
    moved = interpolated(times, poses, times + latency)[0]
    way = compose(inverse(moved[:-1]), moved[1:])
    took = np.diff(times)
    yield Odometry(times[0] + latency, np.zeros((0, 3)), np.zeros(0))
    for k, scan in enumerate(events):
        if k:
            yield Odometry(times[k] + latency, way[k - 1 : k], took[k - 1 : k])
        yield msgspec.structs.replace(scan, time=times[k] + latency)


def driven(log, latency, **settings):
    slam = mapper(log, **settings)
    for event in late_events(log, latency):
        slam.step(event)
    return slam.estimate()


def heading_error(log, estimate):
    truth = log.references[0]
    return np.sqrt(np.mean(wrap(estimate.trajectory.poses[:, 2] - truth.headings) ** 2))


@pytest.mark.parametrize("latency", [-0.08, 0.0, 0.15])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_latency_of_a_drive(latency, seed):
    """A fast drive round a block. Oracle: by how much the stamps were shifted.

    Measured, seeds 1, 2: 0.008 to 0.025 s more than it is, since the odometry's noise stands in the speeds, too. The
    heading's RMS with a latency of 0.15 s: 2.7 to 2.8 mrad, and 3.8 to 4.2 where it is not estimated.
    """
    log = block_log(seed, speed=1.0)
    estimate = driven(log, latency, sigma_latency=0.1, sigma_stamp=0.01)
    found, sigma = estimate.counts["latency_s"], estimate.counts["latency_sigma_s"]
    assert abs(found - latency) < 2.5 * sigma and sigma < 0.02
    if latency > 0.1:
        plain = driven(log, latency)
        assert heading_error(log, estimate) < 0.85 * heading_error(log, plain)


def test_stamps_doubted_by_chance():
    """Oracle: (v, w) (v, w)' of the vehicle's speed, twice, of this scan's stamp and the one before."""
    log = block_log(1)
    slam = mapper(log)
    for event in events_of(log, 30):
        slam.step(event)
    live = slam._live
    before, heading = live.pose_covariance, live.pose[2]
    live.doubt(np.array([2.0, 0.0, 1.5]), 0.03)
    moving = np.array([2.0 * math.cos(heading), 2.0 * math.sin(heading), 1.5])
    assert np.allclose(live.pose_covariance - before, 2 * 0.03**2 * np.outer(moving, moving), atol=1e-15)


def drive_with(stamps, poses):
    count = len(stamps)
    return Drive(
        file="made", stamps=stamps, records=np.arange(1, count + 1), poses=poses,
        ranges=[np.ones(3)] * count, bearings=[np.array([-0.1, 0.0, 0.1])] * count,
    )  # fmt: skip


@pytest.mark.parametrize(("jitter_of", "tells"), [("both", True), ("stamps", False), ("neither", True)])
def test_whether_stamps_tell_the_speed(jitter_of, tells):
    """A robot that goes faster and slower. Poses of the uneven instants that the stamps say, or of even ones."""
    rng = np.random.default_rng(7)
    even = 0.1 * np.arange(400)
    uneven = even + rng.uniform(-0.03, 0.03, 400)
    read = uneven if jitter_of == "both" else even
    poses = np.zeros((400, 3))
    poses[:, 0] = 0.8 * read + 0.3 * np.sin(0.5 * read)
    stamps = even if jitter_of == "neither" else uneven
    assert stamps_tell(drive_with(stamps, poses)) is tells


def test_a_robot_that_hardly_moves_or_a_clock_that_is_set_back_tells_nothing():
    stamps, poses = 0.1 * np.arange(100), np.zeros((100, 3))
    assert not stamps_tell(drive_with(stamps, poses))
    poses[:, 0] = 0.1 * np.arange(100)
    assert stamps_tell(drive_with(stamps, poses))
    stamps[40:] -= 3.0
    stamps[60:] -= 3.0
    assert not stamps_tell(drive_with(stamps, poses))


def test_evened_stamps():
    """Oracle: the instants before noise was added; a computer that hangs for a second is late for some lines only."""
    rng = np.random.default_rng(3)
    true = 5.0 + 0.0987 * np.arange(600)
    stamps = true + rng.uniform(0.0, 0.06, 600)
    stamps[300:305] += 0.2
    left = evened(stamps) - true
    assert left.std() < 0.007 < (stamps - true).std() / 3.0
    assert evened(stamps[:20]).tobytes() == stamps[:20].tobytes()
