"""Worlds for random finite sets: looks, clutter and misses as their sources state them, everything in its place."""

import math

import msgspec
import numpy as np
import pytest
from scipy import stats

from kalmap.cli.source import find_world
from kalmap.geometry.angles import wrap
from kalmap.records import ConfigError
from kalmap.simulate import World, drive, mover_tracks, simulate, world_by_name
from kalmap.simulate.sense import visible
from kalmap.simulate.set_worlds import FIELD_AREA, PHD_AREA, RFS_CLUTTER_AREA
from simulated_logs import by_identity, exact, flat, looks

# features, looks, P_D, clutter a look
STATED = {
    "phd-1": (39, 726, 0.95, 1.0),
    "phd-2": (39, 726, 0.95, 2.0),
    "phd-3": (39, 726, 0.95, 3.0),
    "field-160": (160, 4000, 0.95, 5.0),
    "rfs-99-0": (50, 3000, 0.99, 0.001),
    "rfs-90-1": (50, 3000, 0.9, 1.3),
    "rfs-70-6": (50, 3000, 0.7, 5.8),
    "rfs-50-13": (50, 3000, 0.5, 12.6),
    "clutter-20-70": (35, 2105, 0.7, 20.0),
    "clutter-50": (35, 2105, 1.0, 50.0),
    "missed-50": (35, 2105, 0.5, 0.0),
}
OPEN = World(name="open", landmarks=np.array([[500.0, 0.0]]), waypoints=np.array([[60.0, 0.0]]), laps=1)


def in_view(world):
    """Frame (M,) and feature (M,) of what stands in view."""
    return visible(looks(world), world.landmarks, world.max_range, world.field_of_view_deg, world.min_range)[
        :2
    ]


@pytest.mark.parametrize("name", STATED)
def test_a_world_has_the_looks_clutter_and_misses_that_are_stated(name):
    """Oracle: 99.9 % bounds of the binomial and the Poisson distribution."""
    features, count, detection, clutter = STATED[name]
    world = world_by_name(name)
    assert len(world.landmarks) == features and len(looks(world)) == count
    assert round(world.clutter, 1 if clutter > 1 else 3) == clutter
    _, ids, _ = flat(simulate(world, 1))
    seen, there = (ids >= 0).sum(), len(in_view(world)[0])
    assert abs(seen / there - detection) <= 3.3 * math.sqrt(detection * (1 - detection) / there)
    low, high = stats.poisson.interval(0.999, world.clutter * count) if clutter else (0, 0)
    assert low <= (ids < 0).sum() <= high


@pytest.mark.parametrize("name", STATED)
def test_what_is_seen_is_within_range(name):
    world = world_by_name(name)
    number, ids, values = flat(simulate(world, 2))
    false = ids < 0
    true = exact(looks(world)[number[~false]], world.landmarks[ids[~false]])
    for ranges in (values[false, 0], true[:, 0]):
        assert ((ranges >= world.min_range) & (ranges <= world.max_range)).all()
    half = math.radians(world.field_of_view_deg) / 2
    for bearings in (values[false, 1], true[:, 1]):
        assert (np.abs(bearings) <= half + 1e-12).all()


@pytest.mark.parametrize(("name", "area"), [("phd-2", PHD_AREA), ("field-160", FIELD_AREA)])
def test_published_squares_hold_everything_and_all_of_it_is_seen(name, area):
    world = world_by_name(name)
    side = {"phd-2": 120.0, "field-160": 1000.0}[name]
    assert area[2] - area[0] == area[3] - area[1] == side
    for points in (world.landmarks, drive(world).poses[:, :2]):
        assert (points >= area[:2]).all() and (points <= area[2:]).all()
    assert (np.ptp(world.landmarks, axis=0) > 0.9 * side).all()
    frame, feature = in_view(world)
    assert np.bincount(feature, minlength=len(world.landmarks)).min() >= 20
    fifth = len(looks(world)) // 5
    early, late = (set(feature[part].tolist()) for part in (frame < fifth, frame >= 4 * fifth))
    assert len(early & late) >= 8


def test_only_the_clutter_differs_from_one_phd_world_to_the_next():
    one, three = (simulate(world_by_name(f"phd-{mean}"), 4) for mean in (1, 3))
    np.testing.assert_array_equal(by_identity(one), by_identity(three))


def test_the_fields_steering_noise_is_a_turn_rate():
    world = world_by_name("field-160")
    turn = world.speed / world.wheelbase * math.sin(math.radians(world.sigma_steering_deg))
    assert math.degrees(turn) == pytest.approx(0.5, rel=1e-4)
    assert (world.sigma_speed, world.sigma_range, world.sigma_bearing_deg) == (0.8, 0.8, 0.3)


def test_the_rfs_vehicle_strays_as_fast_as_theirs():
    """Oracle: 0.1 s of velocities with a variance of 0.002 in x, y and heading each."""
    world = world_by_name("rfs-90-1")
    true = drive(world).steering
    controls = np.concatenate([event.values for event in simulate(world, 3) if hasattr(event, "durations")])
    clean, noisy = (
        0.1 * np.column_stack([speed * np.cos(steering), speed * np.sin(steering)])
        for speed, steering in ((0.2, true), controls.T)
    )
    assert ((noisy - clean) ** 2).sum(axis=1).mean() == pytest.approx(2 * 0.002 * 0.1**2, rel=0.06)
    turned = 0.1 * world.speed / world.wheelbase * (np.sin(controls[:, 1]) - np.sin(true))
    assert 0.85 < (turned**2).mean() / (0.002 * 0.1**2) < 1.0  # less in the turns, by cos^2 of the steering
    np.testing.assert_allclose(world.sigma_range**2, 0.0005)
    np.testing.assert_allclose(math.radians(world.sigma_bearing_deg) ** 2, 0.00005)


def test_the_rfs_course_is_of_their_kind():
    world = world_by_name("rfs-50-13")
    assert world.clutter == RFS_CLUTTER_AREA == pytest.approx(4.0 * math.pi)
    poses = drive(world).poses
    segments = wrap(np.diff(poses[:, 2])).reshape(20, 150).sum(axis=1) / 15.0
    assert np.abs(segments).max() < 0.5 and np.ptp(segments) > 0.6
    offsets = world.landmarks - poses[60 * np.arange(50), :2]
    assert stats.kstest(np.hypot(*offsets.T), "uniform", (0.0, 2.5)).pvalue > 0.01
    frame, feature = in_view(world)
    assert len(set(feature.tolist())) == 50 and (np.bincount(frame, minlength=3000) > 0).all()


def test_detection_fades_straight_with_the_range():
    """Oracle: the binomial distribution in each of six rings; the same world in which nothing fades."""
    world = world_by_name("faded-35")
    assert (world.detection_probability, world.detection_far) == (0.95, 0.3)
    whole = {tuple(row) for row in by_identity(simulate(world_by_name("course-35"), 1))}
    rows = {tuple(row) for row in by_identity(simulate(world, 1))}
    assert rows < whole
    frame, feature = in_view(world)
    ranges = exact(looks(world)[frame], world.landmarks[feature])[:, 0]
    kept = {row[:2] for row in rows}
    seen = np.array([pair in kept for pair in zip(frame, feature)])
    ring = (ranges // 5).astype(int)
    for number in range(6):
        here = ring == number
        expected = 0.95 - 0.65 * ranges[here] / 30.0
        bound = 3.3 * math.sqrt((expected * (1 - expected)).sum())
        assert here.sum() > 30 and abs(seen[here].sum() - expected.sum()) < bound


def test_movers_fade_too_and_a_flat_profile_changes_nothing():
    corners = np.array([[0.0, -40.0], [90.0, 40.0]])
    crowd = msgspec.structs.replace(OPEN, landmarks=corners, movers=200, detection_probability=0.6)
    flat_profile = msgspec.structs.replace(crowd, detection_far=0.6)
    plain, same = (flat(simulate(world, 1)) for world in (crowd, flat_profile))
    for mine, theirs in zip(plain, same, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    far = flat(simulate(msgspec.structs.replace(crowd, detection_far=0.0), 1))[2][:, 0]
    assert 0 < (far > 27.0).sum() < 0.1 * (plain[2][:, 0] > 27.0).sum()


def test_five_of_the_restless_features_move_slowly():
    world = world_by_name("restless-35")
    assert (len(world.landmarks), world.movers, world.mover_speed) == (30, 5, 0.1)
    np.testing.assert_array_equal(world.landmarks, world_by_name("course-35").landmarks[:30])
    poses = looks(world)
    moved, met = [], []
    for seed in range(8):
        tracks = mover_tracks(world, seed, len(poses))
        half = len(poses) // 2
        moved.append(np.hypot(*(tracks[half:] - tracks[: len(tracks) - half]).mean(axis=0).T))
        met.append(len(visible(poses, tracks, 30.0, 180.0)[0]) / len(poses))
    assert 3.0 < np.mean(moved) < 20.0
    assert 0.05 < np.mean(met) < 0.4
    _, ids, _ = flat(simulate(world, 1))
    there = len(in_view(world)[0])
    assert abs((ids >= 0).sum() / there - 0.9) < 3.3 * math.sqrt(0.09 / there)


def test_the_smallest_range():
    near = msgspec.structs.replace(OPEN, landmarks=np.array([[60.0, 3.0]]), clutter=20.0, min_range=25.0)
    number, ids, values = flat(simulate(near, 1))
    assert values[ids < 0, 0].min() == pytest.approx(25.0, abs=0.05)
    assert stats.kstest(values[ids < 0, 0], "uniform", (25.0, 5.0)).pvalue > 0.01
    true = exact(looks(near)[number[ids >= 0]], near.landmarks[0])
    assert len(true) > 5 and true[:, 0].min() >= 25.0


TRUNKS = {"scanner": "sick", "radii": np.array([0.2])}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"min_range": -1.0}, "min_range must be zero or more"),
        ({"min_range": 30.0}, r"min_range must be below max_range \(30 m\)"),
        ({"detection_far": 1.5}, "detection_far must be a probability"),
        ({"detection_far": math.nan}, "detection_far must be a probability"),
        ({**TRUNKS, "detection_far": 1.0}, ".*a scanner has none of them"),
        ({**TRUNKS, "min_range": 1.0}, ".*a scanner has none of them"),
    ],
)
def test_what_cannot_be_is_refused(change, problem):
    with pytest.raises(ConfigError, match=f"world open: {problem}"):
        msgspec.structs.replace(OPEN, **change)


@pytest.mark.parametrize("name", ["phd-", "phd-1001", "field-100", "rfs-80-1", "clutter-20-50", "faded-70"])
def test_worlds_that_do_not_exist(name):
    with pytest.raises(ConfigError):
        world_by_name(name)


def test_the_profile_can_be_set_on_the_command_line():
    world = find_world("phd-1", {"detection_far": 0.5, "min_range": 1})
    assert (world.detection_far, world.min_range) == (0.5, 1)
    with pytest.raises(ConfigError, match="expected a number"):
        find_world("phd-1", {"detection_far": "none"})
