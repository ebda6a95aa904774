"""`kalmap why`: what it prints about frames, landmarks and a whole run, and what it refuses."""

from __future__ import annotations

import json
import re

import msgspec
import numpy as np
import pytest

from command import kalmap_all_inside, kalmap_inside
from kalmap.data import write_audit
from kalmap.data.audit import AUDIT
from kalmap.records import Managed, Reason
from trails import cluster, contest, decide, drive, easy, nothing, scattered


def long_life():
    """Landmark 50 over sixty frames, in three of which it is nearly not matched, and twice passed over."""
    frames = []
    for k in range(60):
        near = {10: 0.9, 25: 0.88, 40: 0.86}.get(k, 0.01 * (k % 3))
        points = [[10.0 + near, 0.0]] + [[10.2 + near, 0.1]] * (k in (25, 30))
        managed = (Managed(50, "confirmed", "information counter 2"),) if k == 1 else ()
        known = scattered(range(50, 51), [[10.0, 0.0]], 0.3)
        frames.append(decide(1000 + k, known, np.array(points), managed=managed))
    return frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A result folder that holds nothing but the trail: that is all the command needs."""
    folder = tmp_path_factory.mktemp("result")
    last = [
        msgspec.structs.replace(make(), number=400 + k)
        for k, make in enumerate((easy, contest, nothing, cluster))
    ]
    write_audit(folder / AUDIT, [*drive(40), *last, *long_life()], {"log": "park"})
    return folder


@pytest.fixture(scope="module")
def answers(folder, tmp_path_factory):
    """All command lines, in this process."""
    pictures = tmp_path_factory.mktemp("pictures")
    calls = {
        "summary": [],
        "summary json": ["--json"],
        "frame": ["--frame", 401],
        "frame json": ["--frame", 401, "--json"],
        "empty": ["--frame", 402],
        "time": ["--time", 162],
        "young": ["--landmark", 100],
        "long": ["--landmark", 50],
        "all": ["--landmark", 50, "--all"],
        "long json": ["--landmark", 50, "--json"],
        "drawn": ["--frame", 401, "--figure", pictures / "frame.png"],
        "drawn landmark": ["--landmark", 50, "--json", "--figure", pictures / "landmark.png"],
        "no frame": ["--frame", 77],
        "no landmark": ["--landmark", 45],
        "negative": ["--landmark", -2],
        "huge": ["--landmark", 10**30],
        "no time": ["--time", "nan"],
        "two": ["--frame", 1, "--landmark", 2],
        "all of nothing": ["--frame", 1, "--all"],
        "no picture": ["--frame", 401, "--figure", pictures / "frame.pdf"],
        "no place": ["--frame", 401, "--figure", pictures / "none" / "frame.png"],
        "words": ["--frame", "first"],
    }
    calls = {name: ["why", folder, *words] for name, words in calls.items()}
    calls |= {"file": ["why", folder / AUDIT, "--frame", 401], "missing": ["why", folder / "none"]}
    calls |= {"above": ["why", folder.parent], "not one": ["why", __file__], "nothing named": ["why"]}
    return kalmap_all_inside(calls) | {"pictures": pictures}


def rows(text: str, first: str) -> list[list[str]]:
    """The lines of the table whose head begins with a word, cut where two blanks are."""
    lines = text.splitlines()
    begin = next(k for k, line in enumerate(lines) if re.match(rf"  +{first}  ", line))
    table = [re.split(r"  +", line.strip()) for line in lines[begin + 1 :]]
    return table[: next((k for k, row in enumerate(table) if row == [""] or len(row) < 2), len(table))]


def test_a_frame_is_told_sighting_by_sighting(answers):
    """Oracle: the frame that was written."""
    answer = answers["frame"]
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.startswith(
        "frame 401 (one of 104), t = 162.4 s, robot expected at (0, 0) m, heading 0 deg\n"
    )
    assert "a pair is possible below d^2 = 9.21; a new landmark beyond 25\n" in answer.out
    assert "note: case 2: offset 0.12 m, 0.3 deg from 2 pairs\n" in answer.out
    assert "\nlandmark 4 confirmed: 3 sightings in 4 frames\n" in answer.out
    assert answer.out.endswith("decided in doubt: 1 contest, 1 close rival\n")
    table = rows(answer.out, "sighting")
    frame = contest()
    assert [row[0] for row in table] == [str(m) for m in range(6)]
    assert [float(row[1]) for row in table] == pytest.approx(frame.values[:, 0].round(2))
    assert [row[3] for row in table] == ["17", "unused", "18", "20", "21", "100 new, on trial"]
    assert [row[4] for row in table] == ["0.27", "-", "4.18", "8.71", "0.46", "-"]
    assert table[1][5:] == ["17 (5.36)", "landmark 17 went to sighting 0: left unused"]
    assert table[2][5] == "19 (5.63)" and table[2][6].endswith("[a close rival]")
    assert max(map(len, answer.out.splitlines())) < 130


def test_folder_file_and_time_lead_to_the_same_frame(answers):
    assert answers["file"] == answers["time"] == answers["frame"]


def test_an_empty_frame_says_so(answers):
    assert (answers["empty"].code, answers["empty"].out.splitlines()[-1]) == (0, "nothing was seen")


def test_json_holds_the_same_frame(answers):
    """Oracle: the frame that was written, number by number."""
    frame, told = contest(), json.loads(answers["frame json"].out)
    assert (told["frame"], told["gate"], told["notes"]) == (401, 9.21, list(frame.why.notes))
    assert told["sensor"] == frame.sensor.tolist()
    for m, one in enumerate(told["sightings"]):
        assert [one["range"], one["bearing"]] == frame.values[m].tolist()
        assert one["landmark"] == (int(frame.labels[m]) if frame.labels[m] >= 0 else None)
        assert one["reason"] == Reason(frame.why.reasons[m]).name and one["on_trial"] == bool(frame.trial[m])
        own = frame.why.pairs[:, 0] == m
        assert sorted(c["squared"] for c in one["candidates"]) == sorted(frame.why.squared[own].tolist())
    assert [one["landmark"] for one in told["expected"]] == frame.landmarks.tolist()
    assert told["managed"] == [
        {"landmark": 4, "action": "confirmed", "why": "3 sightings in 4 frames", "into": -1}
    ]


def test_the_story_of_a_short_life_is_told_whole(answers):
    """Landmark 100 was founded twice over, in frames of two made-up runs."""
    lines = answers["young"].out.splitlines()
    assert lines[0] == "landmark 100: still on trial at the end; 2 sightings, frames 400 to 401"
    assert lines[2] == "frame 400: founded"
    assert [row[0] for row in rows(answers["young"].out, "frame")] == ["400", "401"]


def test_a_long_life_shows_first_last_and_the_doubtful(answers):
    """Three of sixty sightings are near the gate, and a lost one is told of; --all shows everything."""
    out = answers["long"].out
    assert out.startswith("landmark 50: in the map at the end; 60 sightings, frames 1000 to 1059\n")
    assert "frame 1001, t = 200.2 s: confirmed: information counter 2\n" in out
    assert "first, last and the most doubtful of its 60 sightings (--all shows all)" in out
    story, passed = out.split("it lay inside the gate")
    assert [row[0] for row in rows(story, "frame")] == ["1000", "1010", "1025", "1040", "1059"]
    assert passed.startswith(" of a sighting that did not go to it once\n")
    assert rows(passed, "frame")[0][0] == "1030"
    whole = rows(answers["all"].out.split("it lay inside")[0], "frame")
    assert [row[0] for row in whole] == [str(1000 + k) for k in range(60)]
    told = json.loads(answers["long json"].out)
    assert len(told["sightings"]) == 60 and told["passed"][0]["reason"] == "CONTEST_LOST"


def test_without_an_option_it_says_where_to_look(answers, folder):
    out = answers["summary"].out
    assert out.startswith("104 frames (0 to 1059, t = ")
    assert "the frames with the most trouble\n" in out and out.rstrip().endswith(
        f"kalmap why {folder} --frame 403"
    )
    told = json.loads(answers["summary json"].out)
    assert told["about"]["log"] == "park" and told["worst"][0]["frame"] == 403
    assert (
        told["matched"] + told["founded"] + told["unused"]
        == told["sightings"]
        == sum(told["reasons"].values())
    )
    assert f"{told['sightings']} sightings: {told['matched']} matched" in out
    assert set(told["reasons"]) <= {reason.name for reason in Reason}


def test_the_frame_is_drawn(answers):
    """Of a landmark the frame in which it was most in doubt; with --json nothing but JSON is printed."""
    pictures = answers["pictures"]
    assert answers["drawn"].out.endswith(f"frame 401 drawn to {pictures / 'frame.png'}\n")
    json.loads(answers["drawn landmark"].out)
    for name in ("frame.png", "landmark.png"):
        assert (pictures / name).read_bytes().startswith(b"\x89PNG")
    assert sorted(one.name for one in pictures.iterdir()) == ["frame.png", "landmark.png"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("no frame", "frame 77 does not exist; numbers run from 0 to 1059, the nearest is 39"),
        ("no landmark", "landmark 45 does not exist; numbers run from 0 to 100, the nearest is 50"),
        ("negative", "landmark -2 does not exist; numbers run from 0"),
        ("huge", "64 bits"),
        ("no time", "nan is no time"),
        ("two", "--landmark, --frame and --time: one of them at a time"),
        ("all of nothing", "--all"),
        ("no picture", "expected a name that ends in .png"),
        ("no place", "no such file or directory"),
        ("words", "'first' is not a valid integer"),
        ("missing", "none: no such file or folder"),
        ("above", "holds no audit trail of data association; there is one in "),
        ("not one", "test_cli_why.py: not an audit trail"),
        ("nothing named", "RESULT"),
    ],
)
def test_what_cannot_be_told_is_one_line_and_code_2(answers, name, words):
    """`drive` founded eleven landmarks, so that the nearest number below 45 is far."""
    assert answers[name].code == 2 and words in answers[name].error


def test_mergers_and_ends_are_sentences(tmp_path):
    """Merged and retired landmarks say into what and why; in a trail without doubts no frame stands out."""
    end = (Managed(0, "merged", "jointly compatible", 1), Managed(5, "retired", "not seen for 9 frames"))
    frames = [msgspec.structs.replace(easy(), number=3), decide(4, {}, np.zeros((0, 2)), managed=end)]
    write_audit(tmp_path / AUDIT, frames, {})
    said = {number: kalmap_inside("why", tmp_path, "--landmark", number).out for number in (0, 1, 5)}
    assert said[0].startswith("landmark 0: merged into 1 in frame 4; 1 sighting, frames 3 to 3\n")
    assert "frame 4, t = 0.8 s: merged into 1: jointly compatible\n" in said[0]
    assert "frame 4, t = 0.8 s: landmark 0 merged into 1: jointly compatible\n" in said[1]
    assert said[5].startswith("landmark 5: retired in frame 4;")
    summary = kalmap_inside("why", tmp_path, "--figure", tmp_path / "x.png")
    assert summary.code == 2 and "no sighting was decided in doubt" in summary.out
    assert "name one with --frame" in summary.err and not (tmp_path / "x.png").exists()
