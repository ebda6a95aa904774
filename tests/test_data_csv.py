"""The csv layout: reading, refusing, and the exact way there and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kalmap.data import check_log, open_log, write_csv_log
from kalmap.records import (
    Fix,
    Log,
    LogError,
    MotionConfig,
    Odometry,
    Reference,
    RunConfig,
    Scan,
    Sightings,
)

ODOMETRY = "time,speed,steering\n0,1,0.1\n1,2,0.1\n2,2,0.1\n"
SIGHTINGS = "time,range,bearing,id,colour\n0.5,3,0.1,4,7\n0.5,4,-0.1,-1,8\n1.5,,,,\n"


def folder_with(folder, **files):
    for name, text in files.items():
        (folder / name.replace("_json", ".json").replace("_csv", ".csv")).write_text(text)
    return folder


def test_a_small_log(tmp_path):
    log = open_log(
        folder_with(tmp_path, odometry_csv=ODOMETRY, sightings_csv=SIGHTINGS, fixes_csv="time,x,y\n0.7,1,2\n")
    )
    first, frame, fix, block, _, blind, last = list(log)
    assert first.time == frame.time == 0.5 and first.values.tolist() == [[1.0, 0.1]]
    assert frame.ids.tolist() == [4, -1] and frame.attributes["colour"].tolist() == [7, 8]
    assert isinstance(fix, Fix) and np.isnan(fix.heading)
    assert block.time == 1.0 and last.time == 2.0 and len(blind.values) == 0
    assert log.defaults.motion.model == "velocity-steering" and log.name == tmp_path.name


def test_a_small_log_is_in_order(tmp_path):
    log = open_log(folder_with(tmp_path, odometry_csv=ODOMETRY, sightings_csv=SIGHTINGS))
    stamps = [event.time for event in log]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(("header", "model"), [
    ("time,speed,turn_rate", "unicycle"), ("dtheta,time,dx,dy", "increments"),
])  # fmt: skip
def test_the_columns_tell_the_motion_model(tmp_path, header, model):
    cells = len(header.split(",")) * ["1"]
    log = open_log(folder_with(tmp_path, odometry_csv=f"{header}\n{','.join(cells)}\n"))
    assert log.defaults.motion.model == model and list(log) is not None


def test_increments_ended_at_their_time(tmp_path):
    text = "time,dx,dy,dtheta\n1,1,0,0\n2,2,0,0\n"
    log = open_log(
        folder_with(tmp_path, odometry_csv=text, sightings_csv="time,range,bearing\n0,1,0\n1.5,1,0\n")
    )
    start, one, frame, two = list(log)
    assert (start.time, one.time, frame.time, two.time) == (0.0, 1.0, 1.5, 2.0)
    assert two.values.tolist() == [[2.0, 0.0, 0.0]] and two.durations.tolist() == [1.0]


def test_log_json_is_taken(tmp_path):
    text = '{"name": "n", "config": {"motion": {"model": "ackermann", "wheelbase": 2}}, "start": [1, 2, 3]}'
    log = open_log(folder_with(tmp_path, odometry_csv=ODOMETRY, log_json=text))
    assert (log.name, log.defaults.motion.wheelbase, log.start.tolist()) == ("n", 2.0, [1, 2, 3])


@pytest.mark.parametrize(("text", "words"), [
    ('{"nmae": 1}', "nmae"),
    ('{"config": {"motion": {"wheelbse": 1}}}', "wheelbse"),
    ('{"config": {"motion": {"wheelbase": -1}}}', "config.motion.wheelbase"),
    ('{"config": {"motion": {"model": "unicycle"}}}', "config.motion.model"),
    ('{"start": [0, 0]}', "start"),
    ('{"start": ', "not JSON"),
    ("[]", "log.json"),
])  # fmt: skip
def test_log_json_is_strict(tmp_path, text, words):
    with pytest.raises(LogError, match=words):
        open_log(folder_with(tmp_path, odometry_csv=ODOMETRY, log_json=text))


BAD_ROWS = [
    ("0.5,3,0.1", "id", "expected 5 columns, found 3"),
    ("0.5,3,0.1,4,7,9", "column 6", "expected 5 columns, found 6"),
    ("0.5,x,0.1,4,7", "range", "expected a number, found 'x'"),
    ("0.5,-3,0.1,4,7", "range", "0 or more"),
    ("0.5,nan,0.1,4,7", "range", "finite"),
    ("0.5,3,inf,4,7", "bearing", "finite"),
    ("0.5,3,,4,7", "bearing", "finite"),
    ("0.5,3,0.1,4,", "colour", "finite"),
    ("0.5,3,0.1,4.5,7", "id", "whole number"),
    ("0.5,3,0.1,-3,7", "id", "-1"),
    ("0.5,3,0.1,5,7", "id", "unknown id 5"),
    ("0.1,3,0.1,4,7", "time", "goes back"),
    (",3,0.1,4,7", "time", "expected a number"),
    ("nan,3,0.1,4,7", "time", "finite"),
]


@pytest.mark.parametrize(("row", "field", "words"), BAD_ROWS)
def test_bad_rows(tmp_path, row, field, words):
    text = f"time,range,bearing,id,colour\n0.2,3,0.1,4,7\n{row}\n1.5,3,0,4,7\n"
    log = open_log(
        folder_with(tmp_path, odometry_csv=ODOMETRY, sightings_csv=text, landmarks_csv="id,x,y\n4,1,1\n")
    )
    events = []
    with pytest.raises(LogError) as caught:
        for event in log:
            events.append(event)
    assert (caught.value.record, caught.value.field) == (3, field) and words in caught.value.problem
    assert [event.time for event in events if isinstance(event, Sightings)] == [0.2]
    skipped = []
    events = list(log.open(skipped.append))
    assert [(s.record, s.field) for s in skipped] == [(3, field)]
    assert [event.time for event in events if isinstance(event, Sightings)] == [0.2, 1.5]
    report = check_log(log)
    assert report.verdict == "problems" and report.findings[0].first[0].startswith("record 3: ")


@pytest.mark.parametrize(("name", "text", "words"), [
    ("odometry_csv", "", "header"),
    ("odometry_csv", "time,speed\n0,1\n", "steering"),
    ("odometry_csv", "time,speed,steering,wind\n0,1,0,0\n", "wind"),
    ("odometry_csv", "time,speed,steering,speed\n0,1,0,0\n", "named twice"),
    ("odometry_csv", "time,speed,steering,var_speed\n0,1,0,0\n", "var_steering"),
    ("odometry_csv", 'time,speed,steering\n0,"1,0\n', "not csv"),
    ("sightings_csv", "time,range\n0,1\n", "bearing"),
    ("fixes_csv", "time,x\n0,1\n", "y"),
    ("truth_csv", "time,x,y,heading\n0,1,1\n", "heading"),
    ("truth_csv", "time,x,y,heading\n0,1,nan,0\n", "field y"),
    ("landmarks_csv", "id,x,y\n1,2\n", "field y"),
])  # fmt: skip
def test_bad_tables(tmp_path, name, text, words):
    files = {"odometry_csv": ODOMETRY, "sightings_csv": SIGHTINGS} | {name: text}
    with pytest.raises(LogError, match=words):
        list(open_log(folder_with(tmp_path, **files)))


def test_a_log_with_scans_or_into_a_used_folder_is_not_written(tmp_path):
    scan = Scan(0.0, np.ones(2), np.zeros(2))
    log = Log("n", "s", RunConfig(), lambda skip: iter([scan]))
    with pytest.raises(LogError, match="no place for raw scans"):
        write_csv_log(log, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "other.txt").write_text("mine")
    with pytest.raises(LogError, match="not empty"):
        write_csv_log(Log("n", "s", RunConfig(), lambda skip: iter([])), tmp_path)


numbers = st.floats(-1e3, 1e3, allow_nan=False)


@st.composite
def logs(draw):
    """A log whose blocks end at its frames, with samples of any length and any numbers."""
    model, width = draw(st.sampled_from([("ackermann", 2), ("unicycle", 2), ("increments", 3)]))
    stated = draw(st.booleans())
    clock, events = draw(st.sampled_from([0.0, 1.2e9])), []
    for _ in range(draw(st.integers(1, 6))):
        size = draw(st.integers(1, 4))
        durations = np.array([draw(st.integers(1, 100)) * 0.001 for _ in range(size)])
        clock += durations.sum()
        values = np.array([[draw(numbers) for _ in range(width)] for _ in range(size)])
        covariance = np.tile(np.eye(width) * draw(st.floats(0, 9)), (size, 1, 1)) if stated else None
        events.append(Odometry(clock, values, durations, covariance))
        seen = draw(st.integers(0, 3))
        polar = np.array([[abs(draw(numbers)), draw(numbers)] for _ in range(seen)]).reshape(seen, 2)
        ids = np.array([draw(st.integers(-1, 9)) for _ in range(seen)], dtype=np.int64)
        size = np.array([draw(numbers) for _ in range(seen)])
        events.append(Sightings(clock, polar, ids, None, {"size": size}))
        if draw(st.booleans()):
            events.append(
                Fix(clock, draw(numbers), draw(numbers), draw(st.sampled_from([0.3, float("nan")])))
            )
    reference = Reference(
        times=np.array([0.0, 1.0]),
        positions=np.array([[draw(numbers), 0.1], [2.0, 1 / 3]]),
        headings=np.array([0.2, np.nan]),
        landmark_ids=np.arange(3),
        landmarks=np.ones((3, 2)) / 3,
    )
    start = np.array([draw(numbers) for _ in range(3)])
    defaults = RunConfig(motion=MotionConfig(model=model, wheelbase=2.5))
    return Log("n", "s", defaults, lambda skip: iter(events), (reference,), start)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(log=logs())
def test_there_and_back(tmp_path_factory, log):
    folder = tmp_path_factory.mktemp("log") / "out"
    write_csv_log(log, folder)
    again = open_log(folder)
    assert again.defaults == log.defaults and again.start.tolist() == log.start.tolist()
    for a, b in zip(log, again, strict=True):
        same_event(a, b)
    for field in ("times", "positions", "headings", "landmark_ids", "landmarks"):
        expected, found = getattr(log.references[0], field), getattr(again.references[0], field)
        assert np.array_equal(expected, found, equal_nan=True)


def same_event(a, b):
    assert type(a) is type(b) and a.time == b.time
    if isinstance(a, Fix):
        assert (a.x, a.y) == (b.x, b.y) and np.array_equal(a.heading, b.heading, equal_nan=True)
        return
    assert np.array_equal(a.values, b.values)
    if isinstance(a, Odometry):
        assert np.array_equal(a.durations, b.durations)
    else:
        assert np.array_equal(a.ids, b.ids) and np.array_equal(a.attributes["size"], b.attributes["size"])
    if a.covariance is None:
        assert b.covariance is None
    else:
        assert np.array_equal(a.covariance, b.covariance)
