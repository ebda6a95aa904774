"""ROS 1 and ROS 2 bags written by rosbags' own writers. Oracles: what was written, and poses composed by matrices."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from kalmap.data import check_log, open_log, reader_notes
from kalmap.records import LogError
from laser_files import KINDS, arc, drive, increment, jumped, odometry, pairs, scan, still, tf, write_bag, yaw

FLAT = (0.0, 0.0, 0.0)


def ranges_of(messages, topic="/scan"):
    return [message.data["ranges"] for message in messages if message.topic == topic]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_written_comes_back(tmp_path, kind):
    """Ranges and header stamps bit for bit, increments between interpolated poses as on the circle itself."""
    messages = still(drive(), place=(0.2, -0.1, 0.5), turn=yaw(0.3))
    log = open_log(write_bag(tmp_path, kind, messages))
    moves, scans = pairs(log)
    np.testing.assert_array_equal([s.ranges for s in scans], ranges_of(messages))
    assert [s.time for s in scans] == [round((100.03 + k / 10) * 1e9) / 1e9 for k in range(5)]
    assert [s.record for s in scans] == [1, 2, 3, 4, 5] and all(np.isnan(s.stamp) for s in scans)
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings), np.arange(9) - 90.0, atol=1e-5)
    assert moves[0].values.shape == (0, 3)
    for before, after, move in zip(scans, scans[1:], moves[1:]):
        np.testing.assert_allclose(move.values[0], increment(arc(before.time), arc(after.time)), atol=1e-7)
        assert move.durations[0] == after.time - before.time
    sensor = log.defaults.sensor
    assert (sensor.mount_x, sensor.mount_y) == (0.2, -0.1)
    assert sensor.mount_heading_deg == pytest.approx(np.rad2deg(0.3))
    assert (log.defaults.motion.model, log.defaults.contour.method) == ("increments", "dc-slasem")
    assert log.settings == {"scan_topic": "/scan", "odometry_topic": "/odom"}
    assert check_log(log).verdict == "notes" and reader_notes(log) == ()


def test_the_three_formats_and_all_ways_to_name_them_are_one(tmp_path):
    """sqlite3, MCAP and ROS 1; the folder, its metadata, its data file, the folder around a ROS 1 bag."""
    messages = still(drive())
    bag = write_bag(tmp_path, "bag", messages)
    sqlite, mcap = (write_bag(tmp_path, kind, messages) for kind in KINDS[1:])
    single = tmp_path / "single"
    single.mkdir()
    shutil.copy(bag, single)
    paths = [bag, single, sqlite, mcap, sqlite / "metadata.yaml"]
    paths += [*sqlite.glob("*.db3"), *mcap.glob("*.mcap")]
    assert len(paths) == 7
    found = [pairs(open_log(path)) for path in paths]
    for moves, scans in found[1:]:
        for a, b in zip(found[0][1], scans):
            assert a.time == b.time and a.ranges.tolist() == b.ranges.tolist()
            assert a.bearings.tolist() == b.bearings.tolist()
        for a, b in zip(found[0][0], moves):
            assert a.values.tolist() == b.values.tolist() and a.durations.tolist() == b.durations.tolist()
    with pytest.raises(LogError, match="several laser logs"):
        open_log(tmp_path)


def test_the_time_of_recording_is_not_used(tmp_path):
    late = [message._replace(recorded=1e6 + k) for k, message in enumerate(drive())]
    first = pairs(open_log(write_bag(tmp_path, "mcap", still(drive()), "a")))
    second = pairs(open_log(write_bag(tmp_path, "mcap", still(late), "b")))
    assert [s.time for s in first[1]] == [s.time for s in second[1]]
    assert [m.values.tolist() for m in first[0]] == [m.values.tolist() for m in second[0]]


def test_odometry_from_the_transforms_and_never_from_the_map(tmp_path):
    """Without odometry messages: odom -> base_link. map -> odom is a correction, however often it is there."""
    messages = []
    for k in range(6):
        t = 100 + k / 10
        x, y, a = arc(t)
        messages += [
            *[tf(t, "map", "odom", (5.0 * k, 3.0, 0.0), yaw(0.5)) for _ in range(3)],
            tf(t, "odom", "base_link", (x, y, 0.0), yaw(a)),
            tf(t, "base_link", "wheel", FLAT, yaw(float(k))),
        ]
        if k < 5:
            messages.append(scan(t + 0.05, np.full(4, 2.0)))
    bag = write_bag(tmp_path, "bag", still(messages, place=(0.1, 0.0, 0.0)))
    log = open_log(bag)
    moves, scans = pairs(log)
    for before, after, move in zip(scans, scans[1:], moves[1:]):
        np.testing.assert_allclose(move.values[0], increment(arc(before.time), arc(after.time)), atol=1e-7)
    assert log.settings["odometry_topic"] == "/tf" and log.defaults.sensor.mount_x == 0.1
    only = [m for m in messages if m.kind.endswith("Scan") or m.frame == "map"]
    with pytest.raises(LogError, match=r"no odometry.*map -> odom.*/scan \(sensor_msgs"):
        open_log(write_bag(tmp_path, "bag", only, "other"))


QUATERNIONS = {
    "upside down": (1.0, 0.0, 0.0, 0.0),
    "upside down by pitch": (0.0, 1.0, 0.0, 0.0),
    "upside down, not of length one": (0.5, 0.5, 0.0, 0.0),
    "upright": yaw(0.4),
}


@pytest.mark.parametrize("step", [np.deg2rad(3), np.deg2rad(-3)])
@pytest.mark.parametrize("name", QUATERNIONS)
def test_mountings_put_every_point_where_the_transform_does(tmp_path, name, step):
    """Oracle: the points of the scan rotated in three dimensions by scipy, through two transforms, one of them given
    the other way round."""
    from scipy.spatial.transform import Rotation

    turn, place, base = QUATERNIONS[name], np.array([0.3, 0.1, 0.4]), np.array([0.0, 0.2, 0.0])
    ranges = np.arange(1, 31, dtype=np.float32)
    messages = [
        tf(0.0, "stand", "base_link", base, yaw(0.2), "/tf_static"),
        tf(0.0, "stand", "laser", place, turn, "/tf_static"),
        *drive()[:1],
        scan(100.05, ranges, start=-step * 10, step=step, high=40.0),
        *drive()[2:3],
    ]
    log = open_log(write_bag(tmp_path, "sqlite3", messages))
    [found] = pairs(log)[1]
    assert (np.diff(found.bearings) > 0).all()
    sensor = log.defaults.sensor
    heading = np.deg2rad(sensor.mount_heading_deg) + found.bearings
    points = np.column_stack([np.cos(heading), np.sin(heading)]) * found.ranges[:, None]
    points += [sensor.mount_x, sensor.mount_y]
    angles = -step * 10 + step * np.arange(30)
    beams = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) * ranges[:, None]
    in_stand = Rotation.from_quat(turn).apply(beams) + place
    wanted = Rotation.from_quat(yaw(0.2)).inv().apply(in_stand - base)[:, :2]
    order = np.argsort(found.ranges)
    np.testing.assert_allclose(points[order], wanted, atol=1e-5)


def test_a_full_turn_starts_behind(tmp_path):
    """Angles from 0 to 360 degrees come out ascending from -180 on, every range with its own direction."""
    ranges = np.arange(1, 9, dtype=np.float32)
    messages = [odometry(100.0, FLAT), scan(100.0, ranges, "base_link", start=0.0, step=np.pi / 4)]
    [found] = pairs(open_log(write_bag(tmp_path, "bag", messages)))[1]
    np.testing.assert_allclose(np.rad2deg(found.bearings), [-135, -90, -45, 0, 45, 90, 135, 180], atol=1e-4)
    assert found.ranges.tolist() == [6, 7, 8, 1, 2, 3, 4, 5]


def test_a_laser_that_sees_no_plan(tmp_path):
    standing = (0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4))
    with pytest.raises(LogError, match="tilted by 90 degrees"):
        open_log(write_bag(tmp_path, "bag", still(drive(), turn=standing)))


def test_a_laser_that_moves_on_the_robot_is_refused(tmp_path):
    swing = [tf(100 + k / 10, "base_link", "laser", FLAT, yaw(0.1 * k)) for k in range(5)]
    with pytest.raises(LogError, match="'laser' moves against 'base_link'"):
        open_log(write_bag(tmp_path, "bag", [*swing, *drive()]))


def test_no_transform_to_the_laser_is_told(tmp_path):
    log = open_log(write_bag(tmp_path, "bag", drive()))
    assert log.defaults.sensor.mount_x == 0.0
    assert "no transform from 'base_link' to the laser 'laser'" in reader_notes(log)[0]
    assert any("no transform" in finding.what for finding in check_log(log).findings)
    same = open_log(write_bag(tmp_path, "bag", drive(frame="/base_link"), "same"))
    assert reader_notes(same) == ()


def test_two_lasers(tmp_path):
    """/scan before the busier one; the busier one where none is called so; --scan-topic before all; all told."""
    rear = [scan(100.01 + k / 20, np.full(3, 7.0), topic="/rear") for k in range(8)]
    path = write_bag(tmp_path, "bag", still([*drive(), *rear]))
    log = open_log(path)
    assert log.settings["scan_topic"] == "/scan" and len(pairs(log)[1][0].ranges) == 9
    assert reader_notes(log) == (
        "several topics of laser scans: /scan (5) is read, not /rear (8); see --scan-topic",
    )
    chosen = open_log(path, scan_topic="rear")
    assert len(pairs(chosen)[1]) == 8 and reader_notes(chosen) == ()
    front = [scan(100.01 + k / 20, np.full(3, 7.0), topic="/front") for k in range(2)]
    busier = open_log(write_bag(tmp_path, "bag", still([*drive()[::2], *rear, *front]), "b"))
    assert busier.settings["scan_topic"] == "/rear"
    both = [*drive(), *(scan(100.07 + k / 10, np.full(3, 7.0), frame="rear") for k in range(3))]
    mixed = open_log(write_bag(tmp_path, "bag", still(both), "c"))
    assert len(pairs(mixed)[1]) == 5  # another laser on the same topic is left out
    assert any("left out" in finding.what for finding in check_log(mixed).findings)


MISSING = {
    "no scans": (drive()[::2], {}, r"no laser scans .*it holds /odom \(nav_msgs/msg/Odometry, 6\)"),
    "no odometry": (drive()[1::2], {}, r"no odometry.*it holds /scan \(sensor_msgs/msg/LaserScan, 5\)"),
    "no such topic": (drive(), {"scan_topic": "/front"}, "field scan_topic: no topic /front; it holds"),
    "topic of another type": (drive(), {"scan_topic": "/odom"}, "/odom holds no laser scans"),
    "no odometry there": (drive(), {"odometry_topic": "/scan"}, "/scan holds no odometry or transforms"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", MISSING)
def test_what_is_missing_is_said_with_what_is_there(tmp_path, kind, name):
    messages, topics, says = MISSING[name]
    with pytest.raises(LogError, match=says):
        open_log(write_bag(tmp_path, kind, messages), **topics)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags(tmp_path, kind):
    """Empty, cut and overwritten files: a LogError that names the file, or, where the damage is in messages, events."""
    path = write_bag(tmp_path, kind, still(drive()))
    file = path if path.is_file() else next(p for p in path.iterdir() if p.name != "metadata.yaml")
    whole, rng = file.read_bytes(), np.random.default_rng(1)
    noise = bytearray(whole)
    for place in rng.integers(0, len(whole), 2000):
        noise[place] = int(rng.integers(256))
    for content in (b"", whole[: len(whole) // 2], whole[:-30], b"\x00" * 4000, bytes(noise)):
        file.write_bytes(content)
        try:
            list(open_log(path).open(lambda record: None))
        except LogError as error:
            assert path.name in str(error)


def test_a_bag_that_is_text(tmp_path):
    for name in ("a.bag", "a.db3", "a.mcap"):
        (tmp_path / name).write_text("no bag at all\n" * 100)
        with pytest.raises(LogError, match="cannot be read as a bag"):
            open_log(tmp_path / name)
    (tmp_path / "metadata.yaml").write_text("version: 3\n")
    with pytest.raises(LogError, match="cannot be read as a bag"):
        open_log(tmp_path)


def test_ranges_that_are_none(tmp_path):
    """NaN, inf, zero, negative, below range_min and above range_max are no return; the limits themselves are one."""
    odd = np.array([np.nan, np.inf, -np.inf, 0, -1, 0.05, 0.1, 2, 30, 30.5], dtype=np.float32)
    messages = [odometry(100.0, FLAT), scan(100.0, odd, "base_link", low=np.float32(0.1))]
    log = open_log(write_bag(tmp_path, "sqlite3", messages))
    expected = [np.inf] * 6 + [float(np.float32(0.1)), 2.0, 30.0, np.inf]
    assert pairs(log)[1][0].ranges.tolist() == expected
    assert check_log(log).laser.no_returns == pytest.approx(0.7)


def test_one_beam_many_beams_and_changing_numbers_of_them(tmp_path):
    sizes = [1, 5000, 3]
    messages = [odometry(100.0, FLAT), odometry(101.0, FLAT)]
    messages += [
        scan(100.1 + k / 10, np.linspace(1, 2, n), "base_link", step=np.deg2rad(0.036), bits=np.arange(n) / 7)
        for k, n in enumerate(sizes)
    ]
    log = open_log(write_bag(tmp_path, "mcap", messages))
    _, scans = pairs(log)
    assert [len(s.ranges) for s in scans] == [len(s.bearings) for s in scans] == sizes
    assert [len(s.intensities) for s in scans] == sizes
    assert scans[1].intensities.tolist() == (np.arange(5000) / 7).astype(np.float32).astype(float).tolist()
    assert check_log(log).laser.beams == (1, 5000)


def test_late_scans_are_sorted(tmp_path):
    messages = drive()
    messages[1], messages[3] = messages[3], messages[1]
    log = open_log(write_bag(tmp_path, "bag", still(messages)))
    moves, scans = pairs(log)
    assert [s.record for s in scans] == [2, 1, 3, 4, 5]
    np.testing.assert_allclose(moves[1].values[0], increment(arc(100.03), arc(100.13)), atol=1e-7)
    assert reader_notes(log) == ("scans out of order were sorted by their stamps (1)",)


@pytest.mark.parametrize("shift", [-40.0, 500.0])
def test_a_clock_that_jumps(tmp_path, shift):
    """Strict: an error at the scan after the jump. Tolerant: on, the motion across unknown, time never back."""
    log = open_log(write_bag(tmp_path, "mcap", still(jumped(shift))))
    seen = []
    with pytest.raises(
        LogError, match=f"record 4, field header.stamp: the clock jumps by {shift + 0.1:g} s"
    ) as e:
        seen += iter(log)
    assert e.value.record == 4
    skipped = []
    moves, scans = pairs(log, skipped.append)
    assert [(s.record, s.field) for s in skipped] == [(4, "header.stamp")] and len(scans) == 9
    across = moves[3]
    assert not across.values.any() and across.covariance[0, 0, 0] >= 0.25
    np.testing.assert_allclose(moves[5].values[0], increment(arc(100.43), arc(100.53)), atol=1e-6)
    stamps = [s.time if np.isnan(s.stamp) else s.stamp for s in scans]
    np.testing.assert_allclose(np.diff(stamps), [0.1] * 2 + [shift + 0.1] + [0.1] * 5, atol=1e-6)
    report = check_log(log)
    assert report.verdict == "problems" and any("clock jumps" in f.what for f in report.findings)


def test_one_wild_stamp_is_no_end_of_the_log(tmp_path):
    """A scan stamped a year ahead is left out as lying outside the odometry; the others stay as they are."""
    messages = drive(10)
    messages[9] = messages[9]._replace(stamp=messages[9].stamp + 3e7)
    log = open_log(write_bag(tmp_path, "mcap", still(messages)))
    skipped = []
    _, scans = pairs(log, skipped.append)
    assert [s.record for s in scans] == [1, 2, 3, 4, 6, 7, 8, 9] and len(skipped) == 2
    assert all(np.isnan(s.stamp) for s in scans)


def test_scans_without_odometry_around_them_are_left_out(tmp_path):
    """Half a second is bridged by the nearest pose; more is not."""
    lone = [scan(t, np.full(3, 2.0)) for t in (98.0, 99.7, 101.2)]
    log = open_log(write_bag(tmp_path, "bag", still([*lone[:2], *drive(), lone[2]])))
    moves, scans = pairs(log)
    assert [s.record for s in scans] == [2, 3, 4, 5, 6, 7]
    np.testing.assert_allclose(moves[1].values[0], increment(arc(100.0), arc(100.03)), atol=1e-7)
    nothing = open_log(write_bag(tmp_path, "bag", still([lone[0], *drive()[::2]]), "b"))
    with pytest.raises(LogError, match="no scan that can be used"):
        list(nothing)


def test_a_silent_odometry_is_told_and_its_scans_are_left_out(tmp_path):
    """The one step across is that of the circle, and stated as wider than a tenth of its way."""
    messages = [odometry(t / 10, arc(t / 10)) for t in range(1000, 1101) if not 1030 < t < 1070]
    messages += [scan(t / 10 + 0.05, np.full(3, 2.0)) for t in range(1000, 1100)]
    path = write_bag(tmp_path, "mcap", still(messages))
    log = open_log(path)
    (note,) = reader_notes(log)
    assert str(path) in note and "4 s from 103 s to 107 s" in note
    findings = check_log(log).findings
    assert any(note == finding.what for finding in findings)
    (left_out,) = [finding for finding in findings if finding.what.startswith("left out")]
    assert left_out.count == 40 and left_out.first[0] == "record 31: inside a silence of the odometry"
    moves, scans = pairs(log)
    times = np.array([s.time for s in scans])
    assert not ((times > 103.0) & (times < 107.0)).any() and len(times) == 60
    (at,) = np.flatnonzero([move.covariance is not None for move in moves])
    assert times[at] == pytest.approx(107.05) and moves[at].durations[0] == pytest.approx(4.1)
    np.testing.assert_allclose(moves[at].values[0], increment(arc(102.95), arc(107.05)), atol=1e-6)


@pytest.mark.parametrize("pause", [3.0, 30.0])
def test_motion_across_a_silence_is_doubted_by_the_way_that_it_may_hide(tmp_path, pause):
    """Oracle: a tenth of the ways of robots that go and turn at any speed up to 0.6 and back; 0.5 m, 20 deg at most."""
    times = [t / 10 + (pause if t > 1030 else 0.0) for t in range(1000, 1101)]
    place = {t: arc(t / 10) for t in range(1000, 1101)}
    messages = []
    for t, time in zip(place, times):
        messages += [odometry(time, place[t]), scan(time, np.full(3, 2.0))]
    log = open_log(write_bag(tmp_path, "bag", still(messages)))
    assert len(reader_notes(log)) == 1
    moves, _ = pairs(log)
    (across,) = [move for move in moves if move.covariance is not None]
    hidden = 0.1 * (pause + 0.1) * np.random.default_rng(1).uniform(-0.6, 0.6, 100_000).std()
    step = across.values[0]
    usual = np.array([0.1 * np.hypot(*step[:2]), np.hypot(np.deg2rad(0.5), 0.1 * step[2])])
    deviations = np.sqrt(np.diag(across.covariance[0]))[[0, 2]]
    expected = np.hypot(usual, np.minimum(hidden, [0.5, np.deg2rad(20.0)]))
    np.testing.assert_allclose(deviations, expected, rtol=0.02)


def test_a_slow_odometry_is_not_silent(tmp_path):
    """One message in 1.5 s is its rate, not a gap."""
    messages = [odometry(100 + 1.5 * k, arc(100 + 1.5 * k)) for k in range(10)]
    messages += [scan(100.1 + k / 5, np.full(3, 2.0)) for k in range(60)]
    log = open_log(write_bag(tmp_path, "bag", still(messages)))
    assert reader_notes(log) == () and all(move.covariance is None for move in pairs(log)[0])


def test_bad_messages_are_named_or_skipped(tmp_path):
    """A scan without ranges, one without a step, an odometry of NaN, one with an empty quaternion."""
    bad = [
        scan(100.1, []),
        scan(100.2, np.ones(3), step=0.0),
        scan(100.2, np.ones(3), start=np.nan),
        odometry(100.25, (np.nan, 0.0, 0.0)),
        odometry(100.26, FLAT, quaternion=(0.0, 0.0, 0.0, 0.0)),
    ]
    messages = drive()
    log = open_log(write_bag(tmp_path, "sqlite3", still([*messages[:5], *bad, *messages[5:]])))
    with pytest.raises(LogError, match="record 3, field ranges: holds no ranges"):
        list(log)
    skipped = []
    _, scans = pairs(log, skipped.append)
    assert len(scans) == 5
    assert [(s.record, s.field) for s in skipped] == [
        (3, "ranges"), (4, "angle_increment"), (5, "angle_increment"), (4, "/odom"), (5, "/odom"),
    ]  # fmt: skip
    with pytest.raises(LogError, match="no message of /odom holds a finite pose"):
        open_log(write_bag(tmp_path, "bag", [*messages[1::2], bad[3]], "b"))
