from pathlib import Path

import numpy as np
import pytest

from kalmap.records import ConfigError, Sightings
from kalmap.simulate import (
    course_world,
    drive,
    lawn_world,
    random_landmarks,
    simulate,
    wide_world,
    world_by_name,
    world_names,
)

BAILEY = Path(__file__).parents[2] / "shared" / "data" / "bailey_sim" / "example_webmap.mat"


def counts(log):
    return np.array([len(event.ids) for event in log if isinstance(event, Sightings)])


def maps(name):
    loadmat = pytest.importorskip("scipy.io").loadmat
    contents = loadmat(BAILEY.with_name(f"{name}.mat"))
    return contents["lm"].T.astype(float), contents["wp"].T.astype(float)


def test_the_course_is_closed_gentle_and_of_the_right_length():
    world = world_by_name("course-35")
    assert world.landmarks.shape == (35, 2) and world.waypoints.shape == (17, 2)
    legs = np.hypot(*np.diff(world.waypoints, axis=0, prepend=world.waypoints[-1:]).T)
    assert 600 < legs.sum() < 700
    np.testing.assert_allclose(world.waypoints[-1], 0, atol=1e-9)
    x, y = world.waypoints.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area > 10_000  # anticlockwise
    poses = drive(world).poses
    assert len(poses) == pytest.approx(2 * legs.sum() / (world.speed * world.dt), rel=0.03)
    gaps = np.hypot(*(world.landmarks[:, None] - poses[None, ::10, :2]).transpose(2, 0, 1)).min(axis=1)
    assert gaps.min() > 1 and gaps.max() < 25


def test_the_course_does_not_cross_itself():
    points = drive(world_by_name("course-35")).poses[1000:9400:20, :2]  # within one lap
    apart = np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points))))
    distance = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    assert distance[(apart > 20) & (apart < len(points) - 25)].min() > 15


def test_the_course_shows_one_to_three_features_and_both_laps_the_same():
    log = simulate(world_by_name("course-35"), 1)
    seen = counts(log)
    assert 1.2 < seen.mean() < 3 and seen.max() <= 4
    frames = [event.ids for event in log if isinstance(event, Sightings)]
    half = len(frames) // 2
    first, second = (set(np.concatenate(part).tolist()) for part in (frames[:half], frames[half:]))
    assert len(first & second) >= 30


def test_a_smaller_courses_features_are_the_first_of_a_larger_ones():
    small, large = course_world(35), course_world(70)
    np.testing.assert_array_equal(small.landmarks, large.landmarks[:35])
    np.testing.assert_array_equal(small.waypoints, large.waypoints)


def test_set_b_has_twice_the_control_noise():
    a, b = world_by_name("course-35"), world_by_name("course-70")
    assert (b.sigma_speed, b.sigma_steering_deg) == (2 * a.sigma_speed, 2 * a.sigma_steering_deg)
    assert (b.sigma_range, b.sigma_bearing_deg) == (a.sigma_range, a.sigma_bearing_deg)
    assert len(b.landmarks) == 70


@pytest.mark.parametrize(
    "name", ["course-1", "course-200", "same-100", "wide-5", "wide-100", "lawn-9", "lawn-50", "lawn-100"]
)
def test_every_kind_of_world_arrives(name):
    world = world_by_name(name)
    assert world.name == name and len(world.landmarks) == int(name.split("-")[1])
    assert counts(simulate(world, 1)).sum() > 0


def test_wide_and_lawn_keep_the_number_in_view():
    wide = [counts(simulate(wide_world(n), 1)).mean() for n in (100, 400)]
    lawn = [counts(simulate(lawn_world(n), 1)).mean() for n in (100, 400)]
    assert all(0.3 < mean < 1.5 for mean in wide)
    assert all(3 < mean < 6 for mean in lawn)
    assert lawn_world(100).laps == 1


def test_overrides():
    world = course_world(10, name="mine", laps=1, sigma_range=0.5)
    assert (world.name, world.laps, world.sigma_range) == ("mine", 1, 0.5)


@pytest.mark.parametrize(
    "name",
    ["", "course", "course-0", "course--1", "mars-35", "lawn-3", "wide-2", "course-35 ", "same-9999999"],
)
def test_unknown_worlds_are_refused(name):
    with pytest.raises(ConfigError):
        world_by_name(name)


def test_bailey_needs_its_map():
    with pytest.raises(ConfigError, match="example_webmap"):
        world_by_name("bailey-35")


def test_names_begin_with_the_default_and_can_be_made():
    names = world_names()
    assert names[0] == "course-35"
    for name in names:
        if not name.startswith("bailey"):
            world_by_name(name.replace("<N>", "40"))


def test_random_landmarks_fill_their_box():
    points = random_landmarks(2000, (-130, -100, 105, 95), np.random.default_rng(1))
    np.testing.assert_allclose(points.min(axis=0), [-130, -100], atol=1)
    np.testing.assert_allclose(points.max(axis=0), [105, 95], atol=1)
    with pytest.raises(ConfigError):
        random_landmarks(-1, (0, 0, 1, 1), np.random.default_rng(1))


@pytest.mark.skipif(not BAILEY.exists(), reason="Bailey's map is not here")
def test_baileys_world_has_as_many_steps_as_his_own_simulator():
    set_a, set_b = world_by_name("bailey-35", maps), world_by_name("bailey-70", maps)
    assert abs(len(drive(set_a).steering) - 17_381) <= 5
    assert (len(set_a.landmarks), len(set_b.landmarks)) == (35, 70)
    np.testing.assert_array_equal(set_a.landmarks, set_b.landmarks[:35])
    assert (set_b.sigma_speed, set_b.sigma_steering_deg) == (0.6, 6.0)
    low, high = set_b.landmarks[35:].min(axis=0), set_b.landmarks[35:].max(axis=0)
    assert (low >= [-130, -100]).all() and (high <= [105, 95]).all()
