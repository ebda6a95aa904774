"""The check of a log's raw records."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest

from kalmap.data import check_log, format_report, open_log
from kalmap.records import Fix, Log, MotionConfig, Odometry, Reference, RunConfig, Scan, Sightings


def opened(folder, odometry, sightings="time,range,bearing,id\n"):
    (folder / "odometry.csv").write_text("time,speed,steering\n" + odometry)
    (folder / "sightings.csv").write_text(sightings)
    return open_log(folder)


def found(report):
    return {finding.what: (finding.severity, finding.count) for finding in report.findings}


STEADY = "".join(f"{k / 10:g},1,0\n" for k in range(20))


def test_a_good_log(tmp_path):
    (tmp_path / "landmarks.csv").write_text("id,x,y\n1,0,0\n")
    report = check_log(opened(tmp_path, STEADY, "time,range,bearing,id\n0.5,1,0,1\n0.6,1,0,1\n"))
    assert report.verdict == "good" and report.findings == ()
    odometry, sightings = report.streams
    assert (odometry.records, odometry.begin, odometry.end) == (20, 0.0, 1.9)
    assert odometry.period == pytest.approx(0.1) and sightings.instants == 2
    assert report.sightings.landmarks == 1 and report.references[0].landmarks == 1
    assert "nothing to report" in report.text() and report.text() == format_report(report)


@pytest.mark.parametrize(("rows", "what", "severity"), [
    ("2,60,0\n", "speed beyond 50 m/s", "problem"),
    ("2,1,1.6\n", "steering beyond a right angle", "problem"),
    ("2000,1,0\n", "the clock jumps", "problem"),
    ("4,1,0\n", "gap of more than 5 periods (0.5 s)", "note"),
    ("1.9,1,0\n", "repeated time stamp", "note"),
    ("1.5,1,0\n", "time: goes back", "problem"),
    ("2,nan,0\n", "speed: not finite", "problem"),
    ("2,1,-inf\n", "steering: not finite", "problem"),
    ("2,1\n", "steering: is missing", "problem"),
    ("2,1,a\n", "steering: not a number", "problem"),
])  # fmt: skip
def test_odometry_findings(tmp_path, rows, what, severity):
    report = check_log(opened(tmp_path, STEADY + rows))
    assert found(report)[what] == (severity, 1)
    finding = next(finding for finding in report.findings if finding.what == what)
    assert finding.stream == "odometry" and "record 2" in finding.first[0]


@pytest.mark.parametrize(("row", "what", "severity"), [
    ("0.5,31,0,1\n", "range beyond the sensor's 30 m", "note"),
    ("0.5,1,1.8,1\n", "bearing outside the field of view of 180 deg", "note"),
    ("0.5,1,0,-1\n", "sighting without identity (id -1)", "note"),
    ("0.3,1,0,1\n", "identity twice in one frame", "note"),
    ("9,1,0,1\n", "outside the span of the odometry, left out", "note"),
    ("0.5,-1,0,1\n", "range: negative", "problem"),
    ("0.5,1,0,7\n", "id: unknown id", "problem"),
    ("0.1,1,0,1\n", "time: goes back", "problem"),
])  # fmt: skip
def test_sighting_findings(tmp_path, row, what, severity):
    (tmp_path / "landmarks.csv").write_text("id,x,y\n1,0,0\n")
    text = "time,range,bearing,id\n0.2,1,0,1\n0.3,1,0,1\n" + row
    assert found(check_log(opened(tmp_path, STEADY, text)))[what] == (severity, 1)


def test_a_report_is_json(tmp_path):
    report = check_log(opened(tmp_path, STEADY + "2,nan,0\n" * 5))
    assert json.loads(msgspec.json.encode(report))["verdict"] == "problems"
    assert report.findings[0].count == 5 and len(report.findings[0].first) == 3
    assert "(5)" in report.text()


@pytest.mark.parametrize("odometry", ["", "x\n", "nan,nan,nan\n", "\x00,1,1\n", "1,1,1\n"])
def test_it_never_raises_on_rubbish(tmp_path, odometry):
    report = check_log(opened(tmp_path, odometry))
    assert report.text()


def test_unreadable_files_are_a_problem(tmp_path):
    log = opened(tmp_path, STEADY)
    (tmp_path / "odometry.csv").unlink()
    report = check_log(log)
    assert report.verdict == "problems" and "odometry.csv" in report.findings[0].first[0]


def test_a_log_without_raw_streams_is_judged_by_its_events():
    events = [
        Odometry(1.0, np.array([[1.0, 0.0], [99.0, 0.0]]), np.array([0.5, 0.5])),
        Sightings(1.0, np.array([[2.0, 0.1]]), np.array([4])),
        Sightings(1.0, np.zeros((0, 2))),
        Scan(1.0, np.array([1.0, np.nan]), np.zeros(2)),
        Scan(1.1, np.array([1.0]), np.zeros(1)),
        Fix(1.2, 0.0, 0.0),
        Odometry(1.5, np.array([[1.0, 0.0]]), np.array([0.5])),
    ]
    log = Log(
        "n", "s", RunConfig(motion=MotionConfig(model="ackermann")), lambda skip: iter(events), (Reference(),)
    )
    report = check_log(log)
    assert found(report)["speed beyond 50 m/s"] == ("problem", 1)
    assert found(report)["range: not finite"] == ("problem", 1)
    assert [stream.records for stream in report.streams] == [3, 2, 2, 1]
