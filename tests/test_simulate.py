import math
import pickle
import time
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from kalmap.geometry.angles import wrap
from kalmap.records import ConfigError, KalmapError, Odometry, Sightings
from kalmap.simulate import World, drive, simulate, world_by_name
from kalmap.simulate.sense import visible


@pytest.fixture(scope="module")
def course():
    return world_by_name("course-35")


def split(log):
    events = list(log)
    odometry = [event for event in events if isinstance(event, Odometry)]
    return events, odometry, [event for event in events if isinstance(event, Sightings)]


def test_the_same_seed_gives_the_same_log_and_another_seed_another(course):
    first, again, other = (split(simulate(course, seed)) for seed in (7, 7, 8))
    for a, b in zip(first[0], again[0], strict=True):
        assert a.time == b.time
        np.testing.assert_array_equal(a.values, b.values)
    assert not np.array_equal(first[1][0].values, other[1][0].values)


def test_events_alternate_and_times_match_the_control_steps(course):
    events, odometry, frames = split(simulate(course, 1))
    assert all(type(a) is not type(b) for a, b in pairwise(events))
    assert [event.time for event in events] == sorted(event.time for event in events)
    steps = 0
    for block in odometry:
        assert 1 <= len(block.values) <= course.observe_every
        assert block.values.shape == (len(block.durations), 2)
        steps += len(block.values)
        assert block.time == pytest.approx(steps * course.dt, abs=1e-9)
    assert steps == len(drive(course).steering)
    assert len(frames) == steps // course.observe_every
    for frame in frames:
        assert frame.values.shape == (len(frame.ids), 2) and frame.ids.dtype == np.int64


def test_the_reference_is_the_noise_free_drive(course):
    log = simulate(course, 1)
    (truth,) = log.references
    poses = drive(course).poses
    assert (truth.frame, truth.kind) == ("map", "truth")
    assert truth.times[0] == 0 and len(truth.times) == len(poses)
    np.testing.assert_array_equal(np.column_stack([truth.positions, truth.headings]), poses)
    np.testing.assert_array_equal(truth.landmarks, course.landmarks)
    assert truth.landmark_ids.dtype == np.int64


def test_the_drive_obeys_its_motion_model_and_limits(course):
    path = drive(course)
    x, y, heading = path.poses[:-1].T
    step = course.speed * course.dt
    expected = np.column_stack(
        [
            x + step * np.cos(path.steering + heading),
            y + step * np.sin(path.steering + heading),
            wrap(heading + step * np.sin(path.steering) / course.wheelbase),
        ]
    )
    np.testing.assert_allclose(path.poses[1:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(path.poses[1:, 2] - expected[:, 2]), 0, atol=1e-9)
    assert np.abs(path.steering).max() <= math.radians(course.max_steering_deg)
    change = np.abs(np.diff(path.steering, prepend=0.0)).max()
    assert change <= math.radians(course.steering_rate_deg) * course.dt + 1e-12
    assert np.hypot(*(path.poses[-1, :2] - course.waypoints[-1])) < course.at_waypoint


def test_noise_has_the_stated_spread(course):
    log = simulate(course, 3)
    _, odometry, frames = split(log)
    controls = np.concatenate([block.values for block in odometry])
    path = drive(course)
    assert np.std(controls[:, 0] - course.speed) == pytest.approx(0.3, rel=0.03)
    assert np.std(np.degrees(controls[:, 1] - path.steering)) == pytest.approx(3.0, rel=0.03)
    errors = []
    for pose, frame in zip(path.poses[8::8], frames, strict=True):
        offset = course.landmarks[frame.ids] - pose[:2]
        exact = np.column_stack([np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]])
        error = frame.values - exact
        error[:, 1] = wrap(error[:, 1])
        errors.append(error)
    spread = np.concatenate(errors).std(axis=0)
    assert spread[0] == pytest.approx(0.1, rel=0.06)
    assert math.degrees(spread[1]) == pytest.approx(1.0, rel=0.06)


def test_the_sensor_sees_what_is_near_and_ahead_and_nothing_else(course):
    looks = drive(course).poses[8::8]
    frame, feature, values = visible(looks, course.landmarks, 30.0, 180.0)
    seen = set(zip(frame.tolist(), feature.tolist()))
    for number in range(0, len(looks), 50):
        x, y, heading = looks[number]
        for row, (u, v) in enumerate(course.landmarks):
            ahead = (u - x) * math.cos(heading) + (v - y) * math.sin(heading) > 0
            assert ((number, row) in seen) == (ahead and math.hypot(u - x, v - y) < 30.0)
    assert (values[:, 0] < 30).all() and (np.abs(values[:, 1]) <= np.pi / 2).all()


@pytest.mark.parametrize(
    ("field_of_view_deg", "rows"), [(90, [0]), (180, [0, 1]), (270, [0, 1]), (360, [0, 1, 2, 3])]
)
def test_field_of_view(field_of_view_deg, rows):
    landmarks = np.array([[10.0, 1.0], [1.0, 10.0], [-10.0, 0.0], [-10.0, 0.5], [40.0, 0.0]])
    _, feature, _ = visible(np.zeros((1, 3)), landmarks, 30.0, field_of_view_deg)
    assert feature.tolist() == rows


def test_frames_with_nothing_in_view_are_still_there():
    world = World(name="empty", landmarks=np.array([[500.0, 0.0]]), waypoints=np.array([[20.0, 0.0]]), laps=1)
    _, _, frames = split(simulate(world, 1))
    assert frames and all(frame.values.shape == (0, 2) and frame.ids.shape == (0,) for frame in frames)
    bare = msgspec.structs.replace(world, landmarks=np.zeros((0, 2)))
    assert len(split(simulate(bare, 1))[2]) == len(frames)


def test_worlds_that_differ_in_noise_only_share_their_random_numbers(course):
    loud = msgspec.structs.replace(course, sigma_speed=0.6, sigma_steering_deg=6.0)
    quiet_blocks, loud_blocks = (split(simulate(world, 5))[1] for world in (course, loud))
    np.testing.assert_allclose(
        2 * (quiet_blocks[3].values[:, 0] - 3.0), loud_blocks[3].values[:, 0] - 3.0, atol=1e-12
    )


def test_defaults_carry_the_worlds_own_parameters(course):
    world = msgspec.structs.replace(course, wheelbase=2.5, sigma_speed=0.5, max_range=20.0, sigma_range=0.2)
    config = simulate(world, 1).defaults
    assert config.motion.model == "velocity-steering" and config.motion.sample_time == 0
    assert (config.motion.wheelbase, config.motion.sigma_speed) == (2.5, 0.5)
    assert (config.sensor.max_range, config.sensor.sigma_range) == (20.0, 0.2)


def test_a_log_can_be_read_twice_and_sent_to_a_worker(course):
    log = simulate(course, 1)
    assert len(list(log)) == len(list(log)) == len(list(pickle.loads(pickle.dumps(log))))


def test_a_waypoint_inside_the_turning_circle_is_given_up(course):
    world = msgspec.structs.replace(course, waypoints=np.array([[0.0, 8.0]]))
    with pytest.raises(KalmapError, match="way-point 1 of lap 1"):
        simulate(world, 1)


@pytest.mark.parametrize(
    "change",
    [
        {"landmarks": np.zeros((3, 3))},
        {"waypoints": np.zeros((0, 2))},
        {"landmarks": np.array([[np.nan, 0.0]])},
        {"speed": 0.0},
        {"sigma_speed": -1.0},
        {"sigma_range": 0.0},
        {"dt": math.inf},
        {"laps": 0},
        {"max_steering_deg": 90.0},
        {"field_of_view_deg": 361.0},
    ],
)
def test_a_world_that_cannot_be_is_refused(course, change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        msgspec.structs.replace(course, **change)


def test_a_drive_is_quick(course):
    best = math.inf
    for _ in range(3):
        started = time.process_time()
        simulate(course, 1)
        best = min(best, time.process_time() - started)
    assert best < 1.0  # 0.05 s of the processor, whatever else it does
