"""Odd logs, Ctrl-C, and the verbs beside `run`: compare, check, reproduce."""

from __future__ import annotations

import json
import lzma
import signal
import time

import pytest

from command import (
    ODOMETRY,
    SIGHTINGS,
    kalmap_all_inside,
    kalmap_inside,
    manifest,
    start,
    times,
    write_log,
)
from kalmap.data.native_map import read_map_file

SHORT = ["--set", "world.laps=1"]
TIMED = "time,duration,speed,steering"
MOVED = "time,dx,dy,dtheta"

KEPT = ["--set", "association.management=keep"]

# name -> (log, options, exit code, words of the error, landmarks in the map)
LOGS = {
    "odometry only": ({"sightings": None}, [], 0, "", 0),
    "one odometry record": ({"odometry": ["0,1,0"], "sightings": None}, [], 0, "", 0),
    "no records": ({"odometry": [], "sightings": []}, [], 2, "odometry.csv: no odometry record", 0),
    "sightings only": ({"odometry": []}, [], 2, "before any odometry", 0),
    "no time passes": (
        {
            "odometry": ["0.1,0,1,0", "0.2,0,1,0"],
            "sightings": ["0.1,4,0.3,7", "0.2,4,0.3,7"],
            "motion": TIMED,
        },
        *([], 0, "", 1),
    ),
    "seen at the very start": ({"sightings": ["0,4,0.3,7", "0.15,4,0.3,7"]}, [], 0, "", 1),
    "seen before the start": (
        {"sightings": ["-1,4,0.3,7", "0.15,4,0.3,7"]},
        *([], 2, "sightings.csv, record 2, field time: a sighting before any odometry", 0),
    ),
    "skipped before the start": ({"sightings": ["-1,4,0.3,7", "0.15,4,0.3,7"]}, ["--tolerant"], 0, "", 1),
    "beyond all numbers": ({"odometry": ["0,1e300,0", "0.1,1e300,0.5", "0.2,1,0"]}, [], 2, "finite", 0),
    "absurd noise": ({}, ["--set", "motion.sigma_speed=1e200"], 2, "", 0),
    "a sighting out of this world": ({"sightings": ["0.05,1e200,0.3,7"]}, [], 2, "finite", 0),
    "increments": (
        {
            "odometry": ["0.1,0.1,0,0", "0.2,0.1,0,0.01"],
            "sightings": ["0.1,4,0.3,7", "0.2,3.9,0.3,7"],
            "motion": MOVED,
        },
        *([], 0, "", 1),
    ),
    "twice in a frame": ({"sightings": ["0.05,4,0.3,7", "0.05,4.01,0.3,7", "0.15,4,0.3,7"]}, [], 0, "", 1),
    "twice, likelihood": (
        {"sightings": ["0.05,4,0.3,7", "0.05,9,0.3,7", "0.15,4,0.3,7"]},
        *(["--association", "likelihood"], 0, "", 0),  # three sightings at most: not likely enough yet
    ),
    "twice, likelihood, all kept": (
        {"sightings": ["0.05,4,0.3,7", "0.05,9,0.3,7", "0.15,4,0.3,7"]},
        *(["--association", "likelihood", *KEPT], 0, "", 2),
    ),
    "empty frames": ({"sightings": ["0.05,,,", "0.15,4,0.3,7", "0.25,,,"]}, [], 0, "", 1),
    "no ids": ({"sightings": ["0.05,4,0.3"], "seen": "time,range,bearing"}, [], 0, "", 0),
    "no ids, all kept": ({"sightings": ["0.05,4,0.3"], "seen": "time,range,bearing"}, KEPT, 0, "", 1),
    "no ids, known": (
        {"sightings": ["0.05,4,0.3"], "seen": "time,range,bearing"},
        *(
            ["--association", "known"],
            2,
            "sightings.csv, record 2, field ids: t = 0.05 s: the log gives no identities",
            0,
        ),
    ),
    "blank ids": ({"sightings": ["0.05,4,0.3,", "0.15,4,0.3,-1"]}, [], 0, "", 0),
    "an odd name": ({"name": "../../a\nb/ c"}, [], 0, "", 2),
    "steered too far": ({"odometry": ["0,1,1.5707963267948966", *ODOMETRY[1:]]}, [], 0, "", 2),
}


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """All odd logs, run: (answers, folder of all)."""
    root = tmp_path_factory.mktemp("odd")
    calls = {}
    for number, (name, (log, options, *_)) in enumerate(LOGS.items()):
        folder = write_log(root / f"log-{number}", **log)
        calls[name] = ["run", folder, *options, "--no-figures", "--quiet", "--out", root / f"out-{number}"]
    return kalmap_all_inside(calls), root


@pytest.mark.parametrize("name", LOGS)
def test_an_odd_log_runs_or_is_refused_with_one_line(odd, name):
    """The exit code, the line, the manifest's verdict, and how many landmarks the saved map holds."""
    answers, root = odd
    _, _, code, words, landmarks = LOGS[name]
    folder = root / f"out-{list(LOGS).index(name)}"
    assert answers[name].code == code and answers[name].out == ""
    assert words in answers[name].error if code else answers[name].err == ""
    assert manifest(folder)["completed"] is (code == 0)
    times(folder)
    assert len(read_map_file(folder / "map.kalmap").landmark_ids) == landmarks


def test_huge_values_end_in_one_line_and_a_finite_folder(tmp_path):
    """Numbers whose squares overflow: code 2, what came before is written and finite."""
    logs = {
        "speed": write_log(tmp_path / "speed", [*ODOMETRY[:2], "0.2,1e160,0.02", *ODOMETRY[3:]]),
        "range": write_log(tmp_path / "range", sightings=[*SIGHTINGS[:2], "0.15,1e300,0.31,7"]),
    }
    answers = kalmap_all_inside(
        {
            name: ["run", log, "--no-figures", "--quiet", "--out", tmp_path / f"o-{name}"]
            for name, log in logs.items()
        }
    )
    for name, answer in answers.items():
        assert answer.code == 2 and "finite" in answer.error
        assert times(tmp_path / f"o-{name}")[0] == 0.05
        assert manifest(tmp_path / f"o-{name}")["completed"] is False


def test_line_ends_and_byte_order_marks_change_nothing(tmp_path):
    """A log with CRLF and a mark in front gives the trajectory of the plain one, byte for byte."""
    plain, marked = write_log(tmp_path / "plain"), write_log(tmp_path / "marked")
    for path in marked.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    calls = {
        log.name: ["run", log, "--no-figures", "-q", "--out", tmp_path / f"o-{log.name}"]
        for log in (plain, marked)
    }
    assert set(kalmap_all_inside(calls).values()) == {(0, "", "")}
    read = [(tmp_path / f"o-{log.name}" / "trajectory.csv").read_bytes() for log in (plain, marked)]
    assert read[0] == read[1]


def robots(folder, count):
    """A MRCLAM folder of that many robots, two odometry records and two sightings each."""
    folder.mkdir()
    (folder / "Barcodes.dat").write_text("1 5\n6 63\n")
    for robot in range(1, count + 1):
        odometry = "# time speed turn rate\n100.0 0.1 0.0\n100.5 0.1 0.0\n101.5 0.0 0.0\n"
        (folder / f"Robot{robot}_Odometry.dat.xz").write_bytes(lzma.compress(odometry.encode()))
        (folder / f"Robot{robot}_Measurement.dat").write_text("100.9 63 2.0 0.1\n101.3 63 2.0 0.1\n")
    return folder


def test_all_robots_get_a_folder_each(tmp_path):
    """--robot all: one result a robot; --robot 9 names those that there are."""
    log = robots(tmp_path / "log", 2)
    line = ["run", log, "--no-figures", "--quiet", "--out", tmp_path / "out", "--robot"]
    answers = kalmap_all_inside({"all": [*line, "all"], "nine": [*line, "9"]})
    assert answers["all"] == (0, "", "")
    assert [manifest(tmp_path / "out" / f"robot-{k}")["log"][-7:] for k in (1, 2)] == ["robot-1", "robot-2"]
    assert (
        answers["nine"].code == 2
        and "no odometry of robot 9; robots in this folder: 1, 2" in answers["nine"].error
    )


@pytest.mark.parametrize("words", [["run"], ["compare", "--methods", "ekf,cdkf,ckf"]])
def test_ctrl_c_writes_what_there_is(tmp_path, words):
    """A long run, stopped once it is under way: code 130, one line, a finite result marked as interrupted."""
    folder = tmp_path / "out"
    more = ["--no-figures", "--filter", "cdkf"] if words == ["run"] else []
    process = start(words[0], "course-1000", *words[1:], *more, "--quiet", "--out", folder)
    until = time.monotonic() + 60
    while not folder.is_dir() and time.monotonic() < until:
        time.sleep(0.05)
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=100)
    assert (process.returncode, out) == (130, "")
    assert err == "kalmap: interrupted; what was computed before is written\n"
    results = (
        [folder]
        if words == ["run"]
        else [path for path in folder.iterdir() if (path / "map.kalmap").exists()]
    )
    assert manifest(results[-1])["interrupted"] is True or len(results) > 1
    for result in results:
        kept, saved = times(result), read_map_file(result / "map.kalmap")
        assert kept == sorted(kept) and saved.time == pytest.approx(kept[-1])
        metrics = json.loads((result / "metrics.json").read_text())
        assert metrics["landmarks"] == len(saved.landmark_ids)


def test_compare_runs_each_method_on_the_same_log(tmp_path):
    """A folder a method, one page, a table on the output; a bad record is one line and code 2."""
    bad = write_log(tmp_path / "bad", sightings=[*SIGHTINGS[:3], "0.25,-1,0.3,7"])
    methods = ["compare", "--methods", "ekf:additive,cr-cdkf"]
    answers = kalmap_all_inside(
        {
            "good": [*methods, "course-35", *SHORT, "--out", tmp_path / "out"],
            "bad": [*methods, bad, "--quiet", "--out", tmp_path / "cut"],
        }
    )
    assert (answers["good"].code, answers["good"].err) == (0, "")
    assert [line.split()[0] for line in answers["good"].out.splitlines()[:3]] == [
        "method",
        "ekf:additive",
        "cr-cdkf",
    ]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert list(metrics) == ["ekf:additive", "cr-cdkf"] and metrics["cr-cdkf"]["landmarks"] >= 30
    assert manifest(tmp_path / "out" / "ekf-additive")["config"]["filter"]["coordinates"] == "additive"
    assert (tmp_path / "out" / "report.html").is_file()
    assert answers["bad"].code == 2 and answers["bad"].out == ""
    assert "ekf:additive, cr-cdkf: " in answers["bad"].error
    assert "sightings.csv, record 5, field range" in answers["bad"].error
    assert manifest(tmp_path / "cut" / "cr-cdkf")["completed"] is False and times(
        tmp_path / "cut" / "cr-cdkf"
    )


def test_compare_over_seeds_is_paired(tmp_path):
    """--runs 2: a row a method and seed in runs.csv, a paired test on the output, and the same again when repeated."""
    line = ["compare", "course-35", *SHORT, "--methods", "ekf,cr-cdkf", "--runs", 2, "--workers", 1, "--out"]

    def errors():  # world, method, seed and the errors, without the times that a run took
        return [row.split(",")[:7] for row in (tmp_path / "out" / "runs.csv").read_text().splitlines()]

    answer = kalmap_inside(*line, tmp_path / "out")
    assert (answer.code, answer.err) == (0, "") and "position_rmse_m" in answer.out and " p = " in answer.out
    first = errors()
    assert [row[1:3] for row in first[1:]] == [[name, seed] for name in ("ekf", "cr-cdkf") for seed in "12"]
    assert kalmap_inside(*line, tmp_path / "out", "--quiet") == (0, "", "")
    assert errors() == first


def test_check_tells_good_from_bad_and_unreadable(tmp_path):
    """Code 0 for a good log and a world, 1 with the record for a bad one, 2 for one that cannot be read."""
    good = write_log(tmp_path / "good")
    bad = write_log(tmp_path / "bad", sightings=[*SIGHTINGS[:3], "0.25,-1,0.3,7"])
    torn = write_log(tmp_path / "torn")
    (torn / "sightings.csv").write_text("time,range\n0.1,4\n")
    answers = kalmap_all_inside(
        {
            "good": ["check", good],
            "world": ["check", "course-35"],
            "bad": ["check", bad],
            "json": ["check", bad, "--json"],
            "torn": ["check", torn],
        }
    )
    assert [answers[name].code for name in answers] == [0, 0, 1, 1, 2]
    assert all(answer.err == "" for answer in answers.values())
    assert "6 records" in answers["good"].out and "no problems" in answers["good"].out
    assert "record 5" in answers["bad"].out
    assert json.loads(answers["json"].out)["verdict"] == "problems"
    assert "sightings.csv" in answers["torn"].out and "bearing" in answers["torn"].out
