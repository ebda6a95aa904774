"""Two finished maps, how they lie unknown: found, joined, or refused."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest

from command import kalmap_inside
from kalmap.data.native_map import read_map_file, write_map
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import slam_from_config
from kalmap.slam.submaps.local_map import local_map
from kalmap.slam.submaps.matching import NoMatchError, match_by_id, match_by_place


def _part(name, seed, first, last, start):
    """The map of a part of a drive, begun at `start` in a frame of its own, and T_world_frame."""
    log = simulate(world_by_name(name), seed)
    events = list(log.open(None))
    first, last = (2 * int(share * len(events) / 2) for share in (first, last))
    reference = log.references[0]
    row = int(np.searchsorted(reference.times, events[first - 1].time - 1e-9)) if first else 0
    begun = np.array([*reference.positions[row], reference.headings[row]])
    own = msgspec.structs.replace(log, start=np.array(start), start_covariance=np.zeros((3, 3)))
    slam = slam_from_config(log.defaults, own)
    for event in events[first:last]:
        slam.step(event)
    return slam.estimate(), compose(begun, inverse(np.array(start)))


def _local(estimate, add=0):
    mean, covariance = estimate.joint()
    return local_map(mean, covariance, estimate.landmarks.ids + add)


@pytest.fixture(scope="module")
def halves():
    return [
        _part("lawn-300", 1, 0.0, 0.55, (0.0, 0.0, 1.0)),
        _part("lawn-300", 7, 0.45, 1.0, (5.0, -3.0, 2.0)),
    ]


def test_two_halves_of_a_lawn_find_each_other(halves):
    (first, T_world_a), (second, T_world_b) = halves
    matched = match_by_place(_local(first), _local(second, 1000))
    a, b = first.landmarks.ids[matched.pairs[:, 0]], second.landmarks.ids[matched.pairs[:, 1]]
    assert (a == b).all()  # every pair is right, and hardly one is missed
    assert len(matched.pairs) > 0.9 * len(np.intersect1d(first.landmarks.ids, second.landmarks.ids))
    error = matched.T_first_second - compose(inverse(T_world_a), T_world_b)
    error[2] = wrap(error[2])
    assert error @ np.linalg.solve(matched.covariance, error) < 21.1  # chi-square, 3 numbers, 99.99 %
    by_id = match_by_id(_local(first), _local(second))
    np.testing.assert_allclose(by_id.T_first_second, matched.T_first_second, atol=0.5)


def test_how_sure_it_is_of_how_the_maps_lie():
    """NEES of the alignment against truth over seeds; none may be wrong, however few landmarks are shared."""
    nees = []
    for seed in range(12):
        parts = [
            _part("same-100", seed, 0.0, 0.3, (0.0, 0.0, 0.0)),
            _part("same-100", 50 + seed, 0.3, 0.6, (9.0, 1.0, 2.0)),
        ]
        (first, T_world_a), (second, T_world_b) = parts
        try:
            matched = match_by_place(_local(first), _local(second))
        except NoMatchError:
            continue
        error = matched.T_first_second - compose(inverse(T_world_a), T_world_b)
        error[2] = wrap(error[2])
        nees.append(float(error @ np.linalg.solve(matched.covariance, error)))
    assert len(nees) >= 6
    assert max(nees) < 25.0
    assert np.mean(nees) < 6.0


@pytest.mark.parametrize(
    ("one", "other"),
    [("course-35", "same-100"), ("lawn-300", "lawn-400"), ("same-100", "wide-100"), ("course-35", "wide-35")],
)
def test_maps_of_different_places_are_refused(one, other):
    for seed in range(2):
        first, second = (
            _part(one, seed, 0.0, 1.0, (0.0, 0.0, 0.0))[0],
            _part(other, seed, 0.0, 1.0, (0.0, 0.0, 0.0))[0],
        )
        with pytest.raises(NoMatchError, match=r"overlap|more than one"):
            match_by_place(_local(first), _local(second))


def _grid(rows, columns, ids=0):
    """A regular orchard, well known."""
    points = np.stack(
        np.meshgrid(5.0 * np.arange(rows), 5.0 * np.arange(columns), indexing="ij"), -1
    ).reshape(-1, 2)
    mean = np.concatenate([np.zeros(3), points.ravel()])
    return local_map(mean, 1e-4 * np.eye(len(mean)), ids + np.arange(len(points)))


def test_an_orchard_that_fits_in_many_ways_is_refused():
    with pytest.raises(NoMatchError, match="more than one way"):
        match_by_place(_grid(8, 8), _grid(5, 5))


def test_identities_that_contradict_each_other_are_refused():
    first, second = _grid(4, 4), _grid(4, 4)
    moved = local_map(
        second.mean + np.random.default_rng(1).normal(0.0, 1.0, len(second.mean)),
        second.covariance,
        second.ids,
    )
    with pytest.raises(NoMatchError, match="contradict"):
        match_by_id(first, moved)
    with pytest.raises(NoMatchError, match="in common"):
        match_by_id(first, local_map(second.mean, second.covariance, second.ids + 100))


def test_the_command_joins_writes_and_refuses(halves, tmp_path):
    paths = [tmp_path / "a.kalmap", tmp_path / "b.kalmap"]
    for path, (estimate, _) in zip(paths, halves):
        write_map(path, estimate)
    answer = kalmap_inside("join", paths[0], paths[1], "--out", tmp_path / "out")
    assert answer.code == 0 and "pairs of landmarks" in answer.out
    report = json.loads((tmp_path / "out" / "join.json").read_text())
    saved = read_map_file(tmp_path / "out" / "map.kalmap")
    assert len(saved.landmark_ids) == report["landmarks"] == len(np.unique(saved.landmark_ids))
    assert np.linalg.eigvalsh(saved.covariance()).min() > 0.0
    assert (tmp_path / "out" / "figures" / "join.png").stat().st_size > 10_000
    assert len((tmp_path / "out" / "landmarks.csv").read_text().splitlines()) == report["landmarks"] + 1
    again = kalmap_inside(
        "join", paths[0], paths[1], "--by-id", "--no-figures", "-q", "--out", tmp_path / "ids"
    )
    assert again.code == 0 and again.out == ""
    ids = read_map_file(tmp_path / "ids" / "map.kalmap").landmark_ids
    assert sorted(ids) == sorted(np.union1d(*(estimate.landmarks.ids for estimate, _ in halves)))
    write_map(tmp_path / "other.kalmap", _part("same-100", 3, 0.0, 1.0, (0.0, 0.0, 0.0))[0])
    refused = kalmap_inside("join", paths[0], tmp_path / "other.kalmap", "--out", tmp_path / "no")
    assert refused.code == 2 and "overlap" in refused.error
    assert not (tmp_path / "no" / "map.kalmap").exists()
    assert "same map" in kalmap_inside("join", paths[0], paths[0], "--out", tmp_path / "no").error
    (tmp_path / "bad.kalmap").write_bytes(b"no map")
    assert (
        "bad.kalmap"
        in kalmap_inside("join", paths[0], tmp_path / "bad.kalmap", "--out", tmp_path / "no").error
    )
