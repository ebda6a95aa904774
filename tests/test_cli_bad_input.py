"""Bad records: strict runs stop there with one line and keep what came before; tolerant ones pass them over."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.io import savemat

from command import (
    ODOMETRY,
    SIGHTINGS,
    changed,
    kalmap_all_inside,
    kalmap_inside,
    manifest,
    times,
    write_log,
)

TIMED = ["0.1,0.1,1.0,0.0", "0.2,0.1,1.0,0.0", "0.3,0.1,1.0,0.0"]
NOISY = [f"{row},0.01,0.0003,0" for row in SIGHTINGS]
NOISE = "time,range,bearing,id,var_range,var_bearing,cov_range_bearing"


def bad_odometry(text, line=5):
    return {"odometry": changed(ODOMETRY, line, text)}


def bad_sighting(text, line=5):
    return {"sightings": changed(SIGHTINGS, line, text)}


# name -> (log, file, record, field, words of the line, time of the last row that a strict run keeps)
RECORDS = {
    "odometry, column too few": (bad_odometry("0.3,1.0"), "odometry.csv", 5, "steering", "missing", 0.2),
    "odometry, column too many": (bad_odometry("0.3,1,0,9"), "odometry.csv", 5, "column 4", "found 4", 0.2),
    "odometry, word": (bad_odometry("0.3,fast,0"), "odometry.csv", 5, "speed", "'fast'", 0.2),
    "odometry, NaN": (bad_odometry("0.3,nan,0"), "odometry.csv", 5, "speed", "finite", 0.25),
    "odometry, infinity": (bad_odometry("0.3,1.0,-inf"), "odometry.csv", 5, "steering", "finite", 0.25),
    "odometry, NaN time": (bad_odometry("nan,1.0,0"), "odometry.csv", 5, "time", "finite", 0.2),
    "odometry, time back": (bad_odometry("0.15,1.0,0"), "odometry.csv", 5, "time", "goes back", 0.2),
    "sighting, column too few": (bad_sighting("0.25,3.8"), "sightings.csv", 5, "bearing", "missing", 0.15),
    "sighting, blank": (bad_sighting("0.25,,0.3,7"), "sightings.csv", 5, "range", "finite", 0.2),
    "sighting, NaN": (bad_sighting("0.25,3.8,nan,7"), "sightings.csv", 5, "bearing", "finite", 0.2),
    "sighting, infinity": (bad_sighting("0.25,inf,0.3,7"), "sightings.csv", 5, "range", "finite", 0.2),
    "sighting, negative range": (
        bad_sighting("0.25,-3.8,0.3,7"),
        "sightings.csv",
        5,
        "range",
        "0 or more",
        0.2,
    ),
    "sighting, time back": (bad_sighting("0.05,3.8,0.3,7"), "sightings.csv", 5, "time", "goes back", 0.15),
    "sighting, id in words": (bad_sighting("0.25,3.8,0.3,oak"), "sightings.csv", 5, "id", "'oak'", 0.15),
    "sighting, half an id": (bad_sighting("0.25,3.8,0.3,7.5"), "sightings.csv", 5, "id", "whole number", 0.2),
    "sighting, unknown id": (
        bad_sighting("0.25,3.8,0.3,8") | {"landmarks": ["7,4.1,1.3", "9,6.5,-6.5"]},
        *("sightings.csv", 5, "id", "unknown id 8", 0.2),
    ),
    "sighting, covariance": (
        {"sightings": changed(NOISY, 5, "0.25,3.8,0.3,7,0.01,0.0003,1"), "seen": NOISE},
        *("sightings.csv", 5, "covariance", "not positive semi-definite", 0.2),
    ),
    "negative duration": (
        {"odometry": changed(TIMED, 3, "0.2,-0.1,1,0"), "motion": "time,duration,speed,steering"},
        *("odometry.csv", 3, "duration", "0 or more", 0.15),
    ),
}
# These stop the run before its first event.
FIRST = {
    "sighting before odometry": (
        {"odometry": TIMED, "motion": "time,duration,speed,steering"} | bad_sighting("-0.5,4.0,0.3,7", 2),
        *("sightings.csv", 2, "time", "before any odometry", None),
    ),
    "first id in words": (bad_sighting("0.05,4,0.3,oak", 2), "sightings.csv", 2, "id", "'oak'", 0.0),
}
ALL = RECORDS | FIRST


def write(folder, odometry=ODOMETRY, sightings=SIGHTINGS, landmarks=None, **more):
    """A csv log, with a list of its landmarks if there is one."""
    write_log(folder, odometry, sightings, **more)
    if landmarks is not None:
        (folder / "landmarks.csv").write_text("\n".join(["id,x,y", *landmarks]) + "\n")
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Each bad log run strictly: (answers, folder of all)."""
    root = tmp_path_factory.mktemp("bad")
    calls = {}
    for number, (name, (log, *_)) in enumerate(ALL.items()):
        folder = write(root / f"log-{number}", **log)
        calls[name] = ["run", folder, "--no-figures", "--quiet", "--out", root / f"out-{number}"]
    return kalmap_all_inside(calls), root


@pytest.mark.parametrize("name", ALL)
def test_a_strict_run_stops_names_the_place_and_keeps_what_came_before(runs, name):
    """Code 2; one line with file, record and field; a result folder up to the record before, marked as cut short."""
    answers, root = runs
    number = list(ALL).index(name)
    _, file, record, field, words, last = ALL[name]
    answer = answers[name]
    assert answer.code == 2 and answer.out == ""
    place = root / f"log-{number}" / file
    assert f"{place}, record {record}, field {field}: " in answer.error and words in answer.error
    folder = root / f"out-{number}"
    said = manifest(folder)
    assert said["completed"] is False and said["interrupted"] is False
    assert f"record {record}, field {field}: " in said["error"]
    kept = times(folder)
    assert kept == sorted(kept) and (not kept if not last else kept[-1] == pytest.approx(last))
    assert (folder / "map.kalmap").is_file() and (folder / "metrics.json").is_file()


# (row, field that is wrong or None) of one log with everything in it
MIXED_ODOMETRY = [
    *[("0.1,0.1,1.0,0.0", None), ("0.15,0.1,1.0", "steering"), ("0.15,0.1,1,0,9", "column 5")],
    *[("0.2,0.1,1.0,0.0", None), ("0.25,0.1,nan,0", "speed"), ("0.25,0.1,1,inf", "steering")],
    *[("nan,0.1,1.0,0.0", "time"), ("0.3,0.1,1.0,0.0", None), ("0.05,0.1,1,0", "time")],
    *[("0.35,-0.1,1.0,0", "duration"), ("0.4,0.1,1.0,0.0", None), ("0.5,0.1,1.0,0.0", None)],
]
MIXED_SIGHTINGS = [
    *[("-9,4.0,0.3,7,1e-2,1e-4,0", "time"), ("0.1,4.0,0.3,7,1e-2,1e-4,0", None)],
    *[
        ("0.2,3.9", "bearing"),
        ("0.2,-3.9,0.3,7,1e-2,1e-4,0", "range"),
        ("0.2,3.9,nan,7,1e-2,1e-4,0", "bearing"),
    ],
    *[("0.2,3.9,0.3,oak,1e-2,1e-4,0", "id"), ("0.2,3.9,0.3,7.5,1e-2,1e-4,0", "id")],
    *[("0.2,3.9,0.3,8,1e-2,1e-4,0", "id"), ("0.2,3.9,0.3,7,1e-2,1e-4,1", "covariance")],
    *[("0.2,3.9,0.3,7,1e-2,1e-4,0", None), ("0.05,3.8,0.3,7,1e-2,1e-4,0", "time")],
    *[("0.4,3.7,0.3,7,1e-2,1e-4,0", None), ("0.5,inf,0.3,7,1e-2,1e-4,0", "range")],
]


def test_a_tolerant_run_passes_every_bad_record_over_and_lists_it(tmp_path):
    """Code 0, to the end of the log; manifest and report list exactly the bad records, by number and field."""
    log = write(
        tmp_path / "log",
        [row for row, _ in MIXED_ODOMETRY],
        [row for row, _ in MIXED_SIGHTINGS],
        landmarks=["7,4.1,1.3"],
        motion="time,duration,speed,steering",
        seen=NOISE,
    )
    folder = tmp_path / "out"
    answer = kalmap_inside("run", log, "--tolerant", "--out", folder)
    assert (answer.code, answer.err) == (0, "")
    said = manifest(folder)
    rows = [*enumerate(MIXED_ODOMETRY, 2), *enumerate(MIXED_SIGHTINGS, 2)]
    expected = sorted((number, field) for number, (_, field) in rows if field)
    assert sorted((one["record"], one["field"]) for one in said["skipped"]) == expected
    assert said["completed"] is True and said["skipped_total"] == len(expected)
    assert times(folder)[-1] == pytest.approx(0.5)
    assert json.loads((folder / "metrics.json").read_text())["skipped"] == len(expected)
    page = (folder / "report.html").read_text()
    assert f"Bad records skipped: {len(expected)}." in page
    assert all(one["problem"].split("'")[0] in page for one in said["skipped"])


def park(folder, rows=None, **more):
    """A Victoria Park folder of three odometry records and two sightings."""
    folder.mkdir()
    rows = [[1010.0, 5.0, 1.5, 0, 0, 7.0], [1060.0, 5.1, 1.6, 0, 0, 7.0]] if rows is None else rows
    columns = {"time": [1000.0, 1025.0, 1075.0], "speed": [1.0, 2.0, 3.0], "steering": [0.1, 0.1, 0.1]} | more
    savemat(folder / "aa3_dr.mat", {name: np.array(column)[:, None] for name, column in columns.items()})
    savemat(folder / "data_sensor_clean_clean.mat", {"data_sensor_clean_clean": np.array(rows)})
    return folder


def test_matlab_files_that_are_missing_cut_or_wrong(tmp_path):
    """Code 2 and one line that names file and field, for each way in which a .mat can be bad; a good one runs."""
    sightings = "data_sensor_clean_clean.mat"
    logs = {
        "good": park(tmp_path / "good"),
        "missing": park(tmp_path / "missing"),
        "cut": park(tmp_path / "cut"),
        "noise": park(tmp_path / "noise"),
        "column": park(tmp_path / "column", rows=[[1010.0, 5.0, 1.5, 0, 0]]),
        "length": park(tmp_path / "length", speed=[1.0, 2.0]),
        "nan": park(tmp_path / "nan", rows=[[1010.0, 5, 1.5, 0, 0, 7], [1060.0, np.nan, 1.6, 0, 0, 7]]),
    }
    (logs["missing"] / sightings).unlink()
    whole = (logs["cut"] / sightings).read_bytes()
    (logs["cut"] / sightings).write_bytes(whole[: len(whole) // 2])
    (logs["noise"] / sightings).write_bytes(bytes(range(256)) * 4)
    options = ["--no-figures", "--quiet", "--out"]
    answers = kalmap_all_inside(
        {name: ["run", log, *options, tmp_path / f"out-{name}"] for name, log in logs.items()}
    )
    assert answers.pop("good") == (0, "", "")
    for name in ("missing", "cut", "noise", "column", "nan"):
        assert answers[name].code == 2 and f"{logs[name] / sightings}" in answers[name].error
    assert "aa3_dr.mat, field speed: expected 3 values, found 2" in answers["length"].error
    assert "field data_sensor_clean_clean: expected any x 6 numbers, found 1 x 5" in answers["column"].error
    assert "record 2, field range" in answers["nan"].error and times(tmp_path / "out-nan")[-1] > 1.01


def test_a_start_that_is_no_covariance_and_a_header_that_is_none(tmp_path):
    """log.json: an indefinite or crooked start_covariance, an unknown key, a model that does not fit the columns."""
    headers = {
        "indefinite": {"start_covariance": [[1, 0, 0], [0, -1, 0], [0, 0, 1]]},
        "crooked": {"start_covariance": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]},
        "key": {"config": {"motion": {"modell": "ackermann"}}},
        "model": {"config": {"motion": {"model": "unicycle"}}},
    }
    logs = {name: write_log(tmp_path / name, **header) for name, header in headers.items()}
    calls = {name: ["run", log, "--out", tmp_path / "out"] for name, log in logs.items()}
    calls["compared"] = ["compare", logs["indefinite"], "--methods", "ekf,ckf", "--out", tmp_path / "both"]
    answers = kalmap_all_inside(calls)
    assert {answer.code for answer in answers.values()} == {2}
    place = "log.json, field start_covariance: "
    assert place + "is not positive semi-definite" in answers["indefinite"].error
    assert place + "is not positive semi-definite" in answers["compared"].error
    assert place + "expected a symmetric matrix" in answers["crooked"].error
    assert "log.json, field config.motion: " in answers["key"].error and "`modell`" in answers["key"].error
    assert "log.json, field config.motion.model: 'unicycle' does not go" in answers["model"].error
    assert not (tmp_path / "out").exists()
