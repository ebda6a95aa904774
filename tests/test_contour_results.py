"""Result folders of contour maps: the files that other tools read, metrics, the page; nothing left of other maps."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest

from contour_samples import REACH, contours_of, floor_run
from kalmap.data import results
from kalmap.data.native_map import read_map_file
from kalmap.data.trajectory_files import read_trajectory_csv
from kalmap.perception import occupancy_grid
from kalmap.records import (
    ContourConfig,
    EstimationError,
    Log,
    Reference,
    RunConfig,
    Scan,
    SensorConfig,
    Sweeps,
)
from kalmap.slam import Outcome
from kalmap.study.cases import judge
from kalmap.study.compare import Compared
from kalmap.study.present import run_view, save_comparison, save_run
from test_nav2 import serve
from test_view_report import check
from test_view_samples import loop_run, manifest

COMMON = {"trajectory.tum", "trajectory.csv", "map.kalmap", "metrics.json", "manifest.json"}
CONTOURS = {"contours.csv", "contours.geojson", "trajectory-online.csv"}
GRID = {"map.pgm", "map.yaml"}
LANDMARKS = {"landmarks.csv", "landmarks.geojson"}
CONFIG = RunConfig(sensor=SensorConfig(max_range=REACH), contour=ContourConfig(method="dc-slasem"))


def write(folder, run, grid=None):
    return results.write_result(
        folder, estimate=run.estimate, trace=run.trace, metrics={}, manifest=manifest(), grid=grid
    )


def names(folder):
    return {entry.name for entry in folder.iterdir() if entry.is_file()}


def test_each_kind_of_map_has_its_files_and_leaves_none_of_the_other(tmp_path):
    run = floor_run()
    grid = occupancy_grid(run.estimate.sweeps(), max_range=REACH, clear_range=5.0)
    assert set(write(tmp_path, run, grid)) == names(tmp_path) == COMMON | CONTOURS | GRID
    write(tmp_path, run)
    assert names(tmp_path) == COMMON | CONTOURS
    write(tmp_path, loop_run(3))
    assert names(tmp_path) == COMMON | LANDMARKS
    write(tmp_path, run, grid)
    assert names(tmp_path) == COMMON | CONTOURS | GRID


def test_trajectories_are_the_last_word_by_stamp_and_what_was_said_at_the_time(tmp_path):
    run = floor_run()
    paths = write(tmp_path, run)
    final, course = read_trajectory_csv(paths["trajectory.csv"]), run.estimate.trajectory
    assert (np.diff(final.times) > 0).all()
    assert (np.diff(course.stamps) < 0).any()
    for row, stamp in enumerate(course.stamps):
        place = int(np.flatnonzero(final.times == stamp)[0])
        assert final.poses[place].tolist() == course.poses[row].tolist()
        assert final.covariances[place].tolist() == course.covariances[row].tolist()
    tum = np.loadtxt(paths["trajectory.tum"])
    np.testing.assert_allclose(tum[:, 0], final.times, atol=1e-9)
    np.testing.assert_allclose(tum[:, 1:3], final.poses[:, :2], rtol=1e-8, atol=1e-12)
    online = read_trajectory_csv(paths["trajectory-online.csv"])
    assert online.times.tolist() == run.trace.times.tolist()
    assert online.poses.tolist() == run.trace.poses.tolist()


def test_a_row_without_a_stamp_keeps_its_time(tmp_path):
    run = floor_run()
    stamps = run.estimate.trajectory.stamps.copy()
    stamps[3] = np.nan
    course = msgspec.structs.replace(run.estimate.trajectory, stamps=stamps)
    assert course.printed()[3] == course.times[3]
    run = msgspec.structs.replace(run, estimate=msgspec.structs.replace(run.estimate, trajectory=course))
    assert np.isfinite(read_trajectory_csv(write(tmp_path, run)["trajectory.csv"]).times).all()


def test_contours_as_a_table_and_as_lines(tmp_path):
    run = floor_run()
    contours = run.estimate.contours
    order = np.random.default_rng(1).permutation(len(contours))  # runs whose rows are mixed
    mixed = type(contours)(*(getattr(contours, name)[order] for name in contours.__struct_fields__))
    paths = write(
        tmp_path,
        msgspec.structs.replace(
            run, estimate=msgspec.structs.replace(run.estimate, contours=mixed, joint=_no_joint)
        ),
    )
    rows = list(csv.DictReader(paths["contours.csv"].open()))
    assert list(rows[0]) == ["run", "x", "y", "p_xx", "p_xy", "p_yy", "nx", "ny", "sightings"]
    collection = json.loads(paths["contours.geojson"].read_text())
    assert (collection["type"], collection["coordinates_frame"]) == ("FeatureCollection", "local metres")
    features = {feature["id"]: feature for feature in collection["features"]}
    assert len(features) == len(collection["features"]) == len(np.unique(contours.runs))
    for number in np.unique(mixed.runs):
        chosen = np.flatnonzero(mixed.runs == number)
        places = mixed.positions[chosen].tolist()
        feature, table = features[number], [row for row in rows if int(row["run"]) == number]
        kind = "LineString" if len(chosen) > 1 else "Point"
        expected = places if len(chosen) > 1 else places[0]
        assert feature["geometry"] == {"type": kind, "coordinates": expected}
        assert feature["properties"]["covariances"] == mixed.covariances[chosen].tolist()
        assert feature["properties"]["normals"] == mixed.normals[chosen].tolist()
        assert feature["properties"]["sightings"] == mixed.sightings[chosen].tolist()
        assert [[float(row["x"]), float(row["y"])] for row in table] == places
        assert [float(row["p_xy"]) for row in table] == mixed.covariances[chosen, 0, 1].tolist()
        assert [float(row["p_yy"]) for row in table] == mixed.covariances[chosen, 1, 1].tolist()
        assert [[float(row["nx"]), float(row["ny"])] for row in table] == mixed.normals[chosen].tolist()
        assert [int(row["sightings"]) for row in table] == mixed.sightings[chosen].tolist()


def _no_joint():
    raise EstimationError("too many samples")


def test_what_is_not_finite_is_named(tmp_path):
    run = floor_run()
    spoilt = run.estimate.contours.positions.copy()
    spoilt[6, 1] = np.nan
    bad = msgspec.structs.replace(run.estimate.contours, positions=spoilt)
    lost = msgspec.structs.replace(run.estimate.trajectory, poses=run.estimate.trajectory.poses * np.inf)
    for change, message in (
        ({"contours": bad}, "position of sample 7"),
        ({"trajectory": lost}, "pose at trajectory row 1"),
    ):
        estimate = msgspec.structs.replace(run.estimate, **change)
        with np.errstate(invalid="ignore"), pytest.raises(EstimationError, match=message):
            write(tmp_path / "r", msgspec.structs.replace(run, estimate=estimate))
    assert not (tmp_path / "r").exists()


def outcome_of(run, **changes) -> Outcome:
    """What the run loop hands over."""
    nothing = np.zeros(0, dtype=np.int64)
    grown = np.linspace(0.0, 1.0, len(run.trace.times))[:, None]
    fields = {
        "estimate": run.estimate,
        "trace": run.trace,
        "frames": len(run.trace.times),
        "sightings": int(run.trace.sightings.sum()),
        "runtime": 1.5,
        "skipped": [],
        "skipped_total": 0,
        "truth_ids": nothing,
        "labels": nothing,
        "labels_at_once": nothing,
        "times": np.zeros(0),
        "values": np.zeros((0, 2)),
        "association_seconds": 0.0,
        "decisions": [],
        "dead_reckoning": (run.trace.times, run.trace.poses + grown * [2.0, -1.0, 0.1]),
        "course": None,
        "recovered": None,
        "error": None,
        "interrupted": False,
    }
    return Outcome(**{**fields, **changes})


def floor_log(run, *, other_frame=False) -> Log:
    truth = floor_run(poses=0.0).estimate.trajectory
    reference = Reference(
        times=truth.times, positions=truth.poses[:, :2], headings=truth.poses[:, 2], walls=run.reference.walls
    )
    if other_frame:
        turned = np.array([[0.0, -1.0], [1.0, 0.0]])
        reference = msgspec.structs.replace(
            reference,
            frame="other",
            positions=reference.positions @ turned.T + 5.0,
            headings=reference.headings + np.pi / 2,
            walls=(reference.walls.reshape(-1, 2) @ turned.T + 5.0).reshape(-1, 4),
        )
    return Log("floor", "made up", CONFIG, lambda skip: iter(()), (reference,))


def test_a_run_of_contours_is_saved_whole(tmp_path):
    run = floor_run()
    log, started = floor_log(run), datetime.now(UTC)
    metrics = save_run(tmp_path, outcome_of(run), log, CONFIG, started=started, command="kalmap run floor")
    assert names(tmp_path) == COMMON | CONTOURS | GRID | {"report.html"}
    assert {entry.name for entry in (tmp_path / "figures").iterdir()} == {
        f"{name}.png" for name in ("plan", "plan-close-up", "errors", "consistency", "timing")
    }
    assert metrics == results.read_metrics(tmp_path)
    assert metrics["crispness_mean_m"] < 0.03
    assert metrics["map_error_mean_m"] < 0.03
    assert (
        metrics["position_rmse_m"]
        < metrics["online_position_rmse_m"]
        < metrics["dead_reckoning_position_rmse_m"]
    )
    assert metrics["loop_error_m"] < 0.1
    assert metrics["loops_closed"] == 2
    page = check((tmp_path / "report.html").read_text())
    for words in (
        "Contour samples",
        "Crispness",
        "Map error",
        "Loop error",
        "across the contour",
        "dc-slasem",
    ):
        assert words in page.words
    assert "Landmarks" not in page.words
    cells, resolution, origin = serve(tmp_path)
    grid = occupancy_grid(run.estimate.sweeps(), max_range=REACH, clear_range=5.0)
    np.testing.assert_array_equal(cells, grid.cells)
    assert (resolution, origin) == (grid.resolution, [*grid.origin.tolist(), 0.0])
    assert len(read_map_file(tmp_path / "map.kalmap").estimate().contours) == len(run.estimate.contours)


def test_a_reference_in_a_frame_of_its_own_comes_to_the_same():
    run = floor_run()
    outcome = outcome_of(run)
    here, there = floor_log(run), floor_log(run, other_frame=True)
    one, two = judge(outcome, here, CONFIG), judge(outcome, there, CONFIG)
    assert (one["aligned"], two["aligned"]) == (False, True)
    for key in ("map_error_mean_m", "loop_error_m", "loop_error_deg"):
        assert two[key] == pytest.approx(one[key], abs=2e-3)
    walls = run_view(outcome, there, "m").reference.walls
    np.testing.assert_allclose(walls, run.reference.walls, atol=0.02)


def test_scans_too_far_apart_leave_the_rest_of_the_result(tmp_path):
    run = floor_run()
    far = Sweeps(np.array([[0.0, 0, 0], [9e6, 0, 0]]), (Scan(0.0, np.ones(1), np.zeros(1)),) * 2)
    run = msgspec.structs.replace(run, estimate=msgspec.structs.replace(run.estimate, sweeps=lambda: far))
    save_run(tmp_path, outcome_of(run), floor_log(run), CONFIG, started=datetime.now(UTC), command="x")
    assert names(tmp_path) == COMMON | CONTOURS | {"report.html"}
    assert "No map for Nav2 was written" in check((tmp_path / "report.html").read_text()).words


@pytest.mark.parametrize("sweeps", [None, lambda: Sweeps(np.zeros((0, 3)), ())])
def test_a_run_that_saw_nothing_is_saved_too(tmp_path, sweeps):
    run = floor_run()
    estimate = msgspec.structs.replace(
        run.estimate,
        contours=contours_of([]),
        sweeps=sweeps,
        trajectory=None,
        joint=lambda: (run.estimate.pose, run.estimate.covariance),
    )
    run = msgspec.structs.replace(run, estimate=estimate)
    log = Log("floor", "made up", CONFIG, lambda skip: iter(()))
    metrics = save_run(tmp_path, outcome_of(run), log, CONFIG, started=datetime.now(UTC), command="x")
    assert names(tmp_path) == COMMON | CONTOURS - {"trajectory-online.csv"} | {"report.html"}
    assert (metrics["contour_samples"], metrics["crispness_mean_m"]) == (0, None)
    assert "The map holds no contours" in check((tmp_path / "report.html").read_text()).words


def test_contours_stand_in_a_comparison(tmp_path):
    run = floor_run()
    log = floor_log(run)
    compared = [Compared(name, CONFIG, outcome_of(run), None, None) for name in ("slasem", "dc-slasem")]
    metrics = save_comparison(tmp_path, compared, log, started=datetime.now(UTC))
    assert set(metrics) == {"slasem", "dc-slasem"}
    assert (tmp_path / "figures" / "maps.png").exists()
    check((tmp_path / "report.html").read_text())
