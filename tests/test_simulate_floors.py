"""Floors by name: their plans, the drive through them, and that truth, odometry and scans belong together."""

import math
import pickle
import time
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from scipy.spatial import cKDTree

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.records import ConfigError, Odometry, Scan
from kalmap.simulate import FloorWorld, floor_drive, rooms_world, simulate, world_by_name, world_names
from test_simulate_raycast_segments import every_pair

FLOORS = [
    "floor-115",
    "floor-170",
    "office",
    "hall",
    "lab",
    "corridor",
    "crowd",
    "standstill",
    "rooms-3",
    "rooms-14-5",
]
QUIET = {
    "sigma_beam": 0.0,
    "sigma_beam_ratio": 0.0,
    "quantum": 0.0,
    "dropout": 0.0,
    "mixed_pixels": 0.0,
    "sigma_distance_ratio": 0.0,
    "sigma_rotation_deg": 0.0,
    "sigma_rotation_ratio": 0.0,
    "distance_scale": 0.0,
    "heading_bias_deg": 0.0,
}
ROOM = np.array(
    [[-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 2.0], [3.0, 2.0, -3.0, 2.0], [-3.0, 2.0, -3.0, -2.0]]
)


def split(log):
    events = list(log)
    return [e for e in events if isinstance(e, Odometry)], [e for e in events if isinstance(e, Scan)]


def truth(log):
    return np.column_stack([log.references[0].positions, log.references[0].headings])


def distances(points, walls):
    """(n,) m: from every point to the nearest wall, to 5 mm: walls are taken as points a centimetre apart."""
    lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    shares = [np.linspace(0.0, 1.0, 1 + math.ceil(length / 0.01))[:, None] for length in lengths]
    places = [wall[:2] + share * (wall[2:] - wall[:2]) for wall, share in zip(walls, shares)]
    return cKDTree(np.concatenate(places)).query(points)[0]


@pytest.mark.parametrize("name", FLOORS)
def test_the_robot_never_comes_near_a_wall(name):
    """Oracle: the distance of every tenth of a second's pose to every true wall, furniture included; the robot is
    taken to be 0.7 m wide, and between two poses it moves 0.05 m."""
    world = msgspec.structs.replace(world_by_name(name), rate=10.0)
    for seed in (1, 2):
        log = simulate(world, seed)
        assert distances(log.references[0].positions, log.references[0].walls).min() > 0.4


@pytest.mark.parametrize("name", FLOORS)
def test_the_same_seed_gives_the_same_log_and_another_seed_another(name):
    log, again, other = (simulate(world_by_name(name), seed) for seed in (3, 3, 4))
    for mine, same in zip(log, again, strict=True):
        assert mine.time == same.time
        np.testing.assert_array_equal(content(mine), content(same))
    np.testing.assert_array_equal(log.references[0].walls, again.references[0].walls)
    assert any(not np.array_equal(content(a), content(b)) for a, b in zip(log, other, strict=True))
    assert log.name == name and log.source == f"world:{name} seed:3"


def content(event):
    return event.ranges if isinstance(event, Scan) else event.values


@pytest.mark.parametrize("name", FLOORS)
def test_events_are_an_increment_and_a_scan_each_time(name):
    log = simulate(world_by_name(name), 1)
    events, times = list(log), log.references[0].times
    assert len(events) == 2 * len(times)
    assert all(type(a) is not type(b) for a, b in pairwise(events)) and isinstance(events[0], Odometry)
    odometry, scans = split(log)
    assert not odometry[0].values.any() and odometry[0].durations[0] == 0.0 and times[0] == 0.0
    for number, (block, scan, at) in enumerate(zip(odometry, scans, times)):
        assert block.time == scan.time == at and block.record == scan.record == number + 1
        assert block.values.shape == (1, 3) and block.durations.shape == (1,)
        assert scan.ranges.shape == scan.bearings.shape
        assert not np.isnan(scan.ranges).any() and (scan.ranges > 0).all()
    world = world_by_name(name)
    np.testing.assert_allclose(np.diff(times), 1.0 / world.rate, atol=1e-9)
    assert (scans[-1].ranges[np.isfinite(scans[-1].ranges)] <= world.max_range).all()


@pytest.mark.parametrize("name", FLOORS)
def test_increments_without_noise_lead_to_the_truth(name):
    """Oracle: composition, one after the other."""
    log = simulate(msgspec.structs.replace(world_by_name(name), furniture=0.0, **QUIET), 1)
    pose, poses = np.zeros(3), truth(log)
    np.testing.assert_array_equal(poses[0], 0.0)
    for block, expected in zip(split(log)[0], poses, strict=True):
        pose = compose(pose, block.values[0])
        np.testing.assert_allclose(pose[:2], expected[:2], atol=1e-9)
        assert abs(wrap(pose[2] - expected[2])) < 1e-9


@pytest.mark.parametrize("name", ["floor-115", "hall", "office", "rooms-3"])
def test_scans_without_noise_are_those_of_the_true_map(name):
    """Oracle: `every_pair` (numpy, no choice of beams) in the reference's frame. Circles are chains of chords there,
    which lie up to 1 mm inside, more where a beam passes by; so nine of ten beams agree to 5 mm in each scan."""
    world = msgspec.structs.replace(world_by_name(name), **QUIET)
    log = simulate(world, 2)
    poses, walls, scans = truth(log), log.references[0].walls, split(log)[1]
    for row in range(0, len(scans), len(scans) // 12):
        sensor = compose(poses[row], world.mount)
        expected = every_pair(sensor[None], scans[row].bearings, world.max_range, walls)[0][0]
        if world.scanner == "urg":
            expected[(expected > 4.0)] = np.inf  # thinned out beyond the rated range
        seen = scans[row].ranges
        kept = (np.isfinite(seen) & (seen <= 4.0)) | np.isfinite(expected)
        assert kept.sum() > 10 and np.isclose(seen[kept], expected[kept], rtol=0, atol=5e-3).mean() > 0.9
    bare = msgspec.structs.replace(world, furniture=0.0, columns=np.zeros((0, 3)))
    log = simulate(bare, 2)
    scan, walls = split(log)[1][100], log.references[0].walls
    expected = every_pair(compose(truth(log)[100], bare.mount)[None], scan.bearings, 4.0, walls)[0][0]
    near = np.isfinite(expected)
    np.testing.assert_allclose(scan.ranges[near], expected[near], rtol=0, atol=1e-9)


def test_speed_and_turn_rate_stay_in_their_bounds():
    for name in FLOORS:
        world = world_by_name(name)
        poses = floor_drive(world).poses
        step = compose(inverse(poses[:-1]), poses[1:])
        assert (np.hypot(*step[:, :2].T) <= world.speed / world.rate + 1e-9).all()
        assert (np.abs(step[:, 2]) <= math.radians(world.turn_rate_deg) / world.rate + 1e-9).all()
        # no wheel slides: the robot moves where it looks, which changes by a step's turn at the most
        most = math.radians(world.turn_rate_deg) / world.rate
        assert (np.abs(step[:, 1]) <= most * np.hypot(*step[:, :2].T) + 1e-9).all()


def test_the_drive_ends_at_its_last_way_point_and_passes_every_other():
    for name in FLOORS:
        world = msgspec.structs.replace(world_by_name(name), rate=50.0)
        path = floor_drive(world).poses[:, :2]
        gaps = np.hypot(*(world.waypoints[:, None] - path).transpose(2, 0, 1)).min(axis=1)
        assert gaps.max() < world.turn_radius + 0.01 and gaps[-1] < 0.01


def test_lengths_and_loops_of_the_papers_floors():
    """115 m with two loops, 170 m with one: a loop closes where the robot comes within half a metre of a place that
    it left more than ten metres of way before."""
    for name, expected, loops in (("floor-115", 115.0, 2), ("floor-170", 170.0, 1)):
        path = floor_drive(world_by_name(name)).poses[:, :2]
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        assert way[-1] == pytest.approx(expected, abs=1.0)
        apart = np.hypot(*(path[:, None] - path[None]).transpose(2, 0, 1))
        again = ((apart < 0.5) & (way[:, None] - way[None] > 10.0)).any(axis=1)
        assert (np.diff(again.astype(int)) == 1).sum() == loops


def test_the_other_floors_are_what_their_names_say():
    office, hall = world_by_name("office"), world_by_name("hall")
    assert office.scanner == "sick" and len(office.areas) >= 10 + 4
    path = floor_drive(office).poses[:, :2]
    assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(300.0, rel=0.1)
    rooms = office.areas[:12]
    inside = ((path[:, None] > rooms[:, :2]) & (path[:, None] < rooms[:, 2:4])).all(axis=2).any(axis=0)
    assert inside.all()
    assert len(hall.columns) == 9 and len(hall.walls) > 300
    assert world_by_name("crowd").people >= 30
    _, scans = split(simulate(world_by_name("corridor"), 1))
    for scan in scans[::50]:  # every return is of one of the two walls: a wall's end would lie off both lines
        hit = np.isfinite(scan.ranges)
        y = scan.ranges[hit] * np.sin(scan.bearings[hit])
        assert hit.sum() > 100 and np.median(np.abs(np.abs(y) - 1.1)) < 0.02
    still = simulate(world_by_name("standstill"), 1)
    assert len(still.references[0].times) == 301 and not truth(still).any()
    assert not any(block.values.any() for block in split(still)[0])


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_floors_of_so_many_rooms(count):
    for seed in (1, 2, 3):
        world = rooms_world(count, seed)
        path = floor_drive(world).poses[:, :2]
        rooms = world.areas[:count]
        inside = ((path[:, None] > rooms[:, :2]) & (path[:, None] < rooms[:, 2:4])).all(axis=2).any(axis=0)
        assert inside.all() and len(world.areas) == count + 4
        assert distances(path[::3], world.walls).min() > 0.4
    assert not np.array_equal(rooms_world(count, 1).walls, rooms_world(count, 2).walls)
    np.testing.assert_array_equal(rooms_world(count, 2).walls, world_by_name(f"rooms-{count}-2").walls)


def test_names_are_in_the_catalogue():
    names = world_names()
    for name in FLOORS[:7]:
        assert (
            name in names and isinstance(world_by_name(name), FloorWorld) and world_by_name(name).name == name
        )
    assert "rooms-<N>" in names
    for name in ("rooms-0", "rooms-201", "rooms-", "rooms-3-", "floor-116", "rooms-3-x"):
        with pytest.raises(ConfigError):
            world_by_name(name)


def test_defaults_carry_the_floors_own_numbers():
    world = msgspec.structs.replace(
        world_by_name("floor-115"), mount_x=0.2, mount_heading_deg=10.0, max_range=5.0
    )
    config = simulate(world, 1).defaults
    assert config.motion.model == "increments" and config.motion.exact_standstill
    motion = config.motion
    assert (motion.sigma_distance_ratio, motion.sigma_rotation_deg, motion.sigma_rotation_ratio) == (
        0.1,
        0.5,
        0.1,
    )
    assert (config.sensor.mount_x, config.sensor.mount_heading_deg, config.sensor.max_range) == (
        0.2,
        10.0,
        5.0,
    )
    assert config.contour.method == "dc-slasem"
    assert simulate(world_by_name("office"), 1).defaults.sensor.max_range == 80.0


def test_a_floor_can_be_read_twice_and_sent_to_a_worker():
    log = simulate(world_by_name("standstill"), 1)
    other = pickle.loads(pickle.dumps(log))
    assert len(list(log)) == len(list(log)) == len(list(other))


def test_a_floor_is_quick():
    best = math.inf
    for _ in range(3):
        started = time.process_time()
        simulate(world_by_name("floor-115"), 1)
        best = min(best, time.process_time() - started)
    assert best < 2.0  # 0.1 s of the processor, whatever else it does
