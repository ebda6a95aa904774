"""The worlds that break data association, by name: that they are driven, what they look like, scans of a grove."""

import math
import re

import msgspec
import numpy as np
import pytest
from scipy import stats
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from kalmap.cli.source import find_world
from kalmap.geometry.angles import wrap
from kalmap.records import ConfigError, Scan, Sightings
from kalmap.simulate import World, drive, mover_tracks, simulate, world_by_name, world_names
from simulated_logs import exact, flat, frames, looks

HERE = [
    name
    for name in world_names()
    if not re.search("<|bailey", name) and isinstance(world_by_name(name), World)
]
SIGHTED = [name for name in HERE if name != "grove"]
OPEN = World(name="open", landmarks=np.array([[500.0, 0.0]]), waypoints=np.array([[60.0, 0.0]]), laps=1)


@pytest.mark.parametrize("name", HERE)
def test_every_world_is_driven_to_its_end_and_can_be_simulated_again(name):
    world = world_by_name(name)
    assert world.name == name
    assert np.hypot(*(drive(world).poses[-1, :2] - world.waypoints[-1])) < world.at_waypoint
    log, again, other = simulate(world, 3), simulate(world_by_name(name), 3), simulate(world, 4)
    assert log.false_ids and len(frames(log)) == len(looks(world))
    for mine, same in zip(log, again, strict=True):
        assert mine.time == same.time
        np.testing.assert_array_equal(content(mine), content(same))
    assert any(
        content(a).shape != content(b).shape or not np.array_equal(content(a), content(b))
        for a, b in zip(frames(log), frames(other), strict=True)
    )


def content(event):
    return event.ranges if isinstance(event, Scan) else event.values


@pytest.mark.parametrize("name", SIGHTED)
def test_ids_are_the_truth(name):
    """Oracle: range and bearing from the true pose to the feature that the id names, within 5.5 sigma."""
    world = world_by_name(name)
    number, ids, values = flat(simulate(world, 2))
    known = ids >= 0
    errors = values[known] - exact(looks(world)[number[known]], world.landmarks[ids[known]])
    errors[:, 1] = wrap(errors[:, 1])
    sigmas = np.array([world.sigma_range, math.radians(world.sigma_bearing_deg)])
    assert np.abs(errors / sigmas).max() < 5.5
    np.testing.assert_allclose((errors / sigmas).std(axis=0), 1.0, atol=0.05)
    false = not known.all()
    assert false == bool(world.clutter or world.movers)


def test_the_papers_world():
    world = world_by_name("djnn-10")
    assert world.landmarks.shape == (252, 2) and (world.movers, world.max_range) == (10, 30.0)
    assert np.ptp(world.landmarks, axis=0).max() <= 120.0 and np.ptp(world.landmarks, axis=0).min() > 115.0
    assert cKDTree(world.landmarks).query(world.landmarks, 2)[0][:, 1].min() >= 1.5 - 2e-3
    poses = drive(world).poses
    assert cKDTree(world.landmarks).query(poses[:, :2])[0].min() > 1.9
    x, y = poses[:, :2].T
    assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 5_000  # anticlockwise
    assert np.hypot(x[-1], y[-1]) < 1.0 and abs(wrap(poses[-1, 2])) < 0.1
    number, ids, _ = flat(simulate(world, 1))
    counts = np.bincount(ids[ids >= 0], minlength=252)
    assert counts.min() >= 5
    early, late = (set(ids[part & (ids >= 0)].tolist()) for part in (number < 50, number > number.max() - 50))
    assert len(early & late) > 10
    assert len(world_by_name("djnn-3").landmarks) == 252 and world_by_name("djnn-0").movers == 0


def test_the_orchard_looks_the_same_a_tree_or_a_row_further():
    world = world_by_name("orchard")
    trees = {(float(x), float(y)) for x, y in world.landmarks}
    assert len(trees) == 160
    assert len(trees & {(x + 4.0, y) for x, y in trees}) == 160 - 10
    assert len(trees & {(x, y + 6.0) for x, y in trees}) == 160 - 16
    poses = drive(world).poses
    gaps = cKDTree(world.landmarks).query(poses[:, :2])[0]
    assert gaps.min() > 2.5
    within = (poses[:, 0] > 12.0) & (poses[:, 0] < 68.0)
    lanes = np.abs(poses[within, 1, None] - 6.0 * np.arange(9))
    assert lanes.min(axis=1).max() < 0.5
    assert set(lanes.argmin(axis=1).tolist()) == set(range(9))
    blind = np.array([len(frame.ids) for frame in frames(simulate(world, 1))]) == 0
    assert 500 < blind.sum() < 1000  # on the way to the yard and back


def test_clusters_are_closer_than_the_gate():
    """Oracle: connected components; the gate from scipy's chi-square."""
    world = world_by_name("clusters")
    tree = cKDTree(world.landmarks)
    nearest = tree.query(world.landmarks, 2)[0][:, 1]
    assert nearest.min() > 0.3 - 2e-3 and nearest.max() < 0.6 + 2e-3
    count, member = connected_components(tree.sparse_distance_matrix(tree, 1.0))
    assert count == 24 and set(np.bincount(member).tolist()) == {4, 5, 6}
    across = 20.0 * math.radians(world.sigma_bearing_deg)
    assert (0.6 / across) ** 2 < stats.chi2.ppf(0.999, 2) / 2


def grove(**changes):
    return msgspec.structs.replace(world_by_name("grove"), laps=1, **changes)


def test_scans_of_the_grove_and_their_truth():
    """Oracle: every beam with every circle, by the quadratic formula."""
    world = grove(sigma_beam=0.0, movers=60)
    log = simulate(world, 1)
    sweeps, poses = frames(log), looks(world)
    tracks, truth = mover_tracks(world, 1, len(poses)), log.sighting_truth
    radii, trees = np.append(world.radii, np.full(world.movers, 0.25)), len(world.radii)
    hidden = people = 0
    for number in range(10, len(poses), 20):
        offset = np.concatenate([world.landmarks, tracks[number]]) - poses[number, :2]
        angle = poses[number, 2] + np.radians(0.5 * np.arange(361) - 90.0)
        along = np.cos(angle)[:, None] * offset[:, 0] + np.sin(angle)[:, None] * offset[:, 1]
        inner = radii**2 - ((offset**2).sum(axis=1) - along**2)
        distance = np.where((inner > 0) & (along > 0), along - np.sqrt(np.maximum(inner, 0)), np.inf)
        distance[distance > 40.0] = np.inf
        nearest = distance.min(axis=1)
        np.testing.assert_allclose(sweeps[number].ranges, nearest, atol=1e-7)
        hits = set(distance.argmin(axis=1)[np.isfinite(nearest)].tolist())
        rows = np.flatnonzero(truth.times == sweeps[number].time)
        assert truth.ids[rows].tolist() == sorted(who for who in hits if who < trees)
        expected = exact(poses[number], world.landmarks[truth.ids[rows]])
        np.testing.assert_allclose(truth.values[rows], expected, atol=1e-12)
        hidden += len(set(np.flatnonzero(np.isfinite(distance).any(axis=0)).tolist()) - hits)
        people += len([who for who in hits if who >= trees])
    assert hidden > 5 and people > 20
    assert (np.diff(truth.times) >= 0).all() and truth.ids.dtype == np.int64


def test_a_beams_noise_and_the_settings_of_a_log_of_scans():
    quiet, loud = (simulate(grove(sigma_beam=sigma), 1) for sigma in (0.0, 0.05))
    pairs = [np.array([frame.ranges for frame in frames(log)]) for log in (quiet, loud)]
    hit = np.isfinite(pairs[0])
    np.testing.assert_array_equal(hit, np.isfinite(pairs[1]))
    assert np.std(pairs[1][hit] - pairs[0][hit]) == pytest.approx(0.05, rel=0.03)
    np.testing.assert_array_equal(quiet.sighting_truth.values, loud.sighting_truth.values)
    assert loud.defaults.association.method == "likelihood" and loud.defaults.sensor.max_range == 40.0
    assert not any(isinstance(event, Sightings) for event in loud)


def test_who_walks_past_a_trunk_hides_it_and_is_none():
    """Oracle: the truth of the same world with nobody in it."""
    alone = msgspec.structs.replace(
        OPEN, landmarks=np.array([[55.0, 3.0]]), scanner="sick", radii=np.array([0.2])
    )
    crowd = msgspec.structs.replace(alone, movers=30)
    bare, full = (simulate(world, 3).sighting_truth for world in (alone, crowd))
    assert len(frames(simulate(crowd, 1))) > 90 and set(full.ids.tolist()) == {0}
    assert set(full.times.tolist()) < set(bare.times.tolist())


def test_a_scanner_can_be_narrowed():
    world = msgspec.structs.replace(OPEN, scanner="sick", radii=np.array([0.2]), field_of_view_deg=90.0)
    assert frames(simulate(world, 1))[0].bearings.shape == (181,)
    bare = msgspec.structs.replace(world, landmarks=np.zeros((0, 2)), radii=np.zeros(0))
    log = simulate(bare, 1)
    assert len(log.sighting_truth.ids) == 0 and np.isinf(frames(log)[0].ranges).all()


def test_the_settings_hold_every_number_and_the_map_its_radii():
    settings = simulate(world_by_name("breaker"), 1).settings["world"]
    assert (settings["movers"], settings["clutter"], settings["doubles"]) == (50, 5.0, 0.2)
    assert settings["detection_probability"] == 0.7 and settings["mover_speed"] == 1.4
    world = grove()
    thicker = msgspec.structs.replace(world, radii=np.asarray(world.radii) + 0.01)
    first, second = (simulate(w, 1).settings for w in (world, thicker))
    assert first["world"] == second["world"] and first["world"]["scanner"] == "sick"
    assert first["map_sha256"] != second["map_sha256"]


@pytest.mark.parametrize(
    "name", ["djnn-", "djnn-x", "djnn-10001", "clutter-1001", "clutter-2.5", "orchard-3", "missed-70"]
)
def test_disturbed_worlds_that_do_not_exist(name):
    with pytest.raises(ConfigError):
        world_by_name(name)


def test_the_disturbances_can_be_set_on_the_command_line():
    given = {"movers": 3, "clutter": 2, "detection_probability": 0.5, "doubles": 0.1, "mover_speed": 2}
    world = find_world("clutter-5", given)
    assert all(getattr(world, field) == value for field, value in given.items())
    assert find_world("clutter-5", {"clutter": 2.5}).clutter == 2.5
    assert find_world("grove", {"sigma_beam": 0.02}).sigma_beam == 0.02
    with pytest.raises(ConfigError, match=r"world.movers: expected a whole number, got 1.5"):
        find_world("djnn-10", {"movers": 1.5})
    for field in ("scanner", "radii", "name", "landmarks"):
        with pytest.raises(ConfigError, match=rf"world\.{field}: no such setting; there are .*clutter"):
            find_world("grove", {field: 1})
    with pytest.raises(ConfigError, match="radii must be one to a landmark"):
        find_world("grove", {"random_landmarks": 5})
