"""The readers on the real laser logs. Oracle: the figures in the data sets' own description, measured apart."""

from __future__ import annotations

import time

import numpy as np
import pytest

from kalmap.data import check_log, open_log
from laser_files import pairs, transform
from real_data import data_root  # noqa: F401

LOGS = {
    # scans, path m, turned rad, smallest and largest true range m, share without return
    "intel-lab": (13631, 508.4, 342.5, 0.20, 26.37, 0.028),
    "aces": (7374, 325.2, 159.0, 0.31, 49.91, 0.0084),
    "mines-urg04lx": (641, 44.5, 20.98, 0.225, 5.58, 0.578),
    "urg04lx-ros1": (857, 13.1, None, None, None, None),
    "urg04lx-ros2/target_before_2018-05-16_sqlite3": (713, 12.9, None, None, None, None),
}


@pytest.mark.parametrize("name", LOGS)
def test_counts(data_root, name):  # noqa: F811
    scans, path, turned, shortest, longest, blind = LOGS[name]
    laser = check_log(open_log(data_root / name)).laser
    assert laser.scans == scans and laser.path == pytest.approx(path, abs=0.05)
    if turned is not None:
        # the scans of a .dat lie between the readings of the wheels, which cuts off 2.4 % of what they turn to and fro
        assert laser.turned == pytest.approx(turned * (0.976 if name == "mines-urg04lx" else 1.0), abs=0.05)
        assert (laser.shortest, laser.longest) == (shortest, longest)
        assert laser.no_returns == pytest.approx(blind, abs=0.0006)


def test_intel_is_read_in_time_and_in_the_order_of_the_file(data_root):  # noqa: F811
    begin = time.process_time()
    log = open_log(data_root / "intel-lab")
    moves, scans = pairs(log)
    assert time.process_time() - begin < 3.0
    assert (len(moves), len(scans), log.name) == (13631, 13631, "intel")
    stamps = np.array([s.time if np.isnan(s.stamp) else s.stamp for s in scans])
    assert (np.diff(stamps) < 0).sum() == 631 and np.diff(stamps).min() == pytest.approx(-0.90, abs=0.005)
    assert (stamps[0], stamps.max()) == pytest.approx((976052857.338, 976055548.634), abs=0.001)
    steps = np.concatenate([move.values for move in moves])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() == pytest.approx(0.22, abs=0.005)
    assert np.rad2deg(np.abs(steps[:, 2])).max() == pytest.approx(15.8, abs=0.05)
    values = np.concatenate([scan.ranges for scan in scans])
    assert np.median(values[np.isfinite(values)]) == pytest.approx(1.94, abs=0.03)


@pytest.mark.parametrize(("name", "relations", "times", "odometry"), [
    ("intel-lab", 2984, 1791, (7.370, 39.17)), ("aces", 1279, 1218, (0.549, 2.33)),
])  # fmt: skip
def test_relations_meet_the_scans(data_root, name, relations, times, odometry):  # noqa: F811
    """Every time is a scan's stamp, digit for digit; dead reckoning has the errors that the description gives."""
    log = open_log(data_root / name)
    [reference] = log.references
    moves, scans = pairs(log)
    stamps = [s.time if np.isnan(s.stamp) else s.stamp for s in scans]
    asked = set(reference.relations.first.tolist()) | set(reference.relations.second.tolist())
    assert len(reference.relations.first) == relations
    assert len(asked) == times and asked <= set(stamps)
    pose, poses = np.eye(3), {}
    for move, stamp in zip(moves, stamps):
        if len(move.values):
            pose = pose @ transform(move.values[0])
        poses[stamp] = pose
    errors = []
    for first, second, truth in zip(*(getattr(reference.relations, n) for n in ("first", "second", "poses"))):
        off = np.linalg.inv(transform(truth)) @ np.linalg.inv(poses[first]) @ poses[second]
        errors.append([np.hypot(off[0, 2], off[1, 2]), abs(np.rad2deg(np.arctan2(off[1, 0], off[0, 0])))])
    assert np.mean(errors, axis=0) == pytest.approx(odometry, abs=0.006)


@pytest.mark.parametrize(("name", "scans", "path"), [
    ("intel-lab/intel.gfs.log", 910, 499.5), ("aces/aces.gfs.log", 440, 323.2),
])  # fmt: skip
def test_corrected_logs(data_root, name, scans, path):  # noqa: F811
    report = check_log(open_log(data_root / name))
    assert report.laser.scans == scans and report.laser.path == pytest.approx(path, abs=0.06)


def test_the_jump_of_aces_is_noted(data_root):  # noqa: F811
    report = check_log(open_log(data_root / "aces"))
    [jump] = [finding for finding in report.findings if "jumps" in finding.what]
    assert jump.severity == "note" and jump.count == 1 and "0.381 m, 60.6 deg" in jump.first[0]


def test_mines_ends_where_dead_reckoning_says(data_root):  # noqa: F811
    pose = np.eye(3)
    moves, scans = pairs(open_log(data_root / "mines-urg04lx"))
    for move in moves[1:]:
        pose = pose @ transform(move.values[0])
    assert (pose[0, 2], pose[1, 2]) == pytest.approx((-7.61, 1.71), abs=0.01)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(1.38, abs=0.005)
    valid = [np.isfinite(scan.ranges).sum() for scan in scans]
    assert np.mean(valid) == pytest.approx(288, abs=0.5)
    seen = np.flatnonzero(np.isfinite([scan.ranges for scan in scans]).any(axis=0))
    assert (seen[0], seen[-1]) == (53, 671)


def test_sqlite_and_mcap_are_one(data_root):  # noqa: F811
    folder = data_root / "urg04lx-ros2"
    found = [pairs(open_log(folder / f"target_before_2018-05-16_{kind}")) for kind in ("sqlite3", "mcap")]
    for a, b in zip(*(moves for moves, _ in found)):
        assert (a.time, a.values.tolist(), a.durations.tolist()) == (
            b.time,
            b.values.tolist(),
            b.durations.tolist(),
        )
    for a, b in zip(*(scans for _, scans in found)):
        assert a.time == b.time and a.ranges.tolist() == b.ranges.tolist()


@pytest.mark.parametrize(("name", "valid"), [
    ("urg04lx-ros1", 537), ("urg04lx-ros2/target_before_2018-05-16_mcap", 586),
])  # fmt: skip
def test_the_bags_of_2018(data_root, name, valid):  # noqa: F811
    """The fan is not symmetric; beams 0 to 43 never hold a range; the transform odom -> base_link is the odometry."""
    log = open_log(data_root / name)
    moves, scans = pairs(log)
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings[[0, 384, 725]]), [-135, 0, 119.9], atol=0.03)
    ranges = np.array([scan.ranges for scan in scans])
    assert not np.isfinite(ranges[:, :44]).any()
    assert np.isfinite(ranges).sum(axis=1).mean() == pytest.approx(valid, abs=1)
    assert np.diff([scan.time for scan in scans]).mean() == pytest.approx(0.1008, abs=0.0005)
    other = pairs(open_log(data_root / name, odometry_topic="/tf"))[0]
    both = [np.concatenate([m.values for m in each]) for each in (moves, other)]
    np.testing.assert_allclose(both[0], both[1], atol=5e-3)
