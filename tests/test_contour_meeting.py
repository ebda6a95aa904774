"""Two finished contour maps, how they lie unknown: found, joined, or refused. Oracle: the world they were made from."""

from __future__ import annotations

import json

import numpy as np
import pytest

from command import kalmap_inside
from kalmap.data.native_map import read_map_file, write_map
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.geometry.segments import segment_distances
from kalmap.records import Contours, Estimate, JointTooLargeError, Landmarks
from kalmap.slam.contours.meeting import meet
from kalmap.slam.submaps.matching import NoMatchError
from wall_maps import ROOM, wall_map, wall_samples

HOME = np.array(
    [
        [0, 0, 9, 0],
        [9, 0, 9, 5],
        [9, 5, 6.5, 5],
        [6.5, 5, 6.5, 7.4],
        [6.5, 7.4, 2.2, 7.4],
        [2.2, 7.4, 2.2, 3.1],
    ]
    + [
        [2.2, 3.1, 0, 3.1],
        [0, 3.1, 0, 0],
        [4, 2.4, 4.9, 2.4],
        [4.9, 2.4, 4.9, 3.0],
        [4.9, 3, 4, 3],
        [4, 3, 4, 2.4],
    ],
    dtype=float,
)
"""A room like no turn of itself, with a box in it (whose free side is outside: its walls run clockwise)."""
HOME[8:] = HOME[8:][:, [2, 3, 0, 1]]
AWAY = np.array(
    [[0, 0, 3.1, 0], [3.1, 0, 4.4, 2], [4.4, 2, 4.4, 5.3], [4.4, 5.3, 1.0, 5.3], [1.0, 5.3, 0, 0]]
)
CALM = {"drift": (0.008, 0.008, 0.001), "noise": 0.005}


def a_map(seed, walls, start, end, low=-9.0, high=99.0, **settings):
    rng = np.random.default_rng(seed)
    offset = float(rng.uniform(0.05, 0.25))
    points, normals = wall_samples(walls, 0.3, offset, low, high)
    return wall_map(rng, np.array(start), np.array(end), points, normals, **{**CALM, **settings})


A, B = (0.7, 1.5, 0.2), (7.2, 3.3, 2.4)


@pytest.mark.parametrize("seed", range(3))
def test_two_maps_of_a_room_find_each_other(seed):
    first = a_map([1, seed], HOME, A, (5.5, 4.0, 0.9), high=7.0)
    second = a_map([2, seed], HOME, B, (3.0, 6.0, -3.0), low=1.8)
    met = meet(first, second)
    error = met.pose - compose(inverse(np.array(A)), np.array(B))
    error[2] = wrap(error[2])
    assert np.hypot(*error[:2]) < 0.12 and abs(error[2]) < 0.02
    places = compose(np.array(A), np.column_stack([met.map.samples, np.zeros(len(met.map.samples))]))[:, :2]
    off = segment_distances(places, HOME)
    assert off.mean() < 0.05 and off.max() < 0.25
    assert len(met.map.samples) < len(first.samples) + len(second.samples) - 20


def test_rooms_that_are_not_one_are_refused():
    with pytest.raises(NoMatchError):
        meet(a_map(1, HOME, A, B), a_map(2, AWAY, (1.5, 2.0, 0.0), (3.0, 4.0, 1.0)))


def test_a_room_that_fits_both_ways_round_is_refused():
    first = a_map(3, ROOM, (0.8, 2.0, 0.0), (4.9, 1.7, 0.5))
    second = a_map(4, ROOM, (4.0, 1.0, 2.0), (1.0, 3.0, 2.5))
    with pytest.raises(NoMatchError, match="more than one way"):
        meet(first, second)


def test_bare_corridors_are_refused():
    walls = np.array([[20.0, 2.0, 0.0, 2.0], [0.0, 0.0, 20.0, 0.0]])
    first = a_map(5, walls, (1.0, 1.0, 0.0), (12.0, 1.0, 0.0), high=13.0)
    second = a_map(6, walls, (8.0, 1.0, 0.0), (19.0, 1.0, 0.0), low=7.0)
    with pytest.raises(NoMatchError):
        meet(first, second)


# --- files --------------------------------------------------------------------------------------------------------


def save(path, closed, joint=True):
    count = len(closed.samples)
    blocks = 3 + 2 * np.arange(count)[:, None] + np.arange(2)
    contours = Contours(
        closed.samples,
        closed.covariance[blocks[:, :, None], blocks[:, None, :]],
        closed.normals,
        closed.sightings,
        np.cumsum(np.hypot(*np.diff(closed.samples, axis=0, prepend=closed.samples[:1]).T) > 0.5),
    )

    def whole():
        if not joint:
            raise JointTooLargeError("too large")
        return closed.mean, closed.covariance

    none = Landmarks(np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0))
    estimate = Estimate(1.0, closed.mean[:3], closed.covariance[:3, :3], none, {}, whole, contours=contours)
    write_map(path, estimate)
    return path


@pytest.mark.parametrize("joint", [True, False])
def test_the_command_joins_files(tmp_path, joint):
    first = save(tmp_path / "a.kalmap", a_map(7, HOME, A, (5.5, 4.0, 0.9), high=7.0))
    second = save(tmp_path / "b.kalmap", a_map(8, HOME, B, (3.0, 6.0, -3.0), low=1.8), joint)
    out = tmp_path / "out"
    answer = kalmap_inside("join", first, second, "--out", out)
    assert answer.code == 0, answer.err
    assert "m of contour lie on each other" in answer.out
    told = json.loads((out / "join.json").read_text())
    true = compose(inverse(np.array(A)), np.array(B))
    assert np.hypot(told["x"] - true[0], told["y"] - true[1]) < 0.15 and told["joint"] is joint
    saved = read_map_file(out / "map.kalmap")
    assert saved.has_joint is joint and len(saved.contour_runs) == told["samples"]
    for name in ("contours.csv", "contours.geojson", "manifest.json", "figures/join.png"):
        assert (out / name).stat().st_size > 100
    places = saved.estimate().contours.positions
    moved = compose(np.array(A), np.column_stack([places, np.zeros(len(places))]))[:, :2]
    assert segment_distances(moved, HOME).mean() < 0.06


def test_the_command_refuses_clearly(tmp_path):
    first = save(tmp_path / "a.kalmap", a_map(9, HOME, A, B))
    second = save(tmp_path / "b.kalmap", a_map(10, AWAY, (1.5, 2.0, 0.0), (3.0, 4.0, 1.0)))
    answer = kalmap_inside("join", first, second, "--out", tmp_path / "out")
    assert answer.code != 0 and "maps" in answer.error
    assert not (tmp_path / "out" / "map.kalmap").exists()
