"""Every format on tiny logs that the tests write themselves, good ones and bad ones."""

from __future__ import annotations

import lzma
import zipfile

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from kalmap.data import mrclam_robots, open_log, read_map
from kalmap.data.mat import load_mat, variable_names
from kalmap.data.streams import FixStream, find_faults
from kalmap.perception import ReflectorDetector
from kalmap.records import Fix, LogError, Odometry, Scan, Sightings

PARK_ROWS = np.array(
    [
        [1010.0, 5.0, 1.5, 0.0, 0.0, 7.0],
        [1010.0, 6.0, 1.7, 0.0, 0.0, 9.0],
        [1060.0, 5.1, np.pi / 2, 0.0, 0.0, 7.0],
    ]
)


def park(folder, rows=PARK_ROWS, times=(1000, 1025, 1050, 1075), speed=(1.0, 2.0, 3.0, 4.0)):
    savemat(
        folder / "aa3_dr.mat",
        {
            "time": np.array(times, dtype=float)[:, None],
            "speed": np.array(speed)[:, None],
            "steering": np.full((len(times), 1), 0.1),
        },
    )
    savemat(folder / "data_sensor_clean_clean.mat", {"data_sensor_clean_clean": np.array(rows)})
    return folder


def until_error(log):
    """The events before the `LogError`, and the error."""
    events = []
    with pytest.raises(LogError) as caught:
        for event in log:
            events.append(event)
    return events, caught.value


def tolerantly(log):
    skipped = []
    return list(log.open(skipped.append)), skipped


def test_samples_are_held_and_split_at_frames(tmp_path):
    log = open_log(park(tmp_path))
    first, frame, second, other, last = list(log)
    assert np.allclose(first.durations, [0.010]) and first.time == frame.time == 1.01
    assert np.allclose(second.durations, [0.015, 0.025, 0.010]) and second.values[:, 0].tolist() == [1, 2, 3]
    assert np.allclose(last.durations, [0.015]) and last.time == 1.075
    assert frame.ids.tolist() == [7, 9] and frame.record == 1 and other.record == 3
    assert other.values[0, 1] == 0.0  # pi / 2 in the file is straight ahead
    assert log.start.tolist() == [0, 0, 0] and log.references == ()


def test_a_repeated_odometry_stamp_takes_no_time(tmp_path):
    log = open_log(park(tmp_path, times=(1000, 1025, 1025, 1075)))
    blocks = [event for event in log if isinstance(event, Odometry)]
    assert sum(block.durations.sum() for block in blocks) == pytest.approx(0.075)
    assert np.concatenate([block.values[:, 0] for block in blocks]).tolist() == [1, 1, 3, 3]


def test_frames_outside_the_odometry_are_left_out(tmp_path):
    rows = PARK_ROWS.copy()
    rows[:, 0] = [990, 1050, 9000]
    assert [e.time for e in open_log(park(tmp_path, rows)) if isinstance(e, Sightings)] == [1.05]


def test_the_last_sample_is_held_a_little_for_a_last_frame(tmp_path):
    rows = PARK_ROWS.copy()
    rows[2, 0] = 1300.0
    *_, block, frame = open_log(park(tmp_path, rows))
    assert block.time == frame.time == 1.3


BAD_SIGHTINGS = [
    (1, np.nan, "range", "finite"),
    (1, np.inf, "range", "finite"),
    (1, -1.0, "range", "0 or more"),
    (2, np.nan, "bearing", "finite"),
    (2, -np.inf, "bearing", "finite"),
    (0, np.nan, "time", "finite"),
    (0, 1005.0, "time", "goes back"),
    (5, -7.0, "id", "whole number"),
    (5, 2.5, "id", "whole number"),
    (5, 1e300, "id", "whole number"),
]


@pytest.mark.parametrize(("column", "value", "field", "words"), BAD_SIGHTINGS)
def test_a_bad_sighting_is_named_after_all_earlier_events(tmp_path, column, value, field, words):
    rows = PARK_ROWS.copy()
    rows[2, column] = value
    log = open_log(park(tmp_path, rows))
    events, error = until_error(log)
    assert error.record == 3 and error.field == field and words in error.problem
    assert error.file.endswith("data_sensor_clean_clean.mat")
    assert [e.time for e in events if isinstance(e, Sightings)] == [1.01]
    events, skipped = tolerantly(log)
    assert [(s.record, s.field) for s in skipped] == [(3, field)]
    assert events[-1].time == 1.075


def test_a_bad_sighting_does_not_spoil_the_rest_of_its_frame(tmp_path):
    rows = PARK_ROWS.copy()
    rows[0, 1] = -1.0
    events, skipped = tolerantly(open_log(park(tmp_path, rows)))
    assert next(e for e in events if isinstance(e, Sightings)).ids.tolist() == [9]
    assert len(skipped) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_odometry_is_named(tmp_path, value):
    log = open_log(park(tmp_path, speed=(1.0, 2.0, value, 4.0)))
    events, error = until_error(log)
    assert (error.record, error.field) == (3, "speed")
    assert [event.time for event in events] == [1.01, 1.01, 1.025]
    events, _ = tolerantly(log)
    # The sample before the bad one goes on holding.
    blocks = [event for event in events if isinstance(event, Odometry)]
    assert np.concatenate([block.values[:, 0] for block in blocks]).tolist() == [1, 1, 2, 2]
    assert sum(block.durations.sum() for block in blocks) == pytest.approx(0.075)


def test_odometry_that_goes_back_is_bad(tmp_path):
    events, error = until_error(open_log(park(tmp_path, times=(1000, 1050, 1025, 1075))))
    assert (error.record, error.field) == (3, "time") and "goes back" in error.problem and events


def test_one_stamp_far_ahead_condemns_only_itself():
    stream = FixStream(
        file="f",
        times=np.array([0.0, 1.0, 900.0, 2.0, np.nan, 3.0, 2.5, 4.0]),
        records=np.arange(1, 9),
        values=np.zeros((8, 3)),
    )
    good, faults = find_faults(stream)
    assert np.flatnonzero(~good).tolist() == [2, 4, 6]
    assert ["ahead" in faults[0].problem, "finite" in faults[1].problem, "back" in faults[2].problem] == [
        True
    ] * 3


def test_odometry_without_any_usable_record(tmp_path):
    events, error = until_error(open_log(park(tmp_path, speed=(np.nan,) * 4)))
    assert error.record == 1 and events == []
    skipped = []
    with pytest.raises(LogError, match="no odometry record"):
        list(open_log(tmp_path).open(skipped.append))
    assert len(skipped) == 4


@pytest.mark.parametrize("compressed", [False, True])
def test_a_corrupt_or_truncated_mat_is_a_log_error(tmp_path, compressed):
    park(tmp_path)
    path = tmp_path / "aa3_dr.mat"
    content = {name: loadmat(path)[name] for name in ("time", "speed", "steering")}
    savemat(path, content, do_compression=compressed)
    whole = path.read_bytes()
    generator = np.random.default_rng(1)
    failed = 0
    for trial in range(300):
        data = bytearray(whole)
        if trial % 2:
            data = data[: generator.integers(0, len(whole))]
        else:
            for k in generator.integers(0, len(whole), 4):
                data[k] = generator.integers(0, 256)
        path.write_bytes(data)
        try:
            list(open_log(tmp_path))
        except LogError as error:
            failed += 1
            assert "aa3_dr.mat" in str(error)
    assert failed > 150


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({"speed": np.ones((4, 1)), "steering": np.ones((4, 1))}, "time"),
        ({"time": np.ones((4, 1)), "speed": np.ones((3, 1)), "steering": np.ones((4, 1))}, "speed"),
        ({"time": np.ones((4, 2)), "speed": np.ones((4, 1)), "steering": np.ones((4, 1))}, "time"),
        ({"time": np.ones((4, 1)), "speed": "abc", "steering": np.ones((4, 1))}, "speed"),
    ],
)
def test_variables_of_the_wrong_kind(tmp_path, content, field):
    park(tmp_path)
    savemat(tmp_path / "aa3_dr.mat", content)
    with pytest.raises(LogError) as caught:
        list(open_log(tmp_path))
    assert caught.value.field == field


def test_all_kinds_of_numbers_come_through(tmp_path):
    """Our own reader of MATLAB files against what scipy wrote, plain and compressed."""
    generator = np.random.default_rng(2)
    content = {
        name: (generator.random((3, 4)) * 100).astype(name)
        for name in ("float64", "float32", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64")
    }
    cells = np.empty((1, 2), dtype=object)
    cells[0] = [np.ones((2, 3)), np.zeros((0, 0))]
    for compressed in (False, True):
        path = tmp_path / "numbers.mat"
        savemat(path, content | {"cells": cells, "text": "abc"}, do_compression=compressed)
        found = load_mat(path, [*content, "cells"])
        assert all(np.array_equal(found[name], values) for name, values in content.items())
        assert [cell.shape for cell in found["cells"]] == [(2, 3), (0, 0)]
        assert variable_names(path)[-2:] == ["cells", "text"]
    savemat(path, {"x": np.ones(2) * 1j})
    with pytest.raises(LogError, match="field x: not a readable MATLAB file: expected real numbers"):
        load_mat(path, ["x"])


def test_a_missing_column_in_a_mat(tmp_path):
    with pytest.raises(LogError, match="any x 6 numbers, found 3 x 5"):
        list(open_log(park(tmp_path, PARK_ROWS[:, :5])))


def test_missing_files_and_wrong_folders(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "nowhere")
    with pytest.raises(LogError, match="folder is empty"):
        open_log(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(LogError, match=r"Looked for .*odometry\.csv.*The folder holds notes\.txt"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="none of these"):
        open_log(tmp_path / "notes.txt")
    park(tmp_path)
    (tmp_path / "data_sensor_clean_clean.mat").unlink()
    with pytest.raises(LogError, match="the variant 'ids' needs it"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="no variant 'x'; there are ids"):
        open_log(tmp_path, variant="x")
    with pytest.raises(LogError, match="one vehicle"):
        open_log(tmp_path, robot=2)


def test_detections_without_identity(tmp_path):
    cells = np.empty((1, 3), dtype=object)
    cells[0] = [np.array([[5.0, 6.0], [1.0, 2.0], [0.3, 0.4]]), np.zeros((0, 0)), np.ones((3, 1))]
    log = tmp_path / "VictoriaParkSinSincronizar.mat"
    content = {"time": np.arange(5.0), "u": np.ones((2, 5)), "TLsr": np.array([0.5, 1.5, 2.5]), "zt": cells}
    savemat(log, content)
    frames = [event for event in open_log(log) if isinstance(event, Sightings)]
    assert [len(frame.values) for frame in frames] == [2, 0, 1]
    assert frames[0].attributes["diameter"].tolist() == [0.3, 0.4] and frames[0].ids is None
    cells[0, 1] = np.ones((2, 4))
    savemat(log, content)
    events, error = until_error(open_log(log))
    assert (error.record, error.field) == (2, "zt") and events[-1].time >= 1
    frames = [event for event in tolerantly(open_log(log))[0] if isinstance(event, Sightings)]
    assert [len(frame.values) for frame in frames] == [2, 1]


def ascii_park(folder, laser):
    with zipfile.ZipFile(folder / "victoria_park_ascii.zip", "w") as archive:
        archive.writestr("DRS.txt", "0.0 1.0 0.1\n1.0 1.0 0.1\n2.0 1.0 0.1\n")
        archive.writestr("GPS.txt", "0.2 7.0 8.0\n")
        archive.writestr("LASER.txt", laser)
    return folder


def test_raw_scans_out_of_the_archive(tmp_path):
    ranges = "\t".join(["81.91"] * 360 + ["4.5"])
    laser = f"0.5\t{ranges}\t1.5\t{ranges}\t"
    log = open_log(ascii_park(tmp_path, laser), variant="scans")
    scans = [event for event in log if isinstance(event, Scan)]
    assert [scan.time for scan in scans] == [0.5, 1.5]
    assert np.isinf(scans[0].ranges[0]) and scans[0].ranges[-1] == 4.5
    fix = next(event for event in log if isinstance(event, Fix))
    assert (fix.x, fix.y) == (8.0, 7.0) and np.isnan(fix.heading)  # north comes first in GPS.txt
    cut = open_log(ascii_park(tmp_path, laser[:-100]), variant="scans")
    events, error = until_error(cut)
    assert error.record == 2 and "expected 362 numbers" in error.problem
    assert sum(isinstance(event, Scan) for event in events) == 1
    wrong = open_log(ascii_park(tmp_path, laser.replace("4.5", "x")), variant="scans")
    assert until_error(wrong)[1].field == "range"
    (tmp_path / "victoria_park_ascii.zip").write_bytes(b"PK no zip")
    with pytest.raises(LogError, match="cannot be read"):
        open_log(tmp_path, variant="scans")


def test_ascii_detections(tmp_path):
    (tmp_path / "measurements.dat").write_text("0.5 5.0 1.5708 0.3\n1.5 5.0 1.5\n")
    log = open_log(ascii_park(tmp_path, ""), variant="ascii")
    events, error = until_error(log)
    assert (error.record, error.field) == (2, "diameter") and "expected 4 columns, found 3" in error.problem
    frame = next(event for event in events if isinstance(event, Sightings))
    assert frame.values[0, 1] == pytest.approx(0.0, abs=1e-5)


def test_car_park(tmp_path):
    laser, bits = np.full((2, 361), 81.91), np.zeros((2, 361))
    laser[0, 180:182], bits[0, 180:182] = 5.0, 8192
    savemat(
        tmp_path / "data_set.mat",
        {
            "Time_VS": np.arange(4.0),
            "Velocity": np.ones(4),
            "Steering": np.zeros(4),
            "TimeLaser": np.array([0.5, 1.5]),
            "Laser": laser,
            "Intensity": bits,
            "TimeGPS": np.array([0.2, 1.2]),
            "GPSLon": np.ones(2),
            "GPSLat": np.ones(2),
        },
    )
    savemat(tmp_path / "beac_juan3.mat", {"estbeac": np.ones((15, 2))})
    scans = [event for event in open_log(tmp_path) if isinstance(event, Scan)]
    assert len(scans) == 2 and scans[0].intensities[180] == 8192
    log = open_log(tmp_path, detector=ReflectorDetector())
    assert [len(e.values) for e in log if isinstance(e, Sightings)] == [1, 0]
    raw = open_log(tmp_path, variant="scans", detector=ReflectorDetector())
    assert not any(isinstance(e, Sightings) for e in raw)
    assert log.references[0].landmark_ids.tolist() == list(range(15))


HEAD = "# UTIAS\n# Keith\n# Format\n# Time\n"


def mrclam(folder, odometry, measured, truth=None):
    (folder / "Barcodes.dat").write_text(HEAD + "1 5\n2 14\n6 63\n7 25\n")
    (folder / "Landmark_Groundtruth.dat").write_text(HEAD + "6 1.0 2.0 0.1 0.1\n7 3.0 4.0 0.1 0.1\n")
    (folder / "Robot1_Odometry.dat.xz").write_bytes(lzma.compress((HEAD + odometry).encode()))
    (folder / "Robot1_Measurement.dat").write_text(HEAD + measured)
    if truth:
        (folder / "Robot1_Groundtruth.dat").write_text(HEAD + truth)
    return folder


ODOMETRY = "10.0 0.1 0.0\n11.0 0.1 0.1\n12.0 0.0 0.0\n"
MEASURED = "10.5 63 2.0 0.1\n10.5 14 1.0 0.2\n10.5 25 3.0 0.0\n11.5 99 1.0 0.0\n11.6 14 1.0 0.0\n"


def test_mrclam(tmp_path):
    log = open_log(mrclam(tmp_path, ODOMETRY, MEASURED, "9.0 1.0 2.0 3.1\n11.0 3.0 4.0 -3.1\n"))
    frames = [event for event in log if isinstance(event, Sightings)]
    assert [frame.ids.tolist() for frame in frames] == [[6, 7], [-1]]
    assert frames[0].record == 5 and mrclam_robots(tmp_path) == [1]
    # commands are obeyed 0.2 s after their stamp, so the first one begins at 10.2
    assert log.start[:2] == pytest.approx([2.2, 3.2])
    assert log.start[2] == pytest.approx(3.1 + 0.6 * (2 * np.pi - 6.2) - 2 * np.pi)
    assert log.references[0].landmark_ids.tolist() == [6, 7]
    with pytest.raises(LogError, match="robots in this folder: 1"):
        open_log(tmp_path, robot=0)
    with pytest.raises(LogError, match="MRCLAM logs have none"):
        open_log(tmp_path, variant="ids")


@pytest.mark.parametrize(("row", "field", "words"), [
    ("11.5 25 1.0", "bearing", "expected 4 columns, found 3"),
    ("11.5 25 1.0 0.1 0.1", "column 5", "expected 4 columns, found 5"),
    ("11.5 25 x 0.1", "range", "expected a number, found 'x'"),
    ("11.5 nan 1.0 0.1", "id", "whole number"),
    ("11.5 25 nan 0.1", "range", "finite"),
    ("\x00\ufffd", "barcode", "is missing"),
])  # fmt: skip
def test_mrclam_bad_rows(tmp_path, row, field, words):
    measured = MEASURED.splitlines()
    measured[3] = row
    log = open_log(mrclam(tmp_path, ODOMETRY, "\n".join(measured)))
    events, error = until_error(log)
    assert (error.record, error.field) == (8, field) and words in error.problem
    assert any(isinstance(event, Sightings) for event in events)
    assert len(tolerantly(log)[1]) == 1


def test_mrclam_files_that_cannot_be_read(tmp_path):
    mrclam(tmp_path, ODOMETRY, MEASURED)
    path = tmp_path / "Robot1_Odometry.dat.xz"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(LogError, match="cannot be read"):
        list(open_log(tmp_path))
    (tmp_path / "Barcodes.dat").unlink()
    with pytest.raises(LogError, match=r"neither plain nor with \.xz"):
        open_log(tmp_path)


def test_mrclam_truth_that_does_not_cover_the_start(tmp_path):
    with pytest.raises(LogError, match="does not cover"):
        open_log(mrclam(tmp_path, ODOMETRY, MEASURED, "19.0 1.0 2.0 3.1\n"))


CIRCLES = """# comment
STEP a.ppm 0.0 -1.0 0.5 0.04 0.01 0.09 0.001 0.002 0.01
LANDMARK_C 0.0 -2.0 0.9 0.04 0.0 0.09 3
LANDMARK_C 1.0 -1.0 0.8 0.04 0.0 0.04 -1
STEP b.ppm 0.0 -1.0 0.5 0.04 0.01 0.09 0.001 0.002 0.01
"""


def test_dlr_is_turned_so_that_x_is_forward(tmp_path):
    path = tmp_path / "map.circles"
    path.write_text(CIRCLES)
    step, frame, _, blind = list(open_log(path))
    assert step.values.tolist() == [[1.0, 0.0, 0.5]] and step.time == frame.time == 1.0
    expected = [[0.09, -0.01, -0.002], [-0.01, 0.04, 0.001], [-0.002, 0.001, 0.01]]
    assert np.allclose(step.covariance[0], expected)
    assert np.allclose(frame.values, [[2.0, 0.0], [np.sqrt(2), np.pi / 4]])
    assert np.allclose(frame.covariance[0], [[0.09, 0.0], [0.0, 0.01]])
    assert frame.ids.tolist() == [3, -1] and len(blind.values) == 0 and blind.time == 2.0


@pytest.mark.parametrize(("old", "new", "record", "field"), [
    ("0.9 0.04 0.0 0.09 3", "0.9 0.04 0.0 0.09", 3, "id"),
    ("STEP b.ppm 0.0", "STEP b.ppm", 5, "cPhiPhi"),
    ("1.0 -1.0 0.8 0.04", "1.0 -1.0 0.8 -0.04", 4, "covariance"),
    ("LANDMARK_C 1.0", "garbage 1.0", 4, "y"),
    ("LANDMARK_C 0.0 -2.0", "LANDMARK_C 0.0 0.0", 3, "covariance"),
])  # fmt: skip
def test_dlr_bad_lines(tmp_path, old, new, record, field):
    path = tmp_path / "map.circles"
    path.write_text(CIRCLES.replace(old, new))
    _, error = until_error(open_log(path))
    assert (error.record, error.field) == (record, field)
    assert len(tolerantly(open_log(path))[1]) == 1


def test_maps_of_both_forms(tmp_path):
    savemat(tmp_path / "a.mat", {"lm": np.ones((2, 3)), "wp": np.zeros((2, 2))})
    world = read_map(tmp_path / "a.mat")
    assert world.landmarks.shape == (3, 2) and world.waypoints.shape == (2, 2)
    (tmp_path / "b.txt").write_text("#c\nlm 2 1\n 1 2\n\nwp 2 2\n0 0\n1 1\n")
    assert read_map(tmp_path / "b.txt").landmarks.tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("text", [
    "", "lm 2 1\n1 2\n", "lm 2 2\n1 2\n", "lm 3 1\n1 2 3\n",
    "lm 2 1\n1 x\nwp 2 0\n", "lm 2 1\n1 nan\nwp 2 0\n",
])  # fmt: skip
def test_bad_maps(tmp_path, text):
    (tmp_path / "b.txt").write_text(text)
    with pytest.raises(LogError, match=r"b\.txt"):
        read_map(tmp_path / "b.txt")
