"""What all readers of raw laser logs share: poses in between, the code for no return, scanner classes, CoreSLAM."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kalmap.data import check_log, open_log
from kalmap.data.drive import interpolated, no_return, pose_between
from kalmap.records import LogError
from laser_files import flaser, pairs, transform, write


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_poses_in_between_lie_on_the_arc(share):
    """Oracle: the differential equation of constant speed and turn rate in the robot's frame, integrated by scipy."""
    twist = np.array([1.5, -0.4, 2.0])
    a = np.array([3.0, -1.0, 2.9])

    def motion(_, pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return [c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]]

    def at(time):
        return solve_ivp(motion, (0, 1), a, t_eval=[time], rtol=1e-11, atol=1e-12).y[:, -1]

    found = pose_between(a[None], at(1.0)[None], np.array([share]))[0]
    np.testing.assert_allclose(transform(found), transform(at(share)), atol=1e-9)


def test_interpolation_outside_takes_the_nearest_pose():
    times, poses = np.array([1.0, 2.0, 2.0, 4.0]), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]])
    found, outside = interpolated(times, poses, np.array([0.0, 1.5, 3.0, 9.0]))
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 3, 4])
    assert outside.tolist() == [1.0, 0.0, 0.0, 5.0]
    found, outside = interpolated(times[:1], poses[:1], np.array([0.0, 2.0]))
    assert not found.any() and outside.tolist() == [1.0, 1.0]


def test_the_code_for_no_return():
    """A value that ten times as many beams share as any below it; SICK's codes at once; else none."""
    rng = np.random.default_rng(2)
    scans = [rng.uniform(1, 20, 100).round(2) for _ in range(20)]
    assert (
        no_return(scans) == np.inf and no_return([]) == np.inf and no_return([np.full(3, np.inf)]) == np.inf
    )
    marked = [np.append(scan, [25.0, 25.0]) for scan in scans]
    assert no_return(marked) == no_return([scan.astype(np.float32) for scan in marked]) == 25.0
    assert 81.82 < no_return([np.array([3.0, 81.91])]) <= 81.83
    assert 8.18 < no_return([np.array([3.0, 8.183], dtype=np.float32)]) <= 8.183
    assert no_return([np.full(5, 7.0)] * 9) == np.inf  # all beams alike: a wall all around
    assert no_return([np.append(scan, [3.0, 3.0]) for scan in [np.linspace(1, 2, 9)] * 9]) == np.inf


@pytest.mark.parametrize(
    ("beams", "farthest", "reach"), [(180, 4.0, 80.0), (682, 4.0, 5.6), (682, 12.0, 80.0)]
)
def test_the_class_of_a_scanner(tmp_path, beams, farthest, reach):
    """A SICK in a small room is one by its spacing; a fine scanner that sees far is none of the URG's kind."""
    lines = [flaser(np.linspace(1, farthest, beams), (0.0, 0.0, 0.0), 1.0)]
    sensor = open_log(write(tmp_path / "a.log", lines)).defaults.sensor
    assert sensor.max_range == reach and (sensor.sigma_range_ratio > 0) == (reach < 6)


def coreslam(time, left, right, ranges):
    return " ".join(map(str, [time, 14000, left, right, *[0.5] * 20, *ranges]))


def test_coreslam(tmp_path):
    """Oracle: ticks to metres by hand. Straight on by a wheel's turn, then on the spot by one opposite turn each."""
    ranges = np.full(683, 1000)
    ranges[[0, 1, 2]] = 0, 19, 20
    lines = [coreslam(1_000_000, 0, 0, ranges), coreslam(1_100_000, 2000, 2000, ranges)]
    lines.append(coreslam(1_200_000, 1000, 3000, ranges))
    log = open_log(write(tmp_path / "drive.dat", lines))
    moves, scans = pairs(log)
    around = 2 * np.pi * 0.077
    np.testing.assert_allclose(moves[1].values[0], [around, 0, 0], atol=1e-12)
    np.testing.assert_allclose(moves[2].values[0], [0, 0, around / (2 * 0.165)], atol=1e-12)
    assert [s.time for s in scans] == [1.0, 1.1, 1.2]
    assert scans[0].ranges[:4].tolist() == [np.inf, np.inf, 0.02, 1.0]
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings[[0, 340, 682]]), [-119.53125, 0, 120.234375])
    assert log.defaults.sensor.mount_x == 0.145 and log.defaults.sensor.max_range == 5.6


def test_coreslam_cut_and_spoilt(tmp_path):
    whole = coreslam(1_000_000, 0, 0, np.full(683, 1000))
    path = write(tmp_path / "drive.dat", [whole, whole.replace("14000", "x"), whole[:2000]], end="")
    log = open_log(tmp_path)
    with pytest.raises(LogError, match="record 2, field status: expected a number"):
        list(log)
    skipped = []
    assert len(pairs(log, skipped.append)[1]) == 1 and [s.record for s in skipped] == [2, 3]
    assert check_log(log).verdict == "problems"
    path.write_text("1 2 3\n")
    with pytest.raises(LogError, match="no log recognised"):
        open_log(path)


def test_a_clock_that_is_set_back_does_not_stop_time(tmp_path):
    """By hand: 0 to 4 s, the clock set back by an hour, 5 s more; the time between two scans stays a second."""
    stamps = [*np.arange(5.0), *(np.arange(5.0, 10.0) - 3600.0)]
    path = write(tmp_path / "a.log", [flaser([1.0], (0.0, 0.0, 0.0), float(t)) for t in stamps])
    _, scans = pairs(open_log(path))
    steps = np.diff([scan.time for scan in scans])
    assert (steps > 0.0).all() and np.allclose(steps[[0, 1, 2, 3, 5, 6, 7, 8]], 1.0)
    assert [scan.stamp for scan in scans[5:]] == stamps[5:]
