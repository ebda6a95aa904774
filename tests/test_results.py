"""The result folder and the native map file: exact round trips, refusals, nothing half written."""

from __future__ import annotations

import csv
import io
import json
import zipfile

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kalmap.data import results
from kalmap.data.native_map import map_bytes, read_map_file, write_map
from kalmap.data.saved_map import pack_lower, unpack_lower
from kalmap.data.trajectory_files import read_trajectory_csv
from kalmap.records import Estimate, EstimationError, KalmapError, Landmarks, LogError
from test_view_samples import empty_run, loop_run, manifest

FILES = {
    "trajectory.tum",
    "trajectory.csv",
    "landmarks.csv",
    "landmarks.geojson",
    "map.kalmap",
    "metrics.json",
    "manifest.json",
}
finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


@st.composite
def estimates(draw) -> Estimate:
    """Any finite mean, with a symmetric joint covariance of any finite numbers and a fair diagonal."""
    names = draw(st.lists(st.sampled_from(["steering_offset", "speed_scale"]), unique=True))
    count = draw(st.integers(0, 4))
    n = 3 + len(names) + 2 * count
    mean = draw(arrays(np.float64, n, elements=finite))
    lower = np.tril(draw(arrays(np.float64, (n, n), elements=finite)), -1)
    covariance = lower + lower.T + np.diag(draw(arrays(np.float64, n, elements=st.floats(0, 1e300))))
    rows = 3 + len(names) + 2 * np.arange(count)[:, None] + np.arange(2)
    landmarks = Landmarks(
        ids=draw(arrays(np.int64, count)),
        positions=mean[rows],
        covariances=covariance[rows[:, :, None], rows[:, None, :]],
        sightings=draw(arrays(np.int64, count)),
        existence=draw(arrays(np.float64, count, elements=st.floats(0, 1))),
    )
    deviations = np.sqrt(np.diagonal(covariance))
    biases = {name: (float(mean[3 + k]), float(deviations[3 + k])) for k, name in enumerate(names)}
    coordinates = draw(st.sampled_from(["additive", "invariant"]))
    pose, spread = mean[:3], covariance[:3, :3]
    return Estimate(draw(finite), pose, spread, landmarks, biases, lambda: (mean, covariance), coordinates)


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def landmark_arrays(landmarks: Landmarks) -> list[np.ndarray]:
    return [getattr(landmarks, name) for name in landmarks.__struct_fields__]


@given(estimates())
@settings(max_examples=60, deadline=None)
def test_map_comes_back_bit_for_bit(tmp_path_factory, estimate):
    path = tmp_path_factory.getbasetemp() / "round.kalmap"
    write_map(path, estimate, {"log": "x"})
    saved = read_map_file(path)
    back = saved.estimate()
    assert (back.time, back.coordinates, back.biases) == (
        estimate.time,
        estimate.coordinates,
        estimate.biases,
    )
    for written, read in zip(estimate.joint(), back.joint(), strict=True):
        assert same_bits(written, read)
    assert same_bits(saved.covariance(), estimate.joint()[1])
    assert same_bits(np.ascontiguousarray(estimate.pose), back.pose)
    assert same_bits(np.ascontiguousarray(estimate.covariance), back.covariance)
    for written, read in zip(
        landmark_arrays(estimate.landmarks), landmark_arrays(back.landmarks), strict=True
    ):
        assert same_bits(written, read)
    assert saved.provenance == {"log": "x"}
    assert map_bytes(estimate) == map_bytes(estimate)


def test_packing_is_numpys_lower_triangle():
    matrix = np.random.default_rng(1).standard_normal((7, 7))
    matrix += matrix.T
    packed = pack_lower(matrix)
    assert same_bits(packed, matrix[np.tril_indices(7)])
    assert same_bits(unpack_lower(packed, 7), matrix)


def test_a_returned_joint_is_the_readers_own(tmp_path):
    write_map(tmp_path / "m.kalmap", loop_run(3).estimate)
    back = read_map_file(tmp_path / "m.kalmap").estimate()
    back.joint()[1][:] = 0
    assert back.joint()[1].any()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_truncated_map_is_named(tmp_path, share):
    content = map_bytes(loop_run(5).estimate)
    path = tmp_path / "cut.kalmap"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(LogError, match=r"cut\.kalmap"):
        read_map_file(path)


def test_every_flipped_byte_is_noticed_or_harmless(tmp_path):
    estimate = loop_run(2).estimate
    content = map_bytes(estimate)
    path = tmp_path / "flip.kalmap"
    for place in range(0, len(content), 7):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        try:
            back = read_map_file(path).estimate()
        except LogError:
            continue
        for written, read in zip(estimate.joint(), back.joint(), strict=True):
            assert same_bits(written, read)


def remade(path, header=None, drop=(), replace=None):
    """The map file with another header, without some members, or with other arrays."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if header is not None:
        members["header.json"] = json.dumps(json.loads(members["header.json"]) | header).encode()
    for name, values in (replace or {}).items():
        stream = io.BytesIO()
        np.lib.format.write_array(stream, values)
        members[name] = stream.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if name not in drop:
                archive.writestr(name, content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"header": {"format": "kalmap-map/3"}}, "newer kalmap"),
        ({"header": {"format": "other/1"}}, "unknown format 'other/1'"),
        ({"header": {"format": 7}}, "unknown format"),
        ({"header": {"coordinates": "polar"}}, "unknown coordinates"),
        ({"header": {"time": None}}, "field time"),
        ({"header": {"biases": ["speed_scale"]}}, "expected 14 numbers"),
        ({"header": {"biases": "no"}}, "list of names"),
        ({"header": {"provenance": [1]}}, "field provenance"),
        ({"drop": ("header.json",)}, "not a kalmap map"),
        ({"drop": ("mean.npy",)}, "field mean"),
        ({"replace": {"mean.npy": np.zeros(13, dtype=np.float32)}}, "expected a row of <f8"),
        ({"replace": {"covariance.npy": np.zeros(4)}}, "field covariance"),
        ({"replace": {"covariance.npy": np.full(91, np.nan)}}, "not finite"),
        ({"replace": {"mean.npy": np.array([None] * 13, dtype=object)}}, "damaged"),
    ],
)
def test_wrong_maps_are_named(tmp_path, change, message):
    path = tmp_path / "m.kalmap"
    write_map(path, loop_run(5).estimate)
    remade(path, **change)
    with pytest.raises(LogError, match=message):
        read_map_file(path)


def test_what_is_no_map_is_named(tmp_path):
    (tmp_path / "text").write_text("hello")
    for name, message in (("text", "not a kalmap map"), ("absent", "no such file"), (".", "cannot be read")):
        with pytest.raises(LogError, match=message):
            read_map_file(tmp_path / name)


def test_bad_joints_are_refused_and_leave_the_old_file(tmp_path):
    estimate = loop_run(2).estimate
    path = tmp_path / "m.kalmap"
    write_map(path, estimate)
    before = path.read_bytes()
    mean, covariance = estimate.joint()
    skew = covariance.copy()
    skew[0, 1] += 1.0
    bad = {
        "not finite": (mean * np.nan, covariance),
        "not symmetric": (mean, skew),
        "need 7 numbers": (mean[:-1], covariance),
    }
    for message, joint in bad.items():
        with pytest.raises(EstimationError, match=message):
            write_map(path, msgspec.structs.replace(estimate, joint=lambda joint=joint: joint))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.kalmap"]


def test_a_failed_write_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("kalmap.data.files.os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_map(tmp_path / "m.kalmap", loop_run(1).estimate)
    assert not list(tmp_path.iterdir())


def write(folder, run, **changes):
    fields = {"metrics": {}, "manifest": manifest()} | changes
    return results.write_result(folder, estimate=run.estimate, trace=run.trace, **fields)


def test_result_holds_all_files_and_reads_back(tmp_path):
    run = loop_run()
    metrics = {
        "position_rmse_m": np.float64(0.5),
        "nees": float("nan"),
        "deep": {"list": np.array([1.0, np.inf])},
    }
    paths = write(tmp_path / "a" / "b", run, metrics=metrics)
    assert set(paths) == FILES == {entry.name for entry in (tmp_path / "a" / "b").iterdir()}
    assert all(
        "nan" not in path.read_bytes().decode(errors="ignore").lower()
        for path in paths.values()
        if path.suffix != ".kalmap"
    )
    assert results.read_metrics(tmp_path / "a" / "b") == {
        "position_rmse_m": 0.5,
        "nees": None,
        "deep": {"list": [1.0, None]},
    }
    back = read_trajectory_csv(paths["trajectory.csv"])
    for name in ("times", "poses", "covariances"):
        assert same_bits(getattr(back, name), getattr(run.trace, name))
    assert results.read_manifest(tmp_path / "a" / "b").completed
    saved = read_map_file(paths["map.kalmap"])
    assert saved.provenance["kalmap"] == "0.1.0"
    assert saved.provenance["config"]["motion"]["wheelbase"] == 4.0


def test_landmark_files(tmp_path):
    run = loop_run(4)
    run.estimate.landmarks.existence[1] = np.nan
    paths = write(tmp_path, run)
    rows = list(csv.DictReader(paths["landmarks.csv"].open()))
    assert [float(row["p_xy"]) for row in rows] == run.estimate.landmarks.covariances[:, 0, 1].tolist()
    assert [row["existence"] for row in rows] == ["1.0", "", "1.0", "1.0"]
    collection = json.loads(paths["landmarks.geojson"].read_text())
    assert collection["type"] == "FeatureCollection"
    assert collection["coordinates_frame"] == "local metres"
    feature = collection["features"][1]
    assert feature["geometry"] == {
        "type": "Point",
        "coordinates": run.estimate.landmarks.positions[1].tolist(),
    }
    assert feature["properties"]["existence"] is None
    assert feature["properties"]["covariance"] == run.estimate.landmarks.covariances[1].tolist()


@pytest.mark.parametrize("frames", [0, 3])
def test_empty_map_and_no_frames(tmp_path, frames):
    run = empty_run(frames)
    paths = write(tmp_path, run)
    assert len(read_trajectory_csv(paths["trajectory.csv"]).times) == frames
    assert json.loads(paths["landmarks.geojson"].read_text())["features"] == []
    assert len(read_map_file(paths["map.kalmap"]).estimate().landmarks) == 0


def test_evo_reads_the_trajectory(tmp_path):
    files = pytest.importorskip("evo.tools.file_interface")
    run = loop_run()
    trajectory = files.read_tum_trajectory_file(write(tmp_path, run)["trajectory.tum"])
    assert trajectory.check()[0]
    np.testing.assert_allclose(trajectory.timestamps, run.trace.times, atol=1e-9)
    np.testing.assert_allclose(trajectory.positions_xyz[:, :2], run.trace.poses[:, :2], rtol=1e-8)
    w, z = trajectory.orientations_quat_wxyz[:, 0], trajectory.orientations_quat_wxyz[:, 3]
    turn = 2 * np.arctan2(z, w) - run.trace.poses[:, 2]
    np.testing.assert_allclose(np.sin(turn), 0, atol=1e-8)
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-8)


def test_strange_folders_are_refused(tmp_path):
    run = loop_run(1)
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(KalmapError, match="no kalmap result"):
        write(tmp_path, run)
    (tmp_path / "manifest.json").write_text('{"format": "other/1"}')
    with pytest.raises(KalmapError, match="no kalmap result"):
        write(tmp_path, run)
    with pytest.raises(KalmapError, match="not a folder"):
        write(tmp_path / "thesis.txt", run)
    assert {entry.name for entry in tmp_path.iterdir()} == {"thesis.txt", "manifest.json"}


def test_an_earlier_result_is_overwritten(tmp_path):
    write(tmp_path, loop_run(3), metrics={"a": 1})
    write(tmp_path, loop_run(2), metrics={"b": 2})
    assert results.read_metrics(tmp_path) == {"b": 2}
    assert len(read_map_file(tmp_path / "map.kalmap").landmark_ids) == 2


def test_a_cut_off_write_is_told_by_the_manifest(tmp_path, monkeypatch):
    real = results.write_atomically

    def fail(path, content):
        if path.name == "landmarks.csv":
            raise KeyboardInterrupt
        real(path, content)

    monkeypatch.setattr(results, "write_atomically", fail)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, loop_run(1))
    told = results.read_manifest(tmp_path)
    assert not told.completed
    assert "cut off" in told.error
    monkeypatch.undo()
    write(tmp_path, loop_run(1))
    assert results.read_manifest(tmp_path).completed


def test_what_is_not_finite_is_named_before_anything_is_written(tmp_path):
    run = loop_run(2)
    run.trace.poses[7, 1] = np.nan
    with pytest.raises(EstimationError, match="pose at trace row 8"):
        write(tmp_path / "r", run)
    run = loop_run(2)
    run.estimate.landmarks.covariances[1, 0, 0] = np.inf
    with pytest.raises(EstimationError, match="covariance of landmark 101"):
        write(tmp_path / "r", run)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the columns"),
        ("a,b\n", "record 1"),
        ("{header}\n1,2\n", "record 2: expected 10 fields, found 2"),
        ("{header}\n1,2,3,x,5,6,7,8,9,10\n", "record 2, field heading"),
        ("{header}\n1,2,nan,4,5,6,7,8,9,10\n", "record 2, field y"),
    ],
)
def test_bad_trajectories_are_named(tmp_path, text, message):
    path = tmp_path / "t.csv"
    path.write_text(text.replace("{header}", "time,x,y,heading,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt"))
    with pytest.raises(LogError, match=message):
        read_trajectory_csv(path)


def test_bad_metrics_and_manifests_are_named(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        results.read_metrics(tmp_path)
    (tmp_path / "metrics.json").write_bytes(b"\xff\xfe")
    with pytest.raises(LogError, match="not a text file"):
        results.read_metrics(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(LogError, match="not what kalmap writes"):
        results.read_manifest(tmp_path)
