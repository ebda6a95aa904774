"""Native maps of contours: exact round trips with and without a joint covariance, refusals, damage."""

from __future__ import annotations

import io
import json
import zipfile

import msgspec
import numpy as np
import pytest

from contour_samples import contours_of, floor_run
from damage import cuts, flipped, refused_cuts
from kalmap.data.native_map import map_bytes, read_map_file, write_map
from kalmap.records import Estimate, EstimationError, LogError
from test_results import remade, same_bits


def small(count=5, biases=("speed_scale",), joint=True, seed=2) -> Estimate:
    """A map of `count` samples in two runs, with a joint covariance in which everything hangs together, or without."""
    rng = np.random.default_rng(seed)
    first = 3 + len(biases)
    n = first + 2 * count
    half = rng.standard_normal((n, n))
    covariance, mean = half @ half.T, rng.standard_normal(n)
    covariance = 0.5 * (covariance + covariance.T)
    rows = first + 2 * np.arange(count)[:, None] + np.arange(2)
    strands = [mean[rows][: count // 2], mean[rows][count // 2 :]]
    contours = msgspec.structs.replace(
        contours_of(strands), covariances=covariance[rows[:, :, None], rows[:, None, :]]
    )

    def too_large():
        raise EstimationError("2,001 samples are too many for a joint covariance")

    deviations = np.sqrt(np.diagonal(covariance))
    return msgspec.structs.replace(
        floor_run().estimate,
        pose=mean[:3],
        covariance=covariance[:3, :3],
        biases={name: (float(mean[3 + k]), float(deviations[3 + k])) for k, name in enumerate(biases)},
        contours=contours,
        joint=(lambda: (mean, covariance)) if joint else too_large,
    )


def fields(contours):
    return [np.ascontiguousarray(getattr(contours, name)) for name in contours.__struct_fields__]


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("count", [0, 1, 5, 40])
@pytest.mark.parametrize("biases", [(), ("speed_scale", "steering_offset")])
def test_contours_come_back_bit_for_bit(tmp_path, joint, count, biases):
    estimate = small(count, biases, joint)
    write_map(tmp_path / "m.kalmap", estimate, {"log": "floor"})
    saved = read_map_file(tmp_path / "m.kalmap")
    back = saved.estimate()
    assert (back.time, back.coordinates) == (estimate.time, estimate.coordinates)
    for written, read in zip(fields(estimate.contours), fields(back.contours), strict=True):
        assert same_bits(written, read)
    assert same_bits(estimate.pose, back.pose)
    assert same_bits(np.ascontiguousarray(estimate.covariance), np.ascontiguousarray(back.covariance))
    assert len(back.landmarks) == 0
    assert list(back.biases) == list(biases)
    for name, (value, deviation) in estimate.biases.items():
        assert back.biases[name] == (value, pytest.approx(deviation, rel=1e-15))
    assert saved.header["format"] == "kalmap-map/2"
    assert saved.header["contours"] == count
    assert saved.has_joint == joint
    if joint:
        for written, read in zip(estimate.joint(), back.joint(), strict=True):
            assert same_bits(written, read)
    else:
        assert "too many for a joint" in saved.header["without_joint"]
        for ask in (back.joint, saved.covariance):
            with pytest.raises(EstimationError, match="without its joint covariance"):
                ask()
    assert map_bytes(estimate) == map_bytes(estimate)


def test_without_a_joint_the_file_stays_small():
    whole, blocks = (len(map_bytes(small(200, joint=joint))) for joint in (True, False))
    assert whole > 8 * 403 * 404 // 2
    assert blocks < 20_000


def test_a_restored_maps_arrays_are_the_readers_own(tmp_path):
    write_map(tmp_path / "m.kalmap", small())
    saved = read_map_file(tmp_path / "m.kalmap")
    saved.estimate().contours.positions[:] = 0.0
    saved.estimate().joint()[1][:] = 0.0
    assert saved.estimate().contours.positions.all()
    assert saved.estimate().joint()[1].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"header": {"format": "kalmap-map/3"}}, "newer kalmap"),
        ({"header": {"covariance": "diagonal"}}, "unknown layout 'diagonal'"),
        ({"header": {"biases": []}}, "field mean: expected 13 numbers"),
        ({"drop": ("contour_runs.npy",)}, "field contour_runs: missing"),
        ({"replace": {"contour_runs.npy": np.zeros(4, dtype=np.int64)}}, "field mean"),
        ({"replace": {"contour_sightings.npy": np.zeros(4, dtype=np.int64)}}, "field contour_sightings"),
        ({"replace": {"contour_runs.npy": np.zeros(5)}}, "expected a row of <i8"),
        ({"replace": {"contour_normals.npy": np.zeros(9)}}, "expected 10 numbers"),
        ({"replace": {"contour_normals.npy": np.full(10, np.nan)}}, "contour_normals: not finite"),
        ({"replace": {"landmark_ids.npy": np.zeros(1, dtype=np.int64)}}, "field mean"),
    ],
)
@pytest.mark.parametrize("joint", [True, False])
def test_wrong_maps_are_named(tmp_path, change, message, joint):
    path = tmp_path / "m.kalmap"
    write_map(path, small(joint=joint))
    remade(path, **change)
    with pytest.raises(LogError, match=message) as caught:
        read_map_file(path)
    assert caught.value.file == path


def test_a_file_of_blocks_is_not_taken_for_a_joint(tmp_path):
    path = tmp_path / "m.kalmap"
    write_map(path, small(joint=False))
    with zipfile.ZipFile(path) as archive:
        told = json.loads(archive.read("header.json"))["covariance"]
        packed = np.load(io.BytesIO(archive.read("covariance.npy")))
    assert "xx, xy, yy of each" in told
    assert len(packed) == 4 * 5 // 2 + 3 * 5
    remade(path, header={"covariance": "lower triangle, row by row"})
    with pytest.raises(LogError, match="field covariance: expected 105 numbers"):
        read_map_file(path)


def said(path):
    """All that a map file says, as bytes."""
    saved = read_map_file(path)
    kept = [getattr(saved, name) for name in saved.__struct_fields__]
    return [value.tobytes() if isinstance(value, np.ndarray) else repr(value) for value in kept]


@pytest.mark.parametrize("joint", [True, False])
def test_damage_is_noticed_or_harmless(tmp_path, joint):
    content, path = map_bytes(small(joint=joint)), tmp_path / "m.kalmap"
    found = flipped(content, path, said, 5)
    assert not found.believed
    assert len(found.refused) > len(found.harmless) / 2
    lengths = cuts(content, 97)
    assert refused_cuts(content, path, read_map_file, lengths) == lengths


def test_what_does_not_fit_is_refused():
    estimate = small()
    mean, covariance = estimate.joint()
    moved = msgspec.structs.replace(estimate.contours, positions=estimate.contours.positions + 0.1)
    slanted = msgspec.structs.replace(estimate.contours, normals=np.full((5, 2), np.inf))
    bad = {
        "not where its joint mean has them": {"contours": moved},
        "a normal is not finite": {"contours": slanted},
        "need 14 numbers": {"joint": lambda: (mean[:-1], covariance)},
        "not finite": {"joint": lambda: (mean * np.nan, covariance)},
    }
    for message, change in bad.items():
        with pytest.raises(EstimationError, match=message):
            map_bytes(msgspec.structs.replace(estimate, **change))
    without = small(joint=False)
    lost = msgspec.structs.replace(without.contours, positions=np.full((5, 2), np.inf))
    for change in ({"pose": np.full(3, np.nan)}, {"contours": lost}):
        with pytest.raises(EstimationError, match="not finite"):
            map_bytes(msgspec.structs.replace(without, **change))
