"""`kalmap run` and `compare` on raw scans: whole result folders, bad logs, interruptions, options that do not fit."""

from __future__ import annotations

import json
import signal
import time

import numpy as np
import pytest

from command import kalmap_inside, manifest, start, times
from kalmap.records import Odometry, Scan
from laser_files import flaser, odometry, scan, still, write, write_bag

WRITTEN = ["map.pgm", "map.yaml", "contours.csv", "contours.geojson", "trajectory.tum", "trajectory.csv"]
WRITTEN += ["map.kalmap", "metrics.json", "manifest.json", "report.html", "figures/plan.png"]
SCANS = 60


def finished(folder, figures=True):
    """The metrics of a complete folder, in none of whose tables a NaN stands."""
    for name in WRITTEN:
        if figures or not name.startswith(("report", "figures")):
            assert (folder / name).stat().st_size > 0, name
    for name in ("contours.csv", "trajectory.tum", "trajectory.csv", "contours.geojson", "metrics.json"):
        text = (folder / name).read_text().lower()
        assert "nan" not in text and "inf" not in text.replace("info", ""), name
    assert times(folder) == sorted(times(folder))
    return json.loads((folder / "metrics.json").read_text())


def poses_of(log, count=SCANS):
    """Times, poses by the odometry, and scans."""
    from kalmap.geometry.se2 import compose

    pose, rows = np.zeros(3), []
    for event in log.open(None):
        if isinstance(event, Odometry):
            for step in event.values:
                pose = compose(pose, step)
        elif isinstance(event, Scan):
            rows.append((100.0 + event.time, pose, event))
        if len(rows) == count:
            break
    return rows


@pytest.fixture(scope="module")
def rows():
    """A drive with one beam a degree, as a CARMEN log of 181 beams has it."""
    from contour_rooms import block_world
    from kalmap.simulate import simulate
    from kalmap.simulate.disturb_scans import with_beams

    return poses_of(with_beams(simulate(block_world(mount_x=0.0), 1), 239))


def lines_of(rows):
    """As CARMEN lines: the beams from -90 to 90 degrees."""
    lines = []
    for now, pose, event in rows:
        ahead = np.linspace(-np.pi / 2, np.pi / 2, 181)
        order = np.argsort(event.bearings)
        ranges = np.interp(ahead, event.bearings[order], np.minimum(event.ranges, 81.0)[order])
        lines.append(flaser(np.round(ranges, 2), pose, round(now, 6)))
    return lines


def messages_of(rows, topic="/scan", **changes):
    """As the messages of a bag; changes: of the scan's data."""
    found = []
    for now, pose, event in rows:
        found.append(odometry(now - 0.01, pose))
        step = np.deg2rad(239.765625) / (len(event.ranges) - 1)
        data = {"start": float(event.bearings.min()), "step": step, "low": 0.02, "high": 5.6} | changes
        found.append(scan(now - 0.02, event.ranges, topic=topic, **data))
    found.append(odometry(rows[-1][0] + 0.1, rows[-1][1]))
    return found


@pytest.fixture(scope="module")
def answers(rows, tmp_path_factory):
    """Everything, one after the other in this process."""
    root = tmp_path_factory.mktemp("contours")
    lines, messages = lines_of(rows), messages_of(rows)
    rear = messages_of(rows[:20], topic="/rear")[1::2]
    jumped = [m._replace(stamp=m.stamp + (0.0 if k < 60 else -7.0)) for k, m in enumerate(messages)]
    spoilt = list(lines)
    spoilt[10] = spoilt[10][: len(spoilt[10]) // 2]
    spoilt[20] = spoilt[20].replace("FLASER 181", "FLASER 999")
    logs = {
        "carmen": write(root / "hall.log", lines),
        "cut": write(root / "cut.log", [*lines[:-1], lines[-1][:400]], end=""),
        "spoilt": write(root / "spoilt.log", spoilt),
        "still": write(
            root / "still.log", [flaser(np.full(181, 2.0), (0, 0, 0), float(t)) for t in range(9)]
        ),
        "bag": write_bag(root, "bag", still(messages), "one"),
        "sqlite": write_bag(root, "sqlite3", still(messages), "two"),
        "mcap": write_bag(root, "mcap", still([*messages, *rear]), "lasers"),
        "jump": write_bag(root, "bag", still(jumped), "jump"),
        "blind": write_bag(root, "bag", still(messages[::2]), "blind"),
        "lost": write_bag(root, "bag", messages[1::2], "lost"),
        "upside": write_bag(root, "bag", still(messages, turn=(1.0, 0.0, 0.0, 0.0)), "upside"),
    }
    quick = ["--quiet", "--no-figures", "--out"]
    calls = {
        **{name: ["run", logs[name], "--out", root / f"out-{name}"] for name in ("carmen", "bag")},
        **{
            name: ["run", logs[name], *quick, root / f"out-{name}"]
            for name in ("cut", "spoilt", "still", "sqlite", "jump", "blind", "lost", "upside")
        },
        "mcap": ["run", logs["mcap"], "--no-figures", "--out", root / "out-mcap"],
        "rear": ["run", logs["mcap"], "--scan-topic", "/rear", *quick, root / "out-rear"],
        "tolerant": ["run", logs["spoilt"], "--tolerant", "--out", root / "out-tolerant"],
        "slasem": ["run", logs["carmen"], "--method", "slasem", *quick, root / "out-slasem"],
        "ekf": ["run", logs["carmen"], "--filter", "ekf", "--coordinates", "additive", *quick, root / "out-ekf"],
        "landmarks": ["run", logs["carmen"], "--method", "ekf", *quick, root / "none"],
        "sets": ["run", logs["carmen"], "--method", "pmb", *quick, root / "none"],
        "jcbb": ["run", logs["carmen"], "--association", "jcbb", *quick, root / "none"],
        "detector": ["run", logs["carmen"], "--detector", "trees", "--association", "jcbb", *quick, root / "out-trees"],
        "full": ["run", logs["carmen"], "--scope", "full", *quick, root / "none"],
        "both": ["run", logs["carmen"], "--method", "slasem", "--association", "jcbb", *quick, root / "none"],
        "course": ["run", "course-35", "--method", "dc-slasem", *quick, root / "out-course"],
        "compare": ["compare", logs["carmen"], "--methods", "slasem,dc-slasem:ekf", "--out", root / "out-compare"],
        "compare ekf": ["compare", logs["carmen"], "--methods", "slasem,ekf", "--out", root / "none"],
        "compare odd": ["compare", logs["carmen"], "--methods", "slasem:jcbb", "--out", root / "none"],
    }  # fmt: skip
    return {name: kalmap_inside(*words) for name, words in calls.items()}, root


@pytest.mark.parametrize("name", ["carmen", "bag"])
def test_a_log_ends_with_a_whole_folder(answers, name):
    found, root = answers
    assert found[name].code == 0, found[name].err
    metrics = finished(root / f"out-{name}")
    said = manifest(root / f"out-{name}")
    assert said["completed"] and said["config"]["contour"]["method"] == "dc-slasem"
    assert metrics["contour_samples"] > 30 and metrics["skipped"] == 0
    assert metrics["crispness_median_m"] < 0.05 and metrics["local_maps_loose"] == 0
    assert (
        "contour samples" in found[name].out and "Contours" in (root / f"out-{name}/report.html").read_text()
    )


@pytest.mark.parametrize("name", ["sqlite", "slasem", "ekf", "upside"])
def test_every_kind_and_method_runs(answers, name):
    found, root = answers
    assert found[name] == (0, "", "")
    metrics = finished(root / f"out-{name}", figures=False)
    config = manifest(root / f"out-{name}")["config"]
    assert metrics["contour_samples"] > 30
    assert config["contour"]["method"] == ("slasem" if name == "slasem" else "dc-slasem")
    if name == "ekf":
        assert (config["filter"]["name"], config["filter"]["coordinates"]) == ("ekf", "additive")


def test_of_two_lasers_the_default_is_named_and_both_can_be_read(answers):
    found, root = answers
    assert found["mcap"].code == 0 and "/scan" in found["mcap"].err and "/rear" in found["mcap"].err
    assert found["rear"] == (0, "", "")
    front, rear = (finished(root / f"out-{name}", figures=False) for name in ("mcap", "rear"))
    assert len(times(root / "out-rear")) < len(times(root / "out-mcap"))
    assert front["contour_samples"] > 30 and rear["contour_samples"] > 10


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("blind", "no laser scans"),
        ("lost", "no odometry"),
        ("landmarks", "--detector reflectors or trees"),
        ("sets", "--method dc-slasem"),
        ("jcbb", "the log holds raw scans and no landmarks"),
        ("full", "filter.scope"),
        ("compare ekf", "--method dc-slasem"),
        ("compare odd", "unknown suffix 'jcbb'; known are :additive, :invariant, :ekf"),
    ],
)
def test_what_cannot_be_is_one_line_and_no_folder(answers, name, words):
    found, root = answers
    assert found[name].code == 2 and found[name].out == "" and words in found[name].error
    assert not (root / "none").exists()


def test_options_of_landmarks_mean_nothing_to_contours(answers):
    found, _ = answers
    assert found["both"].code == 2 and "means nothing to slasem" in found["both"].err
    assert "Traceback" not in found["both"].err


def test_a_log_of_landmarks_is_none_of_scans(answers):
    found, root = answers
    assert (
        found["course"].code == 2 and "is of landmarks, and the map is of contours" in found["course"].error
    )
    assert manifest(root / "out-course")["completed"] is False


def test_with_a_detector_landmarks_are_looked_for(answers):
    found, root = answers
    assert found["detector"] == (0, "", "")
    assert manifest(root / "out-trees")["config"]["contour"]["method"] is None


def test_a_line_cut_short_ends_the_run_and_keeps_what_came_before(answers):
    found, root = answers
    for name, record in (("cut", SCANS), ("spoilt", 11)):
        assert found[name].code == 2 and f"record {record}" in found[name].error
        said = manifest(root / f"out-{name}")
        assert said["completed"] is False and f"record {record}" in said["error"]
        assert finished(root / f"out-{name}", figures=False)["contour_samples"] > 10
        assert len(times(root / f"out-{name}")) == record - 1


def test_a_tolerant_run_counts_what_it_skips(answers):
    found, root = answers
    assert found["tolerant"].code == 0
    said, metrics = manifest(root / "out-tolerant"), finished(root / "out-tolerant")
    assert sorted(one["record"] for one in said["skipped"]) == [11, 21]
    assert metrics["skipped"] == said["skipped_total"] == 2
    assert "Bad records skipped: 2." in (root / "out-tolerant/report.html").read_text()


def test_a_clock_that_jumps_back_is_named_or_put_right(answers):
    found, root = answers
    assert found["jump"].code in (0, 2) and "Traceback" not in found["jump"].err
    metrics = finished(root / "out-jump", figures=False)
    assert metrics["contour_samples"] > 10


def test_a_robot_that_never_moves_has_a_map(answers):
    found, root = answers
    assert found["still"] == (0, "", "")
    metrics = finished(root / "out-still", figures=False)
    assert metrics["contour_samples"] > 5 and metrics["local_maps"] == 1


def test_methods_of_contours_side_by_side(answers):
    found, root = answers
    assert found["compare"].code == 0, found["compare"].err
    metrics = json.loads((root / "out-compare/metrics.json").read_text())
    assert sorted(metrics) == ["dc-slasem:ekf", "slasem"]
    assert all(each["contour_samples"] > 30 for each in metrics.values())
    said = manifest(root / "out-compare")["config"]
    assert said["dc-slasem:ekf"]["filter"]["name"] == "ekf"
    assert (root / "out-compare/report.html").exists()


def test_ctrl_c_keeps_what_was_computed(tmp_path):
    """Code 130, a folder up to there."""
    out = tmp_path / "out"
    process = start("run", "rooms-60", "--no-figures", "--out", out)  # takes a minute, if nobody stops it
    while not out.exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(3.0)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=100)
    assert process.returncode == 130 and "interrupted; what was computed before is written" in error
    metrics, said = finished(out, figures=False), manifest(out)
    assert said["interrupted"] and not said["completed"] and metrics["contour_samples"] > 0


def test_a_bare_corridor_says_what_it_does_not_know(tmp_path):
    out = tmp_path / "out"
    answer = kalmap_inside("run", "corridor", "--set", "world.speed=2.0", "--out", out)
    assert answer.code == 0
    metrics = finished(out)
    assert metrics["local_maps_loose"] == metrics["local_maps"] > 3
    words = "along one direction no better than its odometry does"
    assert words in answer.err and words in (out / "report.html").read_text()


def test_a_covered_scanner_and_torn_scans_are_told_where_people_look(tmp_path):
    """On the error stream and in the report: the beams left out, and that the ranges lie on no contour."""
    from kalmap.simulate import simulate, with_bad_ranges, with_cover, world_by_name

    spoilt = with_cover(with_bad_ranges(simulate(world_by_name("office"), 2), 0.65, 2), 70.0, 85.0, 0.3, 1)
    lines = [
        flaser(np.where(np.isfinite(event.ranges), event.ranges, 0.0), pose, round(now, 6))
        for now, pose, event in poses_of(spoilt, 200)
    ]
    out = tmp_path / "out"
    answer = kalmap_inside("run", write(tmp_path / "spoilt.log", lines), "--out", out)
    page, metrics = (out / "report.html").read_text(), finished(out)
    assert answer.code == 0 and metrics["ranges_on_contours_share"] < 0.75
    for words in (
        "16 of 180 beams (at 70 to 85 deg) stay at 0.30 to 0.30 m",
        "of the ranges lie on no contour",
    ):
        assert words in answer.err and words in page
