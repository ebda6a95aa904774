"""CARMEN logs that the tests write themselves. Oracles: what was written, and poses composed by matrices."""

from __future__ import annotations

import bz2
import gzip
import lzma
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from kalmap.data import check_log, open_log, read_relations, reader_notes
from kalmap.data.carmen import read_carmen
from kalmap.records import LogError
from laser_files import flaser, increment, odom, pairs, spelt, write

RANGES = st.lists(st.floats(0.01, 79.0), min_size=1, max_size=8)
POSES = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1))
STANDING = [flaser([1.0, 2.0, 3.0], (0.0, 0.0, 0.0), 1.0), flaser([1.1, 2.1, 3.1], (1.0, 0.0, 0.0), 2.0)]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(RANGES, POSES, st.floats(-5, 5)), min_size=1, max_size=6))
@example([([1.0], (0.0, 1.4e-45, 0.0), -1.0), ([1.0], (0.0, 0.0, 0.0), 0.0)])  # moves by next to nothing
@example([([1.0], (0.0, 5e-324, 0.0), -1.0), ([1.0], (0.0, 0.0, 0.0), 0.0)])
def test_what_is_written_comes_back_bit_for_bit(drive):
    """Ranges, stamps and line numbers exactly; increments as matrices say; time never back."""
    values = [value for ranges, _, _ in drive for value in ranges]
    assume(values.count(max(values)) < 5)  # else it may be the code for no return
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "drive.log", ["# a comment", *(flaser(*each) for each in drive)])
        moves, scans = pairs(open_log(path))
    assert [s.ranges.tolist() for s in scans] == [list(ranges) for ranges, _, _ in drive]
    assert [s.record for s in scans] == [2 + k for k in range(len(drive))]
    stamps = [s.time if np.isnan(s.stamp) else s.stamp for s in scans]
    assert stamps == [time for _, _, time in drive]
    assert moves[0].values.shape == (0, 3)
    for (_, before, _), (_, after, _), move in zip(drive, drive[1:], moves[1:]):
        np.testing.assert_allclose(move.values[0, :2], increment(before, after)[:2], atol=1e-12)
        turn = move.values[0, 2] - increment(before, after)[2]
        assert abs(np.arctan2(np.sin(turn), np.cos(turn))) < 1e-12
    assert sum(move.durations.sum() for move in moves) == pytest.approx(scans[-1].time - scans[0].time)


@pytest.mark.parametrize(("ending", "pack"), [
    ("", bytes), (".xz", lzma.compress), (".bz2", bz2.compress), (".gz", gzip.compress),
])  # fmt: skip
def test_packed_logs(tmp_path, ending, pack):
    path = tmp_path / f"drive.clf{ending}"
    path.write_bytes(pack("\n".join([*STANDING, ""]).encode()))
    log = open_log(path)
    assert (len(pairs(log)[1]), log.name, log.files) == (2, "drive", (str(path),))
    path.write_bytes(path.read_bytes()[:-20] if ending else b"\xff\xfe\x00 rubbish \x80")
    with pytest.raises(LogError, match=path.name):
        open_log(path)


@pytest.mark.parametrize(("beams", "first", "last"), [
    (180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50), (201, -50, 50), (1, 0, 0),
    (2, -90, 0), (5000, -90, 90 - 180 / 5000),
])  # fmt: skip
def test_the_angles_of_flaser(tmp_path, beams, first, last):
    log = open_log(write(tmp_path / "a.log", [flaser(np.linspace(1, 2, beams), (0.0, 0.0, 0.0), 1.0)]))
    [scan] = pairs(log)[1]
    assert len(scan.bearings) == beams
    np.testing.assert_allclose(np.rad2deg(scan.bearings[[0, -1]]), [first, last], atol=1e-9)
    assert log.defaults.sensor.field_of_view_deg >= 1.0


def robotlaser(ranges, pose, laser, time, remissions: tuple | None = (), reach=20.0):
    bits = "" if remissions is None else f"{len(remissions)} {spelt(remissions)} ".replace("  ", " ")
    head = f"ROBOTLASER1 0 -2.0 4.0 0.5 {reach!r} 0.01 0 {len(ranges)} {spelt(ranges)} {bits}"
    return f"{head}{spelt(laser)} {spelt(pose)} 0.1 0.2 0.5 0.4 1e9 {time!r} host {time!r}"


@pytest.mark.parametrize("remissions", [None, (), (7.0, 8.0, 9.0)])
def test_robotlaser_with_and_without_remissions(tmp_path, remissions):
    """Angles, maximum range and mounting are in the line itself; early logs have no remissions at all."""
    poses = [(0.0, 0.0, 0.0), (1.0, 2.0, np.pi / 2)]
    lasers = [(0.2, 0.1, 0.3), (0.9, 2.2, np.pi / 2 + 0.3)]
    lines = [
        robotlaser([1.0, 20.0, 25.0], pose, laser, k + 1.0, remissions)
        for k, (pose, laser) in enumerate(zip(poses, lasers))
    ]
    log = open_log(write(tmp_path / "a.log", lines))
    moves, scans = pairs(log)
    assert scans[0].ranges.tolist() == [1.0, np.inf, np.inf]
    np.testing.assert_allclose(scans[0].bearings, [-2.0, -1.5, -1.0])
    np.testing.assert_allclose(moves[1].values[0], increment(*poses), atol=1e-12)
    sensor = log.defaults.sensor
    mount = sensor.mount_x, sensor.mount_y, np.deg2rad(sensor.mount_heading_deg)
    np.testing.assert_allclose(mount, (0.2, 0.1, 0.3), atol=1e-9)
    assert sensor.field_of_view_deg == pytest.approx(np.rad2deg(4.0))


def test_rawlaser_takes_the_pose_from_the_odometry_lines(tmp_path):
    """Half way between two ODOM lines on a circle of 1 m radius: half the arc. Before the first: left out."""

    def raw(time):
        return f"RAWLASER1 0 -1.5 3.0 0.1 80.0 0.01 0 2 1.0 2.0 0 {time!r} host {time!r}"

    arc = [(np.sin(a), 1 - np.cos(a), a) for a in (0.0, 0.4, 0.8)]
    lines = [raw(7.0), odom(arc[0], 10.0), raw(10.0), raw(11.0), odom(arc[2], 12.0), raw(12.0), raw(12.4)]
    log = open_log(write(tmp_path / "a.log", lines))
    moves, scans = pairs(log)
    assert [scan.time for scan in scans] == [10.0, 11.0, 12.0, 12.4]
    np.testing.assert_allclose(moves[1].values[0], increment(arc[0], arc[1]), atol=1e-12)
    np.testing.assert_allclose(moves[3].values[0], np.zeros(3), atol=1e-12)
    assert any("left out" in finding.what for finding in check_log(log).findings)
    with pytest.raises(LogError, match="no odometry"):
        open_log(write(tmp_path / "b.log", [raw(1.0)]))


def test_rawlaser_tells_where_the_odometry_lines_stop(tmp_path):
    """Oracle: which scans lie between the two lines that are 3 s apart."""

    def raw(time):
        return f"RAWLASER1 0 -1.5 3.0 0.1 80.0 0.01 0 2 1.0 2.0 0 {time!r} host {time!r}"

    times = [10.0 + k / 5 for k in range(40)]
    lines = [odom((t / 10, 0.0, 0.0), t) for t in times if not 12.0 < t < 15.0] + [raw(t) for t in times]
    log = open_log(write(tmp_path / "a.log", lines))
    (note,) = reader_notes(log)
    assert str(tmp_path / "a.log") in note and "3 s from 12 s to 15 s" in note
    moves, scans = pairs(log)
    assert [scan.time for scan in scans] == [t for t in times if not 12.0 < t < 15.0]
    assert [scan.time for move, scan in zip(moves, scans) if move.covariance is not None] == [15.0]


def test_the_mounting_is_the_parameter_or_else_the_poses(tmp_path):
    line = flaser([1.0, 2.0], (1.0, 1.0, np.pi), 1.0, laser=(0.7, 1.0, np.pi))
    log = open_log(write(tmp_path / "a.log", [line]))
    assert log.defaults.sensor.mount_x == pytest.approx(0.3)
    log = open_log(write(tmp_path / "b.log", ["PARAM robot_frontlaser_offset 0.25 nohost 0", line]))
    assert log.defaults.sensor.mount_x == 0.25


def test_what_comes_back_from_nowhere_is_infinite(tmp_path):
    """NaN, inf, zero, negative, and the constant that many beams share; a standing robot's far wall stays."""
    odd = [flaser([np.nan, np.inf, 0.0, -1.0, 2.0], (0.0, 0.0, 0.0), 0.5)]
    rng = np.random.default_rng(4)
    for k in range(30):
        ranges = rng.uniform(1, 40, 20).round(3)
        ranges[rng.integers(0, 20, 3)] = 50.0
        odd.append(flaser(ranges, (0.0, 0.0, 0.0), 1.0 + k))
    log = open_log(write(tmp_path / "a.log", odd))
    _, scans = pairs(log)
    assert scans[0].ranges.tolist() == [np.inf] * 4 + [2.0]
    written = np.array([[float(w) for w in line.split()[2:22]] for line in odd[1:]])
    np.testing.assert_array_equal([s.ranges for s in scans[1:]], np.where(written == 50.0, np.inf, written))
    assert log.defaults.sensor.max_range == 50.0
    same = [flaser([3.0, 4.0, 5.0, 5.0], (0.0, 0.0, 0.0), float(k)) for k in range(40)]
    assert all(s.ranges.max() == 5.0 for s in pairs(open_log(write(tmp_path / "b.log", same)))[1])
    sick = [flaser([3.0, 81.83, 81.91], (0.0, 0.0, 0.0), 1.0)]
    assert pairs(open_log(write(tmp_path / "c.log", sick)))[1][0].ranges.tolist() == [3.0, np.inf, np.inf]


def test_stamps_that_go_back_are_put_right_and_kept(tmp_path):
    stamps = [10.0, 9.5, 9.8, 10.5, 10.5]
    path = write(tmp_path / "a.log", [flaser([1.0], (0.0, 0.0, 0.0), t) for t in stamps])
    _, scans = pairs(open_log(path))
    np.testing.assert_allclose(
        [s.time for s in scans], [10.0, 10.0 + 1e-6, 10.0 + 2e-6, 10.5, 10.5], atol=1e-12
    )
    kept = [s.stamp for s in scans]
    assert kept[1:3] == [9.5, 9.8] and np.isnan([kept[0], *kept[3:]]).all()
    laser = check_log(open_log(path)).laser
    assert (laser.put_right, laser.step_back) == (2, 0.5)


BAD = {
    "no number": (STANDING[0].replace("2.0", "2.x", 1), "range 2", "expected a number, found '2.x'"),
    "too few": ("FLASER 3 1.0 2.0", "line", "is cut short: 8 words are missing"),
    "no count": ("FLASER", "line", "num_readings is missing"),
    "a count of words": ("FLASER three 1 2 3", "num_readings", "expected a number from 1"),
    "no beams": ("FLASER 0 0 0 0 0 0 0 1.0 host 1.0", "num_readings", "expected a number from 1"),
    "endless beams": ("FLASER 99999999999999999999 1.0", "num_readings", "expected a number from 1"),
    "too many": (STANDING[0] + " 1 2 3", "line", "expected 14 words for 3 beams, found 17"),
    "nan pose": (flaser([1.0], (0.0, np.nan, 0.0), 1.0), "y", "expected a finite number, found nan"),
    "inf time": (flaser([1.0], (0.0, 0.0, 0.0), np.inf), "ipc_time", "expected a finite number, found inf"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_line_is_named_or_skipped(tmp_path, name):
    """Strict: LogError with line and field, after the events before it. Tolerant: skipped, the motion kept whole."""
    line, field, problem = BAD[name]
    path = write(tmp_path / "a.log", [STANDING[0], line, STANDING[1]])
    log, seen = open_log(path), []
    with pytest.raises(LogError) as caught:
        seen += iter(log)
    assert (caught.value.record, caught.value.field, caught.value.file) == (2, field, str(path))
    assert problem in caught.value.problem
    skipped = []
    moves, scans = pairs(log, skipped.append)
    assert [(s.record, s.field) for s in skipped] == [(2, field)] and len(scans) == 2
    assert moves[1].values[0].tolist() == [1.0, 0.0, 0.0]
    report = check_log(log)
    assert report.verdict == "problems" and report.laser.scans == 2


@pytest.mark.parametrize("cut", [1, 3, 9, 20, 40, len(STANDING[1]) - 10])
def test_a_log_cut_in_the_middle_of_its_last_line(tmp_path, cut):
    path = write(tmp_path / "a.log", [STANDING[0], STANDING[1][:cut]], end="")
    with pytest.raises(LogError, match=r"a\.log, record 2"):
        list(open_log(path))
    skipped = []
    assert len(pairs(open_log(path), skipped.append)[1]) == 1 and len(skipped) == 1
    whole = write(tmp_path / "b.log", STANDING, end="")
    assert len(pairs(open_log(whole))[1]) == 2
    odometry = write(tmp_path / "c.log", [*STANDING, odom((0.0, 0.0, 0.0), 3.0)[:18]], end="")
    with pytest.raises(LogError, match=r"record 3.*middle of a line"):
        list(open_log(odometry))


@pytest.mark.parametrize(("content", "says"), [
    (b"", "no line of a CARMEN log"),
    (bytes(range(256)) * 40, "no line of a CARMEN log"),
    (b"ODOM 0 0 0 0 0 0 1 h 1\nRLASER 1 1 0 0 0 0 0 0 1 h 1\n", "it holds 1 RLASER, 1 ODOM"),
])  # fmt: skip
def test_files_without_a_front_laser(tmp_path, content, says):
    (tmp_path / "a.log").write_bytes(content)
    with pytest.raises(LogError, match=says):
        open_log(tmp_path / "a.log")


def test_a_log_of_nothing_but_bad_lines(tmp_path):
    log = open_log(write(tmp_path / "a.log", ["FLASER 2 x", "FLASER"]))
    with pytest.raises(LogError, match="no scan that can be used"):
        list(log.open(lambda record: None))
    assert check_log(log).laser.scans == 0 and check_log(log).text()


def test_a_folder_prefers_the_raw_log(tmp_path):
    write(tmp_path / "a.gfs.log", STANDING[:1])
    write(tmp_path / "a.clf", STANDING)
    assert open_log(tmp_path).source.endswith("a.clf")
    write(tmp_path / "b.clf", STANDING)
    with pytest.raises(LogError, match=r"several laser logs, name one of them: a\.clf, b\.clf"):
        open_log(tmp_path)
    for option in ({"robot": 2}, {"variant": "scans"}, {"scan_topic": "/scan"}):
        with pytest.raises(LogError, match="asked for"):
            open_log(tmp_path / "a.clf", **option)


def test_rear_lasers_are_left_out_and_told(tmp_path):
    drive = read_carmen(write(tmp_path / "a.log", [*STANDING, STANDING[0].replace("FLASER", "RLASER")]))
    assert len(drive.stamps) == 2 and drive.notes == ("only FLASER is read; left out: 1 RLASER",)


def test_relations_beside_a_log(tmp_path):
    path = write(tmp_path / "hall.clf", STANDING)
    write(tmp_path / "hall.relations", ["1.0 2.0 1 0.5 0 0 0 0.25", "2.0 1.0 -1 0 0 0 0 -0.25"])
    [reference] = open_log(path).references
    assert reference.kind == "relations"
    assert reference.relations.first.tolist() == [1.0, 2.0] and reference.relations.second.tolist() == [
        2.0,
        1.0,
    ]
    assert reference.relations.poses.tolist() == [[1.0, 0.5, 0.25], [-1.0, 0.0, -0.25]]
    assert check_log(open_log(path)).references[0].relations == 2


@pytest.mark.parametrize(("row", "says"), [
    ("1 2 3", "record 2, field y: is missing"), ("1 2 3 4 5 6 7 8 9", "expected 8 columns, found 9"),
    ("1 2 a 0 0 0 0 0", "field x: expected a number"), ("1 nan 0 0 0 0 0 0", "field t2: expected a finite number"),
])  # fmt: skip
def test_bad_relations(tmp_path, row, says):
    path = write(tmp_path / "a.relations", ["1 2 0 0 0 0 0 0", row])
    with pytest.raises(LogError, match=says):
        read_relations(path)
    path.write_text("")
    with pytest.raises(LogError, match="holds no relations"):
        read_relations(path)
