"""The command on raw laser logs: what `kalmap check` says, its exit codes, topics, and errors of one line."""

from __future__ import annotations

import json

import pytest

from command import kalmap_all_inside
from laser_files import drive, flaser, jumped, scan, still, write, write_bag

ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("laser")
    rear = [scan(100.01 + k / 20, [7.0, 8.0], topic="/rear") for k in range(8)]
    two = write_bag(folder, "mcap", still([*drive(), *rear]), "two")
    jumps = write_bag(folder, "bag", still(jumped(-40.0)), "jumps")
    blind = write_bag(folder, "sqlite3", drive()[::2], "blind")
    lost = write_bag(folder, "bag", drive()[1::2], "lost")
    carmen = write(folder / "hall.log", [flaser([1.0, 2.0], ZERO, t) for t in (1.0, 0.5, 2.0)])
    cut = write(folder / "cut.log", [flaser([1.0, 2.0], ZERO, 1.0), "FLASER 2 1.0"], end="")
    rubbish = folder / "rubbish.log"
    rubbish.write_bytes(bytes(range(256)))
    return kalmap_all_inside({
        "carmen": ["check", carmen],
        "json": ["check", carmen, "--json"],
        "cut": ["check", cut],
        "two": ["check", two],
        "rear": ["check", two, "--scan-topic", "/rear", "--odometry-topic", "odom"],
        "no topic": ["check", two, "--scan-topic", "/left"],
        "jumps": ["check", jumps],
        "blind": ["run", blind, "--out", folder / "out"],
        "lost": ["run", lost, "--out", folder / "out"],
        "rubbish": ["check", rubbish],
        "a world": ["check", "course-35", "--scan-topic", "/scan"],
        "no bag": ["check", carmen, "--odometry-topic", "/odom"],
        "nothing": ["check", folder],
    })  # fmt: skip


def test_good_logs(answers):
    carmen = answers["carmen"]
    assert carmen.code == 0 and carmen.err == ""
    assert "laser: SICK-like, 2 beams over 90 deg, ranges 1 m to 2 m, 0 % without return" in carmen.out
    assert "stamps put right: 1, largest step back 0.5 s" in carmen.out
    assert json.loads(answers["json"].out)["laser"]["put_right"] == 1
    assert answers["two"].code == 0
    assert "several topics of laser scans: /scan (5) is read, not /rear (8)" in answers["two"].out
    assert answers["rear"].code == 0
    assert "2 beams" in answers["rear"].out and "several topics" not in answers["rear"].out


def test_problems(answers):
    assert answers["cut"].code == answers["jumps"].code == 1
    assert "record 2: is cut short" in answers["cut"].out
    assert "problem: scans: the clock jumps" in answers["jumps"].out


@pytest.mark.parametrize(("name", "says"), [
    ("no topic", "no topic /left; it holds /odom (nav_msgs/msg/Odometry, 6), /rear"),
    ("blind", "no laser scans (sensor_msgs/msg/LaserScan); it holds /odom (nav_msgs/msg/Odometry, 6)"),
    ("lost", "no odometry, neither nav_msgs/msg/Odometry nor transforms; it holds /scan"),
    ("rubbish", "rubbish.log: no line of a CARMEN log"),
    ("a world", "course-35 is a world"),
    ("no bag", "a topic was asked for, but CARMEN logs have none"),
    ("nothing", "holds several laser logs, name one of them"),
])  # fmt: skip
def test_errors_of_one_line(answers, name, says):
    assert answers[name].code == 2 and answers[name].out == ""
    assert says in answers[name].error
