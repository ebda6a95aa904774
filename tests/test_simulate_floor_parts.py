"""What a floor adds to geometry: the scanner's noise, its mounting, the wheels' errors, furniture and people."""

import math

import msgspec
import numpy as np
import pytest

from kalmap.geometry.se2 import compose
from kalmap.records import ConfigError
from kalmap.simulate import URG, FloorWorld, floor_drive, simulate, world_by_name
from test_simulate_floors import QUIET, ROOM, distances, split, truth
from test_simulate_raycast_segments import every_pair


def still(**fields):
    """A robot that stands in a bare room of 6 m x 4 m for so long that statistics mean something."""
    changes = {"stand": 60.0, **QUIET, "mount_x": 0.0, "walls": ROOM, **fields}
    return FloorWorld(name="room", waypoints=np.zeros((1, 2)), **changes)


def sweeps(world, seed=1):
    return np.array([scan.ranges for scan in split(simulate(world, seed))[1]])


EXACT = every_pair(np.zeros((1, 3)), URG.bearings, 9.0, ROOM)[0][0]


def test_beams_have_the_noise_that_is_stated():
    """Oracle: the sample deviation at every bearing against sqrt(sigma^2 + (ratio r)^2), within 4 standard errors."""
    ranges = sweeps(still(sigma_beam=0.01, sigma_beam_ratio=0.01))
    error = ranges - EXACT
    expected = np.hypot(0.01, 0.01 * EXACT)
    scaled = error / expected
    assert np.isfinite(scaled).all()
    assert abs(scaled.mean()) < 4 / math.sqrt(scaled.size)
    assert scaled.std() == pytest.approx(1.0, abs=4 / math.sqrt(2 * scaled.size))
    far = EXACT > 3.0
    assert scaled[:, far].std() == pytest.approx(1.0, abs=0.05)


def test_ranges_come_in_steps():
    for quantum in (0.001, 0.01):
        ranges = sweeps(still(quantum=quantum, sigma_beam=0.02))
        np.testing.assert_allclose(ranges / quantum, np.rint(ranges / quantum), atol=1e-6)


def test_beams_are_lost_by_the_share_stated_and_more_beyond_the_rated_range():
    """Oracle: the binomial distribution; the room's corners are nearer than the URG's 4 m."""
    assert EXACT.max() < 4.0
    lost = np.isinf(sweeps(still(dropout=0.03)))
    assert lost.mean() == pytest.approx(0.03, abs=4 * math.sqrt(0.03 * 0.97 / lost.size))
    wide = still(walls=1.6 * ROOM, stand=200.0)
    exact = every_pair(np.zeros((1, 3)), wide.device.bearings, 5.6, wide.walls)[0][0]
    lost = np.isinf(sweeps(wide)).mean(axis=0)
    assert (lost[exact <= 4.0] == 0.0).all() and (exact <= 4.0).any()
    between = (exact > 4.0) & np.isfinite(exact)
    assert between.sum() > 50
    np.testing.assert_allclose(lost[between], (exact[between] - 4.0) / 1.6, atol=4 * 0.5 / math.sqrt(1001))


def test_mixed_pixels_lie_between_both_sides_of_an_edge():
    """A column in the room has two edges; beams that are neither it nor the wall lie between them, and only there."""
    world = still(columns=np.array([[1.5, 0.0, 0.3]]), mixed_pixels=0.4)
    clean = sweeps(msgspec.structs.replace(world, mixed_pixels=0.0))[0]
    ranges = sweeps(world)
    changed = ranges != clean
    edges = np.flatnonzero(np.abs(np.diff(clean)) > 0.1)
    assert len(edges) == 2 and set(np.flatnonzero(changed.any(axis=0))) == set(edges)
    share = changed[:, edges].mean()
    assert share == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / (2 * len(ranges))))
    for edge in edges:
        low, high = sorted(clean[edge : edge + 2])
        assert ((ranges[:, edge] >= low) & (ranges[:, edge] <= high)).all()


def test_the_mount_moves_the_scanner():
    """Oracle: `every_pair` from where the scanner is."""
    world = still(mount_x=0.5, mount_y=-0.3, mount_heading_deg=40.0, stand=0.0)
    pose = np.array([[0.5, -0.3, math.radians(40.0)]])
    np.testing.assert_allclose(
        sweeps(world)[0], every_pair(pose, world.device.bearings, 9.0, ROOM)[0][0], atol=1e-9
    )


def test_upside_down_the_sweep_runs_the_other_way_and_the_world_stays_the_same():
    """The points in the room are those of the upright scanner, beam by beam from the other end."""
    walls = np.concatenate([ROOM, [[1.0, 0.5, 1.5, 1.5]]])  # something on the left only
    upright, hung = (
        split(simulate(still(walls=walls, mount_heading_deg=20.0, upside_down=way), 1))[1][0]
        for way in (False, True)
    )
    assert (np.diff(upright.bearings) > 0).all() and (np.diff(hung.bearings) < 0).all()
    np.testing.assert_allclose(hung.bearings[::-1], upright.bearings, atol=1e-12)
    np.testing.assert_allclose(hung.ranges[::-1], upright.ranges, atol=1e-9)


def test_wheels_err_as_stated():
    """Oracle: the deviations of the increments from the true ones, scaled with the sigmas of the motion model that
    the log's settings describe, have unit variance; without noise the systematic errors are left."""
    world = world_by_name("floor-115")
    fields = {
        "sigma_distance_ratio": 0.05,
        "sigma_rotation_deg": 0.3,
        "distance_scale": 0.0,
        "heading_bias_deg": 0.0,
    }
    noisy = simulate(msgspec.structs.replace(world, **fields), 1)
    exact = np.array([e.values[0] for e in split(simulate(msgspec.structs.replace(world, **QUIET), 1))[0]])
    said = np.array([e.values[0] for e in split(noisy)[0]])
    way = np.hypot(exact[:, 0], exact[:, 1])
    sigmas = np.column_stack([0.05 * way, 0.05 * way, np.hypot(np.radians(0.3), 0.1 * exact[:, 2])])[1:]
    scaled = (said - exact)[1:] / sigmas
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=4 / math.sqrt(2 * len(scaled)))
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=4 / math.sqrt(len(scaled)))
    biased = {**QUIET, "distance_scale": 0.02, "heading_bias_deg": 0.5}
    said = np.array([e.values[0] for e in split(simulate(msgspec.structs.replace(world, **biased), 1))[0]])
    np.testing.assert_allclose(said[:, :2], 1.02 * exact[:, :2], atol=1e-12)
    np.testing.assert_allclose(said[:, 2], exact[:, 2] + np.radians(0.5) * way, atol=1e-12)


def test_floors_that_differ_in_one_thing_share_the_other_random_numbers():
    world = still(sigma_beam=0.01)
    plain, lossy = sweeps(world), sweeps(msgspec.structs.replace(world, dropout=0.3))
    kept = np.isfinite(lossy)
    np.testing.assert_array_equal(plain[kept], lossy[kept])
    assert 0.6 < kept.mean() < 0.8


def test_furniture_stands_in_its_areas_and_off_the_ways():
    world = world_by_name("floor-115")
    for seed in (1, 2, 3):
        log = simulate(world, seed)
        path = floor_drive(world).poses
        bare = simulate(msgspec.structs.replace(world, furniture=0.0), seed).references[0].walls
        walls = log.references[0].walls
        more = walls[len(bare) :]
        np.testing.assert_allclose(walls[: len(bare)], bare)
        assert len(more) > 20
        ends = more.reshape(-1, 2)
        plan = compose(path[0], np.column_stack([ends, np.zeros(len(ends))]))[:, :2]
        low, high = world.areas[:, :2] - 1e-6, world.areas[:, 2:4] + 1e-6
        assert ((plan[:, None] >= low) & (plan[:, None] <= high)).all(axis=2).any(axis=1).all()
        assert distances(truth(log)[:, :2], more).min() > 0.45 - 0.01
    counts = [
        len(simulate(msgspec.structs.replace(world, furniture=f), 1).references[0].walls) for f in (0, 1, 3)
    ]
    assert counts[0] < counts[1] < counts[2]


def test_people_are_seen_move_and_keep_off_the_robot():
    world = msgspec.structs.replace(world_by_name("crowd"), **QUIET)
    crowded, empty = sweeps(world), sweeps(msgspec.structs.replace(world, people=0))
    nearer = crowded < empty - 1e-9
    assert 0.02 < nearer.mean() < 0.5 and (crowded[~nearer] == empty[~nearer]).all()
    assert (
        crowded[nearer].min() > 0.7 - 0.25 - 0.1 - 1e-9
    )  # their radius, and the scanner's place on the robot
    assert nearer.any(axis=1).mean() > 0.5
    assert (nearer[1:] != nearer[:-1]).any(axis=1).mean() > 0.4


def test_people_walk_no_faster_than_they_can():
    from kalmap.simulate.walkers import walkers

    world = world_by_name("crowd")
    times = np.arange(0.0, 100.0, 0.1)
    far = np.full((len(times), 2), 1e6)
    places = walkers(world, times, far, np.random.default_rng(1), np.random.default_rng(2))
    assert places.shape == (len(times), world.people, 3) and (places[..., 2] == world.person_radius).all()
    speeds = np.hypot(*np.diff(places[..., :2], axis=0).transpose(2, 0, 1)) / 0.1
    assert speeds.max() <= 1.5 * world.person_speed + 1e-6
    assert 0.5 < np.median(speeds) / world.person_speed < 1.5
    assert 0.05 < (speeds == 0).mean() < 0.4
    close = walkers(
        world, times, np.zeros((len(times), 2)), np.random.default_rng(1), np.random.default_rng(2)
    )
    assert np.hypot(close[..., 0], close[..., 1]).min() > 0.7 - 1e-9


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"walls": np.zeros((2, 3))}, "walls"),
        ({"walls": np.full((1, 4), np.nan)}, "walls must be finite"),
        ({"waypoints": np.zeros((0, 2))}, "waypoints"),
        ({"columns": np.zeros((1, 3))}, "radii"),
        ({"areas": np.array([[0.0, 0.0, 0.0, 1.0, 1.0]])}, "areas"),
        ({"people": 3, "walkways": ()}, "walkways"),
        ({"people": -1}, "people"),
        ({"people": 5000}, "people"),
        ({"walkways": (np.zeros((1, 2)),)}, "walkways"),
        ({"scanner": "sonar"}, "scanner"),
        ({"rate": 0.0}, "rate"),
        ({"speed": math.nan}, "speed"),
        ({"dropout": 1.5}, "dropout"),
        ({"mount_x": math.inf}, "mount_x"),
        ({"distance_scale": -1.0}, "distance_scale"),
        ({"sigma_beam": -0.1}, "sigma_beam"),
    ],
)
def test_a_floor_that_cannot_be_is_refused(change, said):
    with pytest.raises(ConfigError, match=said):
        msgspec.structs.replace(world_by_name("floor-115"), **change)


def test_a_drive_that_cannot_be_is_refused():
    twice = FloorWorld(name="twice", walls=ROOM, waypoints=np.zeros((2, 2)))
    with pytest.raises(ConfigError, match="way-points"):
        simulate(twice, 1)
    with pytest.raises(ConfigError, match="scans"):
        simulate(still(stand=1e9), 1)
