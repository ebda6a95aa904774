"""Bad input to a map of contours, in the library: a clear error or an honest answer, and only finite numbers."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pytest

from contour_rooms import block_log, events_of, mapper
from kalmap.gaussian import CentralDifference
from kalmap.geometry.se2 import rotate
from kalmap.models import Ackermann, VelocitySteering
from kalmap.records import ConfigError, ContourConfig, EventError, Odometry, Scan, Sightings
from kalmap.simulate import simulate, world_by_name
from kalmap.simulate.disturb_scans import (
    with_bad_ranges,
    with_beams,
    with_clock_jump,
    without_odometry,
    without_scans,
)
from kalmap.slam import run
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.slam import ContourSlam
from slam_problems import STEERING_BIASES

METHODS = ["slasem", "dc-slasem"]


@cache
def drive(**overrides):
    return block_log(**overrides)


@cache
def corridor(seed=1):
    """30 m between bare walls."""
    world = msgspec.structs.replace(world_by_name("corridor"), waypoints=np.array([[0.0, 0.0], [30.0, 0.0]]))
    return with_beams(simulate(world, seed), 120)


def changed(log, change):
    """The log with every scan changed."""
    return msgspec.structs.replace(
        log, open=lambda skip=None: (change(e) if isinstance(e, Scan) else e for e in log.open(skip))
    )


def outcome_of(log, method="dc-slasem", tolerant=False, **settings):
    """A run, all of whose numbers must be finite and whose covariances must be ones."""
    outcome = run(mapper(log, method, **settings), log, tolerant=tolerant)
    estimate, trace = outcome.estimate, outcome.trace
    contours, trajectory = estimate.contours, estimate.trajectory
    numbers = [estimate.pose, estimate.covariance, trace.poses, trace.covariances, estimate.sweeps().poses]
    numbers += [trajectory.times, trajectory.poses, trajectory.covariances]
    numbers += [contours.positions, contours.covariances, contours.normals]
    assert all(np.isfinite(each).all() for each in numbers)
    for covariances in (estimate.covariance[None], trajectory.covariances, contours.covariances):
        assert np.linalg.eigvalsh(covariances).min(initial=0.0) > -1e-12
    return outcome


@cache
def good_outcome(method):
    """Of the drive as it is."""
    return outcome_of(drive(), method)


def errors_of(log, outcome):
    """(K,) m of the whole drive against the truth."""
    course, reference = outcome.estimate.trajectory, log.references[0]
    rows = np.searchsorted(reference.times, course.times - 1e-9)
    return np.hypot(*(course.poses[:, :2] - reference.positions[rows]).T)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_bad_ranges_are_passed_over(method, share):
    """NaN, inf and zero by turns. Oracle: the true drive, within twice the error of the good scans' run."""
    log = drive()
    good = errors_of(log, good_outcome(method))
    bad = errors_of(log, outcome_of(with_bad_ranges(log, share, 3), method))
    assert np.sqrt((bad**2).mean()) < 0.02 + 2.0 * np.sqrt((good**2).mean())


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "value", [np.nan, np.inf, 0.0, -2.0, 1e-9, 1e300, None], ids=lambda v: "no beams" if v is None else str(v)
)
def test_scans_that_show_nothing_leave_dead_reckoning(method, value):
    """Independent: odometry alone, integrated beside the filter; no contours, and a covariance as wide as its own."""
    log = drive()
    if value is None:
        bad = changed(log, lambda e: msgspec.structs.replace(e, ranges=np.zeros(0), bearings=np.zeros(0)))
    else:
        bad = changed(log, lambda e: msgspec.structs.replace(e, ranges=np.full(len(e.ranges), value)))
    outcome = outcome_of(bad, method)
    assert outcome.error is None and len(outcome.estimate.contours) == 0
    np.testing.assert_allclose(outcome.estimate.pose, outcome.dead_reckoning[1][-1], atol=1e-9)
    assert np.sqrt(outcome.estimate.covariance[0, 0]) > 0.5 * errors_of(log, outcome)[-1]
    counts = outcome.estimate.counts
    assert counts["loops"] == 0 and counts["local_maps_loose"] == counts["local_maps"]


@pytest.mark.parametrize("method", METHODS)
def test_one_beam_is_dead_reckoning_and_five_thousand_are_a_map(method):
    """Independent: odometry alone; the true drive."""
    log = drive()
    one = outcome_of(with_beams(log, 1), method)
    assert len(one.estimate.contours) == 0
    np.testing.assert_allclose(one.estimate.pose, one.dead_reckoning[1][-1], atol=1e-9)
    short = msgspec.structs.replace(log, open=lambda skip=None: list(log.open(skip))[:160])
    many = outcome_of(with_beams(short, 5_000), method)
    assert len(many.estimate.contours) > 40 and errors_of(log, many).max() < 0.15


@pytest.mark.parametrize("method", METHODS)
def test_upside_down_is_the_same_map(method):
    """Oracle: the true drive, beams from left to right; and the same scans, their beams in the other order, to the
    bit."""
    log = drive(upside_down=True)
    outcome = outcome_of(log, method)
    assert np.diff(next(e for e in log.open(None) if isinstance(e, Scan)).bearings[:2])[0] != 0.0
    assert errors_of(log, outcome).max() < 0.15 and len(outcome.estimate.contours) > 80
    turned = changed(
        log, lambda e: msgspec.structs.replace(e, ranges=e.ranges[::-1], bearings=e.bearings[::-1])
    )
    assert outcome_of(turned, method).estimate.pose.tobytes() == outcome.estimate.pose.tobytes()


@pytest.mark.parametrize("method", METHODS)
def test_a_robot_that_never_moves_has_a_map_of_what_it_sees(method):
    """Oracle: the true walls and the start: exactly there, one local map, samples on walls or furniture."""
    log = simulate(world_by_name("standstill"), 1)
    outcome = outcome_of(log, method)
    estimate = outcome.estimate
    assert outcome.error is None and len(estimate.trajectory.times) == outcome.frames == 301
    np.testing.assert_array_equal(estimate.trajectory.poses, np.zeros((301, 3)))
    walls = log.references[0].walls
    a, b = walls[:, :2], walls[:, 2:]
    way = b - a
    off = estimate.contours.positions[:, None] - a
    share = np.clip((off * way).sum(-1) / (way**2).sum(-1), 0.0, 1.0)
    apart = np.hypot(*np.moveaxis(off - share[..., None] * way, -1, 0)).min(axis=1)
    assert len(apart) > 30 and (apart < 0.06).mean() > 0.9
    assert (estimate.counts["local_maps"], estimate.counts["loops"]) == (1, 0)


@pytest.mark.parametrize("method", METHODS)
def test_along_a_bare_corridor_the_robot_is_as_unsure_as_its_odometry(method):
    """Independent: the motion model's own variance, 0.1^2 of each increment, and that of its scale: along the corridor
    it grows from end to end, across it stays; the answer says so."""
    log = corridor()
    outcome = outcome_of(log, method, close_distance=6.0)
    course = outcome.estimate.trajectory
    along = np.sqrt(course.covariances[:, 0, 0])
    quarters = along[[len(along) // 8, len(along) // 4, len(along) // 2, -1]]
    assert (np.diff(quarters) > 0.01).all()
    steps = np.diff(course.poses[:, 0])
    alone = np.hypot(0.1 * np.sqrt((steps**2).sum()), log.defaults.contour.sigma_way_scale * steps.sum())
    assert 0.8 * alone < along[-1] < 3.0 * alone
    counts = outcome.estimate.counts
    assert counts["local_maps"] == (1 if method == "slasem" else 6)
    assert counts["local_maps_loose"] >= max(1, counts["local_maps"] - 1)  # the last one may just have begun
    assert abs(counts["weakest_direction_deg"]) < 5.0 and counts["weakest_direction_sigma_m"] < 1.2 * alone
    room = good_outcome(method).estimate.counts
    assert room["local_maps_loose"] == 0 and room["weakest_direction_sigma_m"] < 0.05


def test_no_place_in_a_bare_corridor_is_called_a_loop_far_back():
    """Every stretch looks like every other: relations only between maps that stand beside each other in truth."""
    log = corridor(2)
    slam = mapper(log, close_distance=6.0)
    run(slam, log, reckon=False)
    loops = [each for each in slam._worker.settled().loops.graph.relations if each.loop]
    assert all(each.second - each.first == 1 for each in loops)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_people_do_not_make_a_wrong_loop(seed):
    """Truth: 40 people in the corridors; every loop that is believed is where the drive really was, to 0.5 m and
    three standard deviations that it states (along a corridor they are large)."""
    log = simulate(world_by_name("crowd"), seed)
    plain = mapper(log, close_distance=10.0)
    slam = ContourSlam(plain.motion, plain.scanner, plain.settings, CentralDifference(), start=log.start)
    outcome = run(slam, log, reckon=False)
    joined, reference = slam._worker.settled(), log.references[0]
    starts = [
        joined.legs[0].times[0],
        *(leg.times[-1] for leg in joined.legs[:-1]),
    ]  # where one closes, one begins
    rows = np.searchsorted(reference.times, np.array(starts) - 1e-9)
    places, headings = reference.positions[rows], reference.headings[rows]
    loops = [each for each in joined.loops.graph.relations if each.loop]
    for each in loops:
        way = rotate(-headings[each.first], places[each.second] - places[each.first])
        unsure = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(each.information)[:2, :2]).max())
        assert np.hypot(*(way - each.pose[:2])) < 0.5 + 3.0 * unsure
    assert len(loops) > 5 and errors_of(log, outcome).max() < 1.5


@pytest.mark.parametrize("method", METHODS)
def test_without_odometry_every_scan_is_refused(method):
    log = without_odometry(drive())
    outcome = outcome_of(log, method)
    assert "record 1, field time: t = 0 s: a scan before any odometry" in str(outcome.error)
    outcome = outcome_of(log, method, tolerant=True)
    assert outcome.error is None and outcome.skipped_total == 338 and outcome.frames == 0


@pytest.mark.parametrize("method", METHODS)
def test_without_scans_the_pose_is_that_of_the_odometry(method):
    """Independent: odometry alone."""
    outcome = outcome_of(without_scans(drive()), method)
    assert outcome.error is None and outcome.frames == 0 and len(outcome.estimate.contours) == 0
    np.testing.assert_allclose(outcome.estimate.pose, outcome.dead_reckoning[1][-1], atol=1e-9)
    np.testing.assert_allclose(outcome.estimate.pose, outcome.trace.poses[-1], atol=1e-12)
    assert outcome.estimate.counts["local_maps"] == 0


@pytest.mark.parametrize("method", METHODS)
def test_clocks_that_jump(method):
    """Forwards nothing changes but the times; backwards ends the run there, or is skipped and counted."""
    log = drive()
    plain = good_outcome(method).estimate
    later = outcome_of(with_clock_jump(log, 20.0, 1e4), method).estimate
    assert later.pose.tobytes() == plain.pose.tobytes() and later.time == plain.time + 1e4
    back = outcome_of(with_clock_jump(log, 20.0, -5.0), method)
    assert "comes late: the filter is already at 19.8 s" in str(back.error)
    assert back.estimate.time == pytest.approx(19.8) and back.frames == 100
    tolerant = outcome_of(with_clock_jump(log, 20.0, -5.0), method, tolerant=True)
    assert tolerant.error is None and 46 <= tolerant.skipped_total <= 50  # 24 scans and their odometry


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("number", [2, 3, 9, 30])
def test_a_scan_that_is_none_is_refused_when_it_comes(method, number):
    """Also one that would not have been used; the rest of the run is as if it had not been there."""
    log, seen = drive(), []

    def cut(scan):
        seen.append(scan)
        bad = len(seen) % 338 == number
        return msgspec.structs.replace(scan, ranges=scan.ranges[:-1]) if bad else scan

    strict = outcome_of(changed(log, cut), method)
    assert f"record {number}, field ranges: " in str(strict.error) and strict.frames == number - 1
    seen.clear()
    tolerant = outcome_of(changed(log, cut), method, tolerant=True)
    assert tolerant.error is None and (tolerant.skipped_total, tolerant.frames) == (1, 337)
    assert errors_of(log, tolerant).max() < 0.15


def test_bearings_that_are_no_numbers_take_their_beams_away():
    log = drive()

    def spoil(scan):
        bearings = scan.bearings.copy()
        bearings[::7] = np.nan
        return msgspec.structs.replace(scan, bearings=bearings)

    outcome = outcome_of(changed(log, spoil))
    assert errors_of(log, outcome).max() < 0.15
    sweeps = outcome.estimate.sweeps()
    assert np.isfinite(sweeps.points()).all()
    assert np.mean([len(each.ranges) for each in sweeps.scans]) < 0.87 * len(events_of(log, 1)[-1].ranges)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (Sightings(1.0, np.array([[2.0, 0.1]])), "is of landmarks, and the map is of contours"),
        (Scan(np.nan, np.ones(3), np.zeros(3)), "not a finite number"),
        (Scan(0.5, np.ones(3), np.zeros(3)), "comes late"),
        (Scan(1.0, np.ones((1, 3)), np.zeros((1, 3))), "expected a row of each"),
        (Scan(1.0, np.ones(3), np.zeros(4)), "expected a row of each"),
        (Odometry(1.0, np.array([[np.nan, 0.0, 0.0]]), np.array([0.1])), "not finite"),
        (Odometry(1.0, np.array([[0.1, 0.0, 0.0]]), np.array([-0.1])), "negative"),
        (Odometry(1.0, np.array([[0.1, 0.0]]), np.array([0.1])), "expected 1 samples of 3 numbers"),
    ],
)
def test_an_event_that_cannot_be_used_changes_nothing(event, words):
    """Oracle: the estimator that it never came to."""
    slam = mapper(drive())
    for each in list(drive().open(None))[:9]:
        slam.step(msgspec.structs.replace(each, time=each.time if each.time < 0.9 else 0.9))
    pose, covariance, time, frames = slam.pose, slam.pose_covariance, slam.time, slam.frames_taken
    with pytest.raises(EventError, match=words):
        slam.step(event)
    assert (slam.time, slam.frames_taken) == (time, frames)
    assert (slam.pose.tobytes(), slam.pose_covariance.tobytes()) == (pose.tobytes(), covariance.tobytes())


def test_settings_that_contradict_each_other_are_refused():
    for words, make in (
        ("coordinates", lambda: ContourSlam(coordinates="polar")),
        ("biases", lambda: ContourSlam(VelocitySteering(biases=STEERING_BIASES[:1]))),
        ("start", lambda: ContourSlam(start=(0.0, np.nan, 0.0))),
        ("start_covariance", lambda: ContourSlam(start_covariance=-np.eye(3))),
        ("lineariser", lambda: ContourSlam(lineariser=lambda f, mean, cov: None)),
    ):
        with pytest.raises(ConfigError, match=words):
            make()
    assert ContourSlam(Ackermann(), settings=ContourConfig(method="slasem")).landmark_count == 0


def test_a_scan_of_nothing_that_is_there_does_not_move_the_robot():
    """Independent: the drive without them. Two scans of surfaces drawn at random, 30 times: every time they are used,
    and leave the pose within 5 cm."""
    log, apart = drive(), []
    events = list(log.open(None))[:100]
    good = mapper(log, "slasem")
    for event in events:
        good.step(event)
    for seed in range(100, 130):
        slam, rng = mapper(log, "slasem"), np.random.default_rng(seed)
        for number, event in enumerate(events):
            if isinstance(event, Scan) and number in (79, 81):
                event = msgspec.structs.replace(event, ranges=np.repeat(rng.uniform(0.7, 4.0, 12), 10))
            slam.step(event)
        apart.append(np.abs(slam.pose - good.pose).max())
    assert min(apart) > 0.0 and max(apart) < 0.05


@pytest.mark.parametrize("background", [False, True])
def test_a_map_that_cannot_be_joined_loses_nothing(background, monkeypatch):
    """The third map's place cannot be judged: it stays behind the second, the reason is told, the drive goes on."""
    seek, calls = Loops.seek, []

    def failing(self, witness):
        calls.append(len(self.maps))
        if len(self.maps) == 3 and calls.count(3) == 1:
            raise np.linalg.LinAlgError("singular, as it happens")
        seek(self, witness)

    monkeypatch.setattr(Loops, "seek", failing)
    log = block_log()
    slam = mapper(log, background=background)
    outcome = run(slam, log, reckon=False)
    assert outcome.error is None and outcome.estimate.counts["local_maps"] >= 4
    loops = slam._worker.settled().loops
    assert loops.open[2, 2].endswith("singular, as it happens")
    truth = log.references[0].positions[: len(outcome.estimate.trajectory.poses)]
    assert np.hypot(*(outcome.estimate.trajectory.poses[:, :2] - truth).T).max() < 0.5
