"""Live local maps on simulated floors, and on bad scans. Oracle: the simulator: true poses, walls, scanner errors."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from contour_drives import SICK, Drive, drifted, rules_for
from kalmap.gaussian import Belief, CentralDifference, Jacobian
from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels import contour_state as state
from kalmap.records import Odometry, Scan
from kalmap.simulate.catalogue import world_by_name
from kalmap.simulate.floor_run import simulate_floor
from kalmap.simulate.floors import standstill, straight_corridor
from kalmap.simulate.raycast import SICK_180, cast
from kalmap.simulate.rooms import rooms_world
from kalmap.slam.contours.live import LiveMap, _reach
from kalmap.slam.contours.seen import prepare
from made_maps import room

STILL = Odometry(0.0, np.zeros((1, 3)), np.array([0.2]))
WALLS = np.array(room(-4.0, -3.0, 5.0, 3.0) + [[2.0, 1.0, 2.0, 2.0]], dtype=float)


def rules_of_a_sick(**overrides):
    return rules_for(simulate_floor(standstill(**SICK, **overrides), 1))


def scan_from(pose, *, circles=None, seed=None, bearings=SICK_180.bearings, mount=(0.1, 0.0, 0.0)):
    sensor = compose(np.array(pose, dtype=float), np.array(mount))[None]
    circles = np.zeros((0, 3)) if circles is None else np.array(circles, dtype=float)
    ranges = cast(sensor, circles, bearings, 80.0, segments=WALLS)[0]
    if seed is not None:
        ranges = ranges + 0.01 * np.random.default_rng(seed).standard_normal(len(ranges))
    return Scan(0.0, ranges, np.asarray(bearings))


def observe(live, scan):
    live.observe(prepare(scan, live.rules, live.calibration.mean, np.zeros(3)))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("lineariser", "coordinates"), [(Jacobian(), "additive"), (CentralDifference(), "invariant")]
)
def test_rooms_with_a_sick(seed, lineariser, coordinates):
    """Within each map centimetres; NEES of 3 in the mean not above 4. Measured, seeds 1 to 10: 1.0 to 2.6."""
    log = simulate_floor(rooms_world(4, **SICK), seed)
    drive = Drive(log, rules_for(log, lineariser, coordinates), most=350)
    assert np.hypot(*drive.errors[:, :2].T).max() < 0.08 and len(drive.maps) >= 3
    assert 0.3 < drive.nees().mean() < 4.0


@pytest.mark.parametrize("seed", [2, 4])
def test_a_floor_that_looks_alike_is_not_jumped_about_in(seed):
    """floor-115: with URG range and doors alike, places that fit by chance must not be taken for jumps.

    NEES, seeds 1 to 6: 3.0 to 4.8 in the mean, over the 3 of an honest filter, as ranges of 1 % noise and systematic
    odometry leave it.
    """
    log = simulate_floor(world_by_name("floor-115"), seed)
    drive = Drive(log, rules_for(log))
    assert np.hypot(*drive.errors[:, :2].T).max() < 0.25 and np.abs(drive.errors[:, 2]).max() < 0.03
    assert drive.nees().mean() < 7.0


@pytest.mark.parametrize("seed", [5, 6])
def test_a_hall_of_curved_walls(seed):
    """Arcs of 2 to 5 m, round columns, noise of 4 cm at 4 m: no curve may bend less than its wall in every scan alike.

    Seeds 1 to 8, with straight lines, and curves that need not fit better than lines: NEES 28 to 52 in the mean, RMS of
    the heading 1.3 to 2.0 degrees; with bent lines 10 to 25 and 0.6 to 1.1. Of an honest filter it is 3.
    """
    log = simulate_floor(world_by_name("hall"), seed)
    drive = Drive(log, rules_for(log, CentralDifference(), "invariant"))
    assert np.degrees(np.sqrt(np.mean(drive.errors[:, 2] ** 2))) < 1.5
    assert drive.nees().mean() < 32.0


def test_a_crowd_walks_about():
    log = simulate_floor(world_by_name("crowd"), 1)
    drive = Drive(log, rules_for(log), most=300)
    assert np.hypot(*drive.errors[:, :2].T).max() < 0.3 and np.abs(drive.errors[:, 2]).max() < 0.05


@pytest.mark.parametrize("turn_deg", [60.0, -35.0])
@pytest.mark.parametrize("at", [100, 150])
def test_a_jump_of_the_heading_is_recovered(turn_deg, at):
    log = simulate_floor(rooms_world(4, **SICK), 1)
    jump = (at, np.array([0.0, 0.0, math.radians(turn_deg)]))
    drive = Drive(log, rules_for(log), most=at + 20, jump=jump)
    assert np.hypot(*drive.errors[:, :2].T).max() < 0.05 and np.abs(drive.errors[:, 2]).max() < 0.02


@pytest.mark.parametrize(("scale", "offset"), [(0.0, 0.0), (0.01, 0.02), (-0.008, -0.015)])
def test_calibration(scale, offset):
    """Mean over seeds; a single run is right by 0.0007 and 6 mm. See the commit that brought this for the spread."""
    found = []
    for seed in (1, 2, 3):
        log = simulate_floor(rooms_world(4, **SICK), seed)
        drive = Drive(log, rules_for(log), change=lambda scan: drifted(scan, scale, offset))
        found.append(drive.live.calibration.mean[:2])
        assert np.sqrt(drive.live.calibration.covariance[0, 0]) < 5e-4
    expected = np.array([1.0 / (1.0 + scale) - 1.0, -offset])
    assert np.abs(np.array(found) - expected).max(axis=0)[0] < 7e-4
    assert np.abs(np.array(found) - expected).max(axis=0)[1] < 6e-3


@pytest.mark.parametrize("place", [(0.3, 0.0), (0.1, -0.15)])
def test_the_lever_of_a_scanner_whose_place_is_not_told(place):
    """A scanner that is said to be at the odometry's point and is not. Oracle: where the simulator mounted it.

    The pose is that of the scanner then, and as good as if its place were known. Without the lever the bearing scale
    stood in for it: -0.006 for 0.3 m.
    """
    world = rooms_world(4, **SICK, mount_x=place[0], mount_y=place[1])
    log = simulate_floor(world, 1)
    rules = rules_for(log, sigma_lever=0.2)
    rules = msgspec.structs.replace(
        rules, sensor=msgspec.structs.replace(rules.sensor, mount_x=0.0, mount_y=0.0)
    )
    drive = Drive(log, rules, most=400, frame=np.array([*place, 0.0]))
    found, spread = drive.live.calibration.mean, np.sqrt(np.diag(drive.live.calibration.covariance))
    assert np.allclose(found[2:4], -np.array(place), atol=0.01) and (spread[2:4] < 0.005).all()
    assert abs(found[0]) < 1e-3
    assert np.hypot(*drive.errors[:, :2].T).max() < 0.08 and drive.nees().mean() < 4.0


def test_a_lever_that_is_known_changes_nothing():
    """Oracle: the engine by itself; with a lever of exactly 0 the prediction is the motion model's own."""
    log = simulate_floor(rooms_world(4, **SICK), 1)
    live = LiveMap(rules_for(log, sigma_lever=0.0))
    alone = Belief(np.zeros(3), np.zeros((3, 3)))
    for number, event in enumerate(log):
        if isinstance(event, Odometry):
            live.predict(event)
            live.rules.engine.predict(alone, event)
        if number == 300:
            break
    assert np.allclose(live.pose, alone.mean[:3], rtol=0, atol=1e-12)
    assert np.allclose(live.belief.covariance()[:3, :3], alone.covariance(), rtol=0, atol=1e-12)


def test_prediction_with_a_lever():
    """Oracle: numerical differences of pose and lever through the composed motion, to first order."""
    log = simulate_floor(rooms_world(4, **SICK), 1)
    live = LiveMap(rules_for(log))
    observe(live, scan_from(np.zeros(3), seed=1))
    mean = live.belief.mean[: live.belief.n]
    mean[:3], mean[5:7] = [0.4, -0.2, 0.7], [0.12, -0.07]
    before, at = live.belief.covariance(), mean.copy()
    step = np.array([0.3, 0.05, 0.4])
    live.predict(Odometry(0.0, step[None], np.array([0.2]), covariance=np.zeros((1, 3, 3))))

    def moved(x):
        lever = np.array([*x[5:7], 0.0])
        return np.r_[compose(compose(compose(x[:3], lever), step), inverse(lever)), x[3:]]

    assert np.allclose(live.belief.mean[: len(at)], moved(at), rtol=0, atol=1e-12)
    design = np.array([(moved(at + d) - moved(at - d)) / 2e-6 for d in 1e-6 * np.eye(len(at))]).T
    expected = design @ before @ design.T
    assert np.allclose(live.belief.covariance(), expected, rtol=0, atol=1e-9)


def test_a_person_who_leaves_is_retired():
    """The samples on the person go, those of the wall behind come, the room's stay."""
    live = LiveMap(rules_of_a_sick())
    person = np.array([[2.5, -0.5, 0.25]])
    for k in range(2):
        live.predict(STILL)
        observe(live, scan_from(np.zeros(3), circles=person, seed=k))
    near = np.hypot(*(live.samples - person[0, :2]).T) < 0.35
    others = live.samples[~near]
    assert near.sum() >= 3
    for k in range(6):
        live.predict(STILL)
        observe(live, scan_from(np.zeros(3), seed=10 + k))
    assert (np.hypot(*(live.samples - person[0, :2]).T) > 0.35).all()
    assert (np.hypot(*(live.samples[:, None] - others[None]).transpose(2, 0, 1)).min(axis=0) < 0.05).all()
    assert live.belief.n == state.SAMPLES + 2 * live.count == state.SAMPLES + 2 * len(live.normals)


@pytest.mark.parametrize("beams", [0, 1, 2, 3])
def test_hardly_a_beam(beams):
    live = LiveMap(rules_of_a_sick())
    few = Scan(0.0, np.full(beams, 2.0), np.linspace(-0.1, 0.1, beams))
    for _ in range(3):
        live.predict(STILL)
        observe(live, few)
    observe(live, scan_from(np.zeros(3), seed=1))
    count = live.count
    observe(live, few)
    assert live.count == count > 20 and np.isfinite(live.pose).all()


def test_five_thousand_beams():
    live = LiveMap(rules_of_a_sick())
    bearings = np.linspace(-np.pi, np.pi, 5000, endpoint=False)
    for k, x in enumerate([0.0, 0.1, 0.2]):
        live.predict(Odometry(0.0, np.array([[0.1 * (k > 0), 0.0, 0.0]]), np.array([0.2])))
        observe(live, scan_from([x, 0.0, 0.0], seed=k, bearings=bearings))
    assert np.allclose(live.pose, [0.2, 0.0, 0.0], atol=0.02) and live.used > 50


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e9])
def test_ranges_that_are_none(bad):
    """A third of the ranges replaced: the pose is as good, nothing is founded on them, nothing is not finite."""
    rng, live = np.random.default_rng(0), LiveMap(rules_of_a_sick())
    for k, x in enumerate([0.0, 0.1, 0.2, 0.3]):
        live.predict(Odometry(0.0, np.array([[0.1 * (k > 0), 0.0, 0.0]]), np.array([0.2])))
        scan = scan_from([x, 0.0, 0.0], seed=k)
        ranges = np.where(rng.random(len(scan.ranges)) < 0.3, bad, scan.ranges)
        observe(live, msgspec.structs.replace(scan, ranges=ranges))
    assert np.allclose(live.pose, [0.3, 0.0, 0.0], atol=0.03)
    assert np.isfinite(live.belief.covariance()).all() and np.isfinite(live.samples).all()
    assert np.abs(live.samples).max() < 5.2


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0])
def test_scans_of_nothing(bad):
    live = LiveMap(rules_of_a_sick())
    observe(live, scan_from(np.zeros(3), seed=1))
    count = live.count
    for _ in range(5):
        live.predict(STILL)
        observe(live, Scan(0.0, np.full(180, bad), SICK_180.bearings))
    assert live.count == count and np.isfinite(live.belief.covariance()).all() and live.used == 0


def test_bearings_that_are_none():
    live = LiveMap(rules_of_a_sick())
    scan = scan_from(np.zeros(3), seed=1)
    broken = np.array(scan.bearings)
    broken[40:60] = np.nan
    for _ in range(3):
        live.predict(STILL)
        observe(live, msgspec.structs.replace(scan, bearings=broken))
    assert live.used > 20 and np.isfinite(live.belief.covariance()).all()


def test_upside_down():
    """Bearings fall from left to right: the same map as the right way up."""
    for upside_down in (False, True):
        log = simulate_floor(rooms_world(4, **SICK, upside_down=upside_down), 1)
        drive = Drive(log, rules_for(log), most=150)
        assert np.hypot(*drive.errors[:, :2].T).max() < 0.06


def test_along_a_bare_corridor_the_covariance_grows():
    """Oracle: the odometry's noise and its scale's. Along it, as much as dead reckoning; across, centimetres."""
    log = simulate_floor(straight_corridor(), 1)
    drive = Drive(log, rules_for(log), most=250, close=False)
    spread = np.sqrt(np.einsum("tii->ti", drive.covariances))
    assert (np.diff(spread[20:, 0]) > -1e-3).all()
    steps = len(spread) - 1
    noise = log.defaults.motion.sigma_distance_ratio * drive.live.length / math.sqrt(steps)
    reckoned = math.hypot(noise, log.defaults.contour.sigma_way_scale * drive.live.length)
    assert 0.5 * reckoned < spread[-1, 0] < 1.5 * reckoned and spread[-1, 1] < 0.3
    assert abs(drive.errors[-1, 1]) < 0.3


def test_at_standstill_nothing_grows():
    log = simulate_floor(standstill(**SICK), 1)
    live = LiveMap(rules_for(log))
    counts, spreads = [], []
    for event in log:
        if isinstance(event, Odometry):
            live.predict(event)
            continue
        observe(live, event)
        counts.append(live.count)
        spreads.append(live.belief.variances()[3:].max())
    assert len(counts) > 250 and counts[-1] <= 1.3 * counts[5]
    assert spreads[-1] <= spreads[0] and np.isfinite(spreads).all()
    assert np.hypot(*live.pose[:2]) < 0.02 and abs(live.pose[2]) < 0.01


@pytest.mark.parametrize("count", [1, 2, 3, 11, 180])
def test_nine_in_ten_points_lie_within_reach(count):
    """Oracle: np.percentile."""
    points = np.random.default_rng(count).normal(0.0, 5.0, (count, 2))
    assert _reach(points) == pytest.approx(np.percentile(np.hypot(*points.T), 90.0), rel=1e-14)
    assert _reach(points[:0]) == 0.0
