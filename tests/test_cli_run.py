"""`kalmap run` and `kalmap demo`: every combination runs, and the result folder holds what it should."""

from __future__ import annotations

import csv
import json
from itertools import pairwise

import numpy as np
import pytest

from command import kalmap, kalmap_all_inside, kalmap_inside, manifest, times, write_log
from kalmap.data.audit import AUDIT
from kalmap.data.native_map import map_bytes, read_map_file
from kalmap.data.trajectory_files import read_trajectory_csv

FILES = {
    *("trajectory.tum", "trajectory.csv", "landmarks.csv", "landmarks.geojson"),
    *("map.kalmap", "metrics.json", "manifest.json"),
}
DRAWN = {"report.html", "figures"}
PICTURES = {"map.png", "errors.png", "consistency.png", "timing.png"}
METRICS = {
    *("steps", "frames", "sightings", "runtime_s", "step_ms_mean", "step_ms_p99", "landmarks"),
    *(
        "position_rmse_m",
        "heading_rmse_deg",
        "feature_rmse_m",
        "nees_mean",
        "nis_mean",
        "association_accuracy",
    ),
}
SHORT = ["--set", "world.laps=1"]
LIKELY = ["--association", "likelihood"]

# name -> (options, what the manifest's configuration must say)
VARIANTS = {
    "default": ([], {}),
    "again": ([], {}),
    "seed 2": (["--seed", "2"], {"seed": 2}),
    "ekf": (["--filter", "ekf", "--coordinates", "additive"], {"filter.coordinates": "additive"}),
    "cr-ukf": (["--filter", "cr-ukf", "--use", "sequential"], {"filter.use": "sequential"}),
    "cr-ckf": (["--filter", "cr-ckf", *LIKELY], {"association.method": "likelihood"}),
    "set": (["--set", "filter.name=ekf", "--set", "motion.sigma_speed=0.4"], {"motion.sigma_speed": 0.4}),
    "set and flag": (["--set", "filter.name=ekf", "--filter", "cr-ukf"], {"filter.name": "cr-ukf"}),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """All variants over one lap of the course, without figures: (answers, folder of each).

    The first as its own process, which what the others do in this one must equal.
    """
    root = tmp_path_factory.mktemp("variants")
    folders = {name: root / name.replace(" ", "-") for name in VARIANTS}
    calls = {
        name: ["run", "course-35", *SHORT, *options, "--no-figures", "--out", folders[name]]
        for name, (options, _) in VARIANTS.items()
    }
    first = kalmap(*calls.pop("default"))
    return {"default": first, **kalmap_all_inside(calls)}, folders


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_runs_and_says_what_it_did(runs, name):
    """Code 0, nothing on the error stream, all files, finite metrics, and the settings in the manifest."""
    answers, folders = runs
    assert (answers[name].code, answers[name].err) == (0, "")
    decided = {AUDIT} if LIKELY[1] in VARIANTS[name][0] else set()  # given identities decide nothing
    assert {path.name for path in folders[name].iterdir()} == FILES | decided
    said = manifest(folders[name])
    assert said["completed"] is True and said["error"] is None and said["skipped_total"] == 0
    for key, value in VARIANTS[name][1].items():
        place = said["config"]
        for step in key.split("."):
            place = place[step]
        assert place == value
    metrics = json.loads((folders[name] / "metrics.json").read_text())
    assert metrics.keys() >= METRICS
    assert metrics["landmarks"] >= 30 and 0 < metrics["position_rmse_m"] < 20
    assert (metrics["association_accuracy"] is None) == (LIKELY[1] not in VARIANTS[name][0])


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(runs):
    """trajectory.csv, landmarks.csv and map.kalmap of two runs with one seed are equal; with another they differ."""
    _, folders = runs
    for name in ("trajectory.csv", "landmarks.csv", "map.kalmap"):
        first, again, other = ((folders[k] / name).read_bytes() for k in ("default", "again", "seed 2"))
        assert first == again and first != other


def test_the_map_loads_back_exactly_and_is_the_landmarks(runs):
    """map.kalmap: written again it is the same bytes; its landmarks and blocks are those of landmarks.csv."""
    path = runs[1]["default"] / "map.kalmap"
    saved = read_map_file(path)
    assert map_bytes(saved.estimate(), saved.provenance) == path.read_bytes()
    rows = list(csv.DictReader((path.parent / "landmarks.csv").open()))
    landmarks = saved.estimate().landmarks
    table = np.array([[float(row[key]) for key in ("x", "y", "p_xx", "p_xy", "p_yy")] for row in rows])
    assert [int(row["id"]) for row in rows] == landmarks.ids.tolist()
    assert [int(row["sightings"]) for row in rows] == landmarks.sightings.tolist()
    assert np.array_equal(table[:, :2], landmarks.positions)
    assert np.array_equal(table[:, 2:], landmarks.covariances.reshape(-1, 4)[:, [0, 1, 3]])
    assert np.linalg.eigvalsh(saved.covariance())[0] > -1e-9
    points = json.loads((path.parent / "landmarks.geojson").read_text())["features"]
    assert [point["geometry"]["coordinates"] for point in points] == landmarks.positions.tolist()


def test_the_trajectory_is_the_same_in_both_files(runs):
    """trajectory.tum: eight columns, unit quaternions about z, times that go on; poses as in trajectory.csv."""
    folder = runs[1]["default"]
    table = np.loadtxt(folder / "trajectory.tum")
    exact = read_trajectory_csv(folder / "trajectory.csv")
    assert table.shape == (len(exact.times), 8)
    assert all(earlier < later for earlier, later in pairwise(table[:, 0]))
    assert np.allclose(table[:, 1:3], exact.poses[:, :2], rtol=1e-8) and not table[:, 3:6].any()
    assert np.allclose(np.hypot(table[:, 6], table[:, 7]), 1.0)
    turned = 2 * np.arctan2(table[:, 6], table[:, 7]) - exact.poses[:, 2]
    assert np.allclose(np.cos(turned), 1.0)
    assert (np.linalg.eigvalsh(exact.covariances)[:, 0] > -1e-12).all()


def test_quiet_says_nothing_and_figures_come_by_default_and_go_when_not_wanted(tmp_path):
    """`--quiet`: both streams empty. The page needs no network. `--no-figures` leaves no page of an older run."""
    folder = tmp_path / "result"
    line = ["run", "course-35", *SHORT, "--quiet", "--out", folder]
    assert kalmap_inside(*line) == (0, "", "")
    assert {path.name for path in folder.iterdir()} == FILES | DRAWN
    assert {path.name for path in (folder / "figures").iterdir()} == PICTURES
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (folder / "figures").iterdir())
    page = (folder / "report.html").read_text()
    assert 'src="http' not in page and 'href="http' not in page and "url(http" not in page
    assert kalmap_inside(*line, "--no-figures") == (0, "", "")
    assert not (folder / "report.html").exists() and not any((folder / "figures").iterdir())


def test_full_filters_run_on_a_small_log_and_agree_with_the_reduced(tmp_path):
    """ukf, cdkf and ckf by name and by --scope; by theory the full CDKF ends where the reduced one does."""
    log = write_log(tmp_path / "log")
    lines = {"cdkf": [], "cr-cdkf": [], "ukf": ["--scope", "full"], "ckf": []}
    calls = {
        name: ["run", log, "--filter", name, *more, "--no-figures", "--quiet", "--out", tmp_path / name]
        for name, more in lines.items()
    }
    calls["reduced"] = [*calls["cdkf"][:4], "--scope", "reduced", *calls["cdkf"][4:-1], tmp_path / "reduced"]
    assert set(kalmap_all_inside(calls).values()) == {(0, "", "")}
    ends = {name: read_map_file(tmp_path / name / "map.kalmap") for name in calls}
    for name in ("cr-cdkf", "reduced"):
        assert np.allclose(ends["cdkf"].mean, ends[name].mean, atol=1e-9)
        assert np.allclose(ends["cdkf"].packed, ends[name].packed, atol=1e-9)


def test_settings_come_from_files_pairs_and_flags_in_this_order(tmp_path):
    """TOML and JSON (also with a byte order mark) are read; --set goes over the file, a flag over both."""
    toml, coded = tmp_path / "a.toml", tmp_path / "b.json"
    toml.write_text('seed = 5\n[filter]\nname = "ekf"\ncoordinates = "additive"\n[world]\nlaps = 1\n')
    coded.write_bytes(b"\xef\xbb\xbf" + json.dumps({"seed": 5, "world": {"laps": 1}}).encode())
    line = ["run", "course-35", "--no-figures", "--quiet", "--config"]
    answers = kalmap_all_inside(
        {
            "toml": [
                *line,
                toml,
                "--set",
                "filter.coordinates=invariant",
                "--set",
                "seed=6",
                "--out",
                tmp_path / "1",
            ],
            "json": [*line, coded, "--set", "seed=6", "--seed", "7", "--out", tmp_path / "2"],
        }
    )
    assert set(answers.values()) == {(0, "", "")}
    first, second = manifest(tmp_path / "1"), manifest(tmp_path / "2")
    chosen = first["config"]["filter"]
    assert (chosen["name"], chosen["coordinates"], chosen["use"]) == ("ekf", "invariant", "joint")
    assert (first["seed"], second["seed"], second["source"]) == (6, 7, "world:course-35 seed:7")
    assert len(times(tmp_path / "1")) > 500


def test_the_demo_writes_a_result_and_says_where_the_page_is(tmp_path):
    """`kalmap demo` in an empty folder: the default result folder with everything in it."""
    answer = kalmap("demo", cwd=tmp_path)
    assert (answer.code, answer.err) == (0, "")
    assert "kalmap-demo/report.html" in answer.out and "35 landmarks" in answer.out
    assert {path.name for path in (tmp_path / "kalmap-demo").iterdir()} == FILES | DRAWN
