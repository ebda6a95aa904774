"""Beams that see the robot's own cover, in logs of a simulated office written out as CARMEN lines."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.data import check_log, open_log, reader_notes
from kalmap.geometry.se2 import compose
from kalmap.records import Odometry, Scan
from kalmap.simulate import simulate, with_bad_ranges, with_cover, world_by_name
from laser_files import flaser, pairs, write

LINES = 600
"""30 m and several turns of the office."""
FIRST, LAST = 70.0, 85.0


@pytest.fixture(scope="module")
def office():
    return simulate(world_by_name("office"), 1)


def written(path, log, odometry=lambda pose: pose, lines=LINES):
    """The first scans of a log as FLASER lines; odometry: what becomes of the poses (x, y, heading)."""
    pose, found = np.zeros(3), []
    for event in log:
        if isinstance(event, Odometry):
            for values in event.values:
                pose = compose(pose, values)
        elif isinstance(event, Scan):
            ranges = np.where(np.isfinite(event.ranges), event.ranges, 81.83)
            found.append(flaser(ranges, odometry(pose), event.time))
        if len(found) == lines:
            break
    return write(path, found)


def beams(log):
    """How many beams lie where the cover is put."""
    angles = np.rad2deg(next(event for event in log if isinstance(event, Scan)).bearings)
    return (angles >= FIRST) & (angles <= LAST)


@pytest.mark.parametrize("distance", [0.12, 0.6])
@pytest.mark.parametrize("bad", [0.0, 0.15])
def test_a_cover_is_told_and_its_beams_are_left_out(tmp_path, office, distance, bad):
    """Oracle: the beams that were covered; of the others every range stays as it was."""
    disturbed = with_cover(office, FIRST, LAST, distance, 3)
    disturbed = with_bad_ranges(disturbed, bad, 4) if bad else disturbed
    path = written(tmp_path / "office.log", disturbed)
    log = open_log(path)
    mask = beams(office)
    (note,) = reader_notes(log)
    assert note.startswith(f"{path}: {mask.sum()} of 180 beams") and "are left out" in note
    assert f"{distance:.2f}" in note
    assert any(note == finding.what for finding in check_log(log).findings)
    assert check_log(log).laser.beams == (180, 180)
    _, scans = pairs(log)
    kept = [event for event in disturbed if isinstance(event, Scan)]
    for scan, whole in zip(scans, kept, strict=False):
        assert len(scan.ranges) == len(scan.bearings) == 180 - mask.sum()
        there = np.where(np.isfinite(whole.ranges) & (whole.ranges > 0), whole.ranges, np.inf)[~mask]
        np.testing.assert_array_equal(scan.ranges, there)
        np.testing.assert_allclose(scan.bearings, whole.bearings[~mask], atol=1e-9)


def test_what_is_near_but_changes_is_no_cover(tmp_path, office):
    """The log as it is, and one whose near beams stray by 6 cm, as a wall beside a robot does."""
    assert reader_notes(open_log(written(tmp_path / "office.log", office))) == ()
    rng, lines = np.random.default_rng(2), []
    for line in (
        written(tmp_path / "cover.log", with_cover(office, FIRST, LAST, 0.5, 3)).read_text().splitlines()
    ):
        words = line.split()
        near = np.array(words[2:182], dtype=float)
        near[beams(office)] += 0.06 * rng.standard_normal()
        lines.append(" ".join([*words[:2], *map(repr, near.tolist()), *words[182:]]))
    assert reader_notes(open_log(write(tmp_path / "wall.log", lines))) == ()


def test_a_robot_that_stands_or_goes_a_few_steps_says_nothing(tmp_path, office):
    covered = with_cover(office, FIRST, LAST, 0.3, 3)
    for name, lines, odometry in (
        ("short", 20, lambda pose: pose),
        ("still", LINES, lambda pose: 0.0 * pose),
    ):
        assert reader_notes(open_log(written(tmp_path / f"{name}.log", covered, odometry, lines))) == ()


def test_wheels_that_spin_are_no_cover(tmp_path):
    """All beams stay, near and far, while the odometry goes on and turns: the robot is stuck."""
    ranges = np.linspace(0.4, 8.0, 180)
    lines = [flaser(ranges, (k / 10, 0.0, np.sin(k / 20)), 1.0 + k / 5) for k in range(200)]
    assert reader_notes(open_log(write(tmp_path / "stuck.log", lines))) == ()


def test_a_straight_way_is_told_and_nothing_is_left_out(tmp_path):
    """What stays beside a robot that never turned may be a wall."""
    rng = np.random.default_rng(5)
    ranges = rng.uniform(2.0, 9.0, (200, 180))
    ranges[:, :10] = 0.4 + 0.005 * rng.standard_normal((200, 10))
    lines = [flaser(each, (k / 10, 0.0, 0.0), 1.0 + k / 5) for k, each in enumerate(ranges)]
    log = open_log(write(tmp_path / "straight.log", lines))
    (note,) = reader_notes(log)
    assert "10 of 180 beams (at -90 to -81 deg)" in note and note.endswith("they are used")
    assert all(len(scan.ranges) == 180 for scan in pairs(log)[1])


def test_a_scanner_all_of_whose_beams_are_covered_has_none_left(tmp_path):
    rng = np.random.default_rng(5)
    ranges = 0.2 + 0.005 * rng.standard_normal((200, 180))
    lines = [flaser(each, (k / 10, 0.0, np.sin(k / 20)), 1.0 + k / 5) for k, each in enumerate(ranges)]
    log = open_log(write(tmp_path / "blind.log", lines))
    assert "180 of 180 beams" in reader_notes(log)[0]
    assert all(len(scan.ranges) == 0 for scan in pairs(log)[1])
