"""Maps laid on each other by what scans saw point by point. Oracles: the true plan and the true poses of simulated
drives through a room of tables and shelves; closed forms and Monte Carlo for the covariances."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from kalmap.cli.main import kalmap
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.models.motion import motion_from_config
from kalmap.records import Scan, SensorConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam.contours.belief import FLOOR, POINTS, is_elsewhere, judged
from kalmap.slam.contours.leg import Leg
from kalmap.slam.contours.loops import SPARSE
from kalmap.slam.contours.matching import Overlay
from kalmap.slam.contours.sketch import Sketch, _carried, _doubted, _within, drawn, laid
from kalmap.slam.contours.slam import ContourSlam
from kalmap.slam.contours.witness import Witness
from real_data import data_root  # noqa: F401
from test_simulate_floors import distances

DRIVE = np.array([0.3, 0.3, 0.08])  # m, m, rad, standard deviation of where the drive has a map
REACH = (1.2, 0.3)


def driven(seed, name="lab", **overrides):
    """The estimator after a drive, the log, and the true frames of the closed maps."""
    log = simulate(msgspec.structs.replace(world_by_name(name), **overrides), seed)
    defaults = log.defaults
    slam = ContourSlam(
        motion_from_config(defaults.motion), defaults.sensor, defaults.contour, start=log.start
    )
    for event in log.open(None):
        slam.step(event)
    truth = log.references[0]
    poses = np.column_stack([truth.positions, truth.headings])
    frames = [poses[0]]
    for leg in slam._worker.settled().legs:
        frames.append(poses[np.searchsorted(truth.times, leg.times[-1] - 1e-6)])
    return slam, log, np.array(frames)


@pytest.fixture(scope="module")
def lab():
    slam, log, frames = driven(2)
    legs = slam._worker.settled().legs
    return slam, log, frames, [drawn(leg, slam.rules) for leg in legs], legs


def test_a_sketch_holds_what_is_there_and_what_is_free(lab):
    """Points lie on true walls and legs, to what range noise and mixed pixels leave; nothing stands in free space."""
    _, log, frames, sketches, _ = lab
    walls = log.references[0].walls
    for sketch, frame in zip(sketches[:3], frames, strict=False):
        off = distances(frame[:2] + rotate(frame[2], sketch.points), walls)
        assert np.median(off) < 0.025 and np.percentile(off, 90) < 0.12
        row, column = np.nonzero(sketch.free)
        cells = sketch.low + 0.05 * (np.column_stack([column, row]) + 0.5)
        near = distances((frame[:2] + rotate(frame[2], cells))[::7], walls)
        assert (near < 0.03).mean() < 0.005 and len(cells) > 2_000


def test_points_along_a_wall_say_nothing_of_the_way_along_it():
    wall = np.column_stack([np.arange(0.0, 3.0, 0.1), np.zeros(30)])
    leg_of_table = np.array([[5.0, 5.0]])
    sketch = made(np.concatenate([wall, leg_of_table]))
    inner = sketch.information[5:-6]
    assert np.abs(inner @ [1.0, 0.0]).max() < 1e-9
    np.testing.assert_allclose(inner[:, 1, 1], 1.0 / 0.04**2)
    np.testing.assert_allclose(sketch.information[-1], np.eye(2) / 0.06**2)


def made(points, free=None):
    """A sketch of points that were seen from all sides, in a plane of which nothing else is known, or is free."""
    low, shape = points.min(axis=0) - 2.0, np.ceil((np.ptp(points, axis=0) + 4.0) / 0.05).astype(int)[::-1]
    row, column = np.indices(shape)
    cells = low + 0.05 * (np.stack([column, row], axis=-1) + 0.5)
    distance = np.sqrt(((cells[:, :, None] - points) ** 2).sum(axis=-1)).min(axis=2)
    return Sketch(points, np.zeros_like(points), low, distance, (distance > 0.15) & (free is not None))


def still(poses, covariance):
    """A leg of these poses, each as sure as the others."""
    count = len(poses)
    scans = (Scan(0.0, np.ones(1), np.zeros(1)),) * count
    spread = np.broadcast_to(covariance, (count, 3, 3)).copy()
    times = np.arange(count, dtype=float)
    return Leg(times, np.full(count, np.nan), poses, spread, np.zeros((count, 3)), scans, np.zeros((2, 2)))


def test_a_place_is_found_wherever_the_drive_has_it_and_is_as_sure_as_it_says(lab):
    """All pairs whose sketches share enough, each from two wrong guesses. The squared distances of what passes the
    bar from the truth have 3 degrees of freedom; covariances are taken twice as wide, as graphs take them."""
    _, _, frames, sketches, legs = lab
    rng, squared = np.random.default_rng(1), []
    for first, second in [(0, 1), (0, 4), (1, 4), (2, 3), (2, 7), (4, 6)]:
        truth = compose(inverse(frames[first]), frames[second])
        for _ in range(2):
            guess = truth + DRIVE * rng.standard_normal(3)
            places = laid((sketches[first], legs[first]), (sketches[second], legs[second]), guess, *REACH)
            best = places[0].overlay
            assert best.agreement > POINTS.agreement and best.matched > POINTS.matched
            off = best.pose - truth
            off[2] = wrap(off[2])
            assert np.hypot(*off[:2]) < 0.3 and abs(off[2]) < 0.06
            squared.append(off @ np.linalg.solve(2.0 * best.covariance + FLOOR, off))
    assert max(squared) < 16.3 and 0.2 < np.mean(squared) < 4.5


def test_a_place_is_refused_where_everything_repeats():
    """Legs of tables 0.8 m apart, all alike: moved by one of them the sketch fits nearly as well."""
    grid = np.array([[0.8 * i, 0.8 * j] for i in range(8) for j in range(8)], dtype=float)
    legs = still(np.zeros((3, 3)), 1e-4 * np.eye(3))
    witness = Witness([legs, legs], None)
    witness._sketches = {0: made(grid, free=True), 1: made(grid, free=True)}
    drive = np.array([0.1, 0.0, 0.0]), np.diag(DRIVE**2), 2.0
    assert witness.by_points(0, 1, drive, REACH, None) is None
    places = [
        each.overlay
        for each in laid((made(grid, free=True), legs), (made(grid, free=True), legs), drive[0], *REACH)
    ]
    verdict = judged(places, *drive, bar=POINTS, about=grid.mean(axis=0))
    assert verdict.why == "another place is nearly as good"
    # one thing that is unlike the others settles it
    odd = np.concatenate([grid, [[2.0, 2.2], [2.1, 2.2], [2.2, 2.2], [2.2, 2.3], [2.3, 2.3], [3.6, 1.9]]])
    witness._sketches = {0: made(odd, free=True), 1: made(odd, free=True)}
    verdict = witness.by_points(0, 1, drive, REACH, None)
    assert verdict.why is None
    np.testing.assert_allclose(verdict.found.pose, 0.0, atol=0.01)


def test_few_things_are_no_place():
    """One corner of two walls, 4 m of them: many rooms have one."""
    corner = np.array([[0.1 * i, 0.0] for i in range(20)] + [[0.0, 0.1 * i] for i in range(1, 20)])
    legs = still(np.zeros((3, 3)), 1e-4 * np.eye(3))
    witness = Witness([legs, legs], None)
    witness._sketches = {0: made(corner), 1: made(corner)}
    places = laid((made(corner), legs), (made(corner), legs), np.zeros(3), *REACH)
    assert places[0].things == 1 and places[0].overlay.matched > POINTS.matched
    assert witness.by_points(0, 1, (np.zeros(3), np.diag(DRIVE**2), 2.0), REACH, None) is None


def test_places_nearly_as_good_make_the_best_one_less_sure():
    """By hand: of three others one is nearly as good and within 0.3 m, so that its shift stands in the covariance."""
    sure = np.diag([1e-4, 1e-4, 1e-6])

    def place(pose, matched):
        return Overlay(np.array(pose), sure, np.zeros((3, 3)), matched, 1.0, 0.0, 0)

    best, other = place([1.0, 2.0, 3.13], 10.0), place([1.2, 2.0, -3.13], 7.5)
    places = [best, other, place([1.1, 2.0, 3.13], 6.9), place([1.5, 2.0, 3.13], 9.0)]
    shift = np.array([0.2, 0.0, 2.0 * np.pi - 6.26])
    doubted = _doubted(places, np.zeros(2))
    np.testing.assert_allclose(doubted.covariance, sure + np.outer(shift, shift), atol=1e-12)
    assert doubted.pose is best.pose


def test_walls_far_away_are_not_many_things():
    """Two endless walls 3 to 20 m off, beams a degree apart: they are two things, or three with a torn end, and no
    place is believed, for nothing tells how far along it is."""
    for off in (3.0, 5.0, 20.0):
        bearings = np.radians(np.arange(-90.0, 90.5))
        with np.errstate(divide="ignore"):
            ranges = np.minimum(off / np.abs(np.sin(bearings)), 79.0)
        rng = np.random.default_rng(int(off))
        poses = np.column_stack([0.2 * np.arange(20), np.zeros(20), np.zeros(20)])
        legs = []
        for _ in range(2):
            noisy = [ranges + 0.01 * rng.standard_normal(len(ranges)) for _ in poses]
            scans = tuple(Scan(0.2 * k, each, bearings) for k, each in enumerate(noisy))
            legs.append(msgspec.structs.replace(still(poses, 1e-6 * np.eye(3)), scans=scans))
        rules = ContourSlam(sensor=SensorConfig(sigma_range=0.01, max_range=80.0)).rules
        witness = Witness(legs, rules)
        drive = np.array([1.03, 0.0, 0.0]), np.diag(DRIVE**2), 2.0
        assert witness.by_points(0, 1, drive, REACH, None) is None
        first, second = drawn(legs[0], rules), drawn(legs[1], rules)
        if first is not None and second is not None:
            assert all(
                each.things <= 3 for each in laid((first, legs[0]), (second, legs[1]), drive[0], *REACH)
            )


def test_a_leg_that_jumps_is_not_drawn():
    """Its grid would not fit in memory."""
    poses = np.array([[0.0, 0.0, 0.0], [3_000.0, 3_000.0, 0.0]])
    scans = (Scan(0.0, np.full(9, 2.0), np.linspace(-0.1, 0.1, 9)),) * 2
    assert drawn(msgspec.structs.replace(still(poses, np.eye(3)), scans=scans), driven_rules()) is None


def test_how_a_maps_own_errors_move_what_is_held_by_its_points():
    """Monte Carlo: one pose of the leg errs, the points seen from there are turned and moved with it, and the rigid
    fit of the points, held beside the covariance that is told."""
    rng = np.random.default_rng(3)
    pose, spread = np.array([2.0, 1.0, 0.3]), np.diag([0.03, 0.05, 0.02]) ** 2
    points, origin = pose[:2] + rng.uniform(-2.0, 2.0, (30, 2)), np.array([-1.0, 4.0])
    told = _carried(still(np.array([pose]), spread), points, origin)
    moved = []
    for error in rng.multivariate_normal(np.zeros(3), spread, 20_000):
        turned = pose[:2] + error[:2] + rotate(error[2], origin - pose[:2])
        moved.append([*(turned - origin), error[2]])
    np.testing.assert_allclose(np.cov(np.array(moved).T), told, atol=3e-4)


def test_a_covariance_is_held_within_another():
    rng = np.random.default_rng(4)
    for _ in range(20):
        a, b = (each @ each.T for each in rng.standard_normal((2, 3, 3)))
        held = _within(a, b)
        assert np.linalg.eigvalsh(b - held).min() > -1e-9 and np.linalg.eigvalsh(
            a - held
        ).min() > -1e-9 * np.trace(a)
        np.testing.assert_allclose(_within(0.5 * b, b), 0.5 * b, atol=1e-9)


def test_whether_places_are_two_is_asked_of_a_point_of_the_second_map():
    """A turn about a point 5 m away leaves the point where it is, and moves the origin."""
    about, turn = np.array([5.0, 0.0]), 0.09
    turned = np.array([*(about - rotate(turn, about)), turn])
    assert is_elsewhere(turned, np.zeros(3)) and not is_elsewhere(turned, np.zeros(3), about=about)


def test_scans_of_nothing_make_no_sketch():
    rules = driven_rules()
    blind = still(np.zeros((3, 3)), 1e-4 * np.eye(3))
    scans = tuple(Scan(0.1 * k, np.full(50, np.inf), np.linspace(-2.0, 2.0, 50)) for k in range(3))
    assert drawn(msgspec.structs.replace(blind, scans=scans), rules) is None
    witness = Witness([msgspec.structs.replace(blind, scans=scans)] * 2, rules)
    assert witness.by_points(0, 1, (np.zeros(3), np.eye(3), 2.0), REACH, None) is None


def driven_rules():
    return ContourSlam(sensor=SensorConfig(sigma_range=0.02, max_range=5.6)).rules


def check_loops(slam, log, frames):
    """Every loop that is believed is right, and the drive with it."""
    estimate, truth = slam.estimate(), log.references[0]
    loops = slam._worker.settled().loops
    assert min(each.shape.length for each in loops.maps) < SPARSE
    for each in loops.graph.relations:
        if not each.loop or each.second == each.first + 1:
            continue
        off = each.pose - compose(inverse(frames[each.first]), frames[each.second])
        off[2] = wrap(off[2])
        assert off @ (0.5 * each.information) @ off < 16.3
    rows = np.searchsorted(truth.times, estimate.trajectory.times)
    error = estimate.trajectory.poses[:, :2] - truth.positions[rows]
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.12
    return estimate.counts["loops"]


def test_a_room_without_contour_is_closed_by_its_points(lab):
    """There are many more loops than contours alone give, which is 1."""
    assert check_loops(*lab[:3]) > 10


@pytest.mark.slow
def test_other_rooms_without_contour():
    assert check_loops(*driven(4)) > 10


def test_a_saved_run_finds_the_same_loops_by_points(tmp_path, lab):
    """Saved in the middle, and again in the end."""
    slam, log = lab[0], lab[1]
    whole, events = slam.estimate(), list(log.open(None))
    half = slam.twin()
    for event in events[: len(events) // 2]:
        half.step(event)
    half.save(tmp_path / "half")
    again = ContourSlam.load(tmp_path / "half")
    for event in events[len(events) // 2 :]:
        again.step(event)
    again.save(tmp_path / "end")
    for resumed in (again, ContourSlam.load(tmp_path / "end")):
        told = resumed.estimate()
        np.testing.assert_array_equal(told.trajectory.poses, whole.trajectory.poses)
        np.testing.assert_array_equal(told.trajectory.covariances, whole.trajectory.covariances)
        assert told.counts == whole.counts


@pytest.mark.parametrize("distance", [0.1, 0.12])
def test_a_tour_of_a_real_laboratory_is_closed(data_root, tmp_path, distance):  # noqa: F811
    """Tables, chairs and shelves, no truth: walls at right angles, held beside each other by hand, say that the drive
    ends with a heading of 1.56 rad. Contours alone find no loop in it."""
    log = data_root / "mines-urg04lx"
    if not log.exists():
        pytest.skip(f"no real data: {log} does not exist")
    setting = f"contour.update_distance={distance}"
    arguments = ["run", str(log), "--out", str(tmp_path / "out"), "--no-figures", "-q", "--set", setting]
    result = CliRunner().invoke(kalmap, arguments)
    assert result.exit_code == 0, result.output
    end = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)[-1]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert abs(wrap(end[3] - 1.56)) < 0.1 and metrics["loops"] >= 4
