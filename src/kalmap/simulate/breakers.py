"""Worlds made to break data association.

In most of them a sighting has more than one landmark that it could be, or is of none. The noise is Bailey and
Nieto's (`World`'s defaults) unless the world says otherwise, so that only the association is hard.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmap.simulate.courses import (
    along_course,
    apart,
    course_waypoints,
    course_world,
    make_world,
    map_stream,
    random_landmarks,
    rounded,
)
from kalmap.simulate.drive import drive
from kalmap.simulate.world import World

PAPER_FEATURES = 252

# the square of Zhou, Zhao & Zhang (120 m x 120 m); the start is 16 m above the middle of its lower side
_SQUARE = (-60.0, -16.0, 60.0, 104.0)
_SQUARE_APART, _SQUARE_CLEAR = 1.5, 2.0
# corners of the way through it, and the radius they are rounded with, m
_SQUARE_CORNERS = ((44, 0), (44, 88), (15, 88), (15, 40), (-15, 40), (-15, 88), (-44, 88), (-44, 0))
_SQUARE_ROUND = 10.0

# rows and trees of the orchard, their distances in m, the first tree of the first row, and the order of the lanes
_ROWS, _TREES, _ROW_STEP, _TREE_STEP = 10, 16, 6.0, 4.0
_FIRST_TREE = (10.0, -3.0)
_LANES = (0, 3, 6, 1, 4, 7, 2, 5, 8)
# m beyond the last tree where a turn begins, and where the farmer unloads before a step of several lanes back
_HEADLAND, _YARD = 10.0, 70.0

_GROUPS, _GROUP_LEAST, _GROUP_MOST = 24, 0.3, 0.6
_TRUNKS, _TRUNKS_APART = 150, 2.0


def djnn_world(movers: int, *, name: str | None = None, **overrides: Any) -> World:
    """The world of Zhou, Zhao & Zhang (2010), section 4: 252 features in a square of 120 m, a laser that reaches
    30 m, objects that walk about at random.

    It breaks those who believe every new sighting: each mover leaves a trail of spurious landmarks, which later
    sightings then match. The paper states neither the features' places nor the way; here features stand
    anywhere, at least 1.5 m apart and 2 m from the way, and the vehicle goes once round anticlockwise with a fold
    to the middle, so that the sensor passes every feature and meets the first ones again at the end.
    overrides: fields of `World`.
    """
    waypoints = rounded(np.array(_SQUARE_CORNERS, dtype=float), _SQUARE_ROUND)
    waypoints = np.concatenate([waypoints, [[0.0, 0.0]]])
    way = drive(World(name="way", landmarks=np.zeros((0, 2)), waypoints=waypoints, laps=1)).poses[::8, :2]
    drawn = random_landmarks(20 * PAPER_FEATURES, _SQUARE, map_stream(5, PAPER_FEATURES))
    gaps = np.hypot(*(drawn[:, None] - way[None]).transpose(2, 0, 1)).min(axis=1)
    landmarks = apart(drawn[gaps > _SQUARE_CLEAR], _SQUARE_APART, PAPER_FEATURES)
    fields = {"laps": 1, "movers": movers, **overrides}
    return make_world(name or f"djnn-{movers}", landmarks, waypoints, fields)


def clutter_world(mean: int, *, name: str | None = None, **overrides: Any) -> World:
    """The package's course with 35 features, and on average `mean` false sightings in every frame.

    One or two sightings of a frame are real, so with a mean of 5 most are not. It breaks those who found a landmark
    on one sighting: the map fills with spurious ones, until something in it fits any sighting.
    """
    return course_world(35, name=name or f"clutter-{mean}", **{"clutter": float(mean), **overrides})


def missed_world(*, name: str = "missed-35", **overrides: Any) -> World:
    """The package's course with 35 features, of which each is missed in three frames of ten.

    It breaks those who remove a landmark, or doubt a whole hypothesis, because something expected was not seen.
    """
    return course_world(35, name=name, **{"detection_probability": 0.7, **overrides})


def doubles_world(*, name: str = "doubles-35", **overrides: Any) -> World:
    """The package's course with 35 features, of which a fifth of the sightings come twice in the same frame.

    It breaks the rule that a landmark gives one sighting a frame: one-to-one matching makes a twin landmark of the
    second sighting, and the twins then contest every later one.
    """
    return course_world(35, name=name, **{"doubles": 0.2, **overrides})


def orchard_world(*, name: str = "orchard", **overrides: Any) -> World:
    """Ten rows of sixteen trees, the rows 6 m and the trees 4 m apart, driven up and down every lane.

    The vehicle cannot turn into the next lane, so like a farmer it skips two and comes back for them, by way of the
    yard, 70 m away, from where no tree is seen. The sensor reaches 12 m, into the next two rows; inside the
    orchard a map that is shifted by a tree or a row looks just the same. It breaks those who trust a match because
    it fits well, all sightings of the frame together: the map has its 160 trees, but the rows driven after the
    yard are one row, or one tree, off.
    """
    row, tree = np.divmod(np.arange(_ROWS * _TREES), _TREES)
    landmarks = np.column_stack([_FIRST_TREE[0] + _TREE_STEP * tree, _FIRST_TREE[1] + _ROW_STEP * row])
    fields = {"laps": 1, "max_range": 12.0, **overrides}
    return make_world(name, landmarks, _orchard_way(landmarks[0, 0], landmarks[-1, 0]), fields)


def clusters_world(*, name: str = "clusters", **overrides: Any) -> World:
    """Twenty-four groups of four to six features along the package's course, 0.3 to 0.6 m from one to the next.

    From 20 m a gate of 99.9 % is 1.3 m to either side, so every sighting of a group fits most features of it, and
    only the pattern of all tells them apart. It breaks those who match one sighting at a time, and those who make
    one landmark of what lies close together.
    """
    rng = map_stream(6, _GROUPS)
    landmarks = [_group(centre, int(rng.integers(4, 7)), rng) for centre in along_course(_GROUPS)]
    return make_world(name, np.concatenate(landmarks), course_waypoints(), overrides)


def breaker_world(*, name: str = "breaker", **overrides: Any) -> World:
    """Everything at once: the square of `djnn_world` with 50 movers, five false sightings a frame, three of ten
    features missed and a fifth of the sightings doubled.

    Three of ten sightings are of no landmark. Nobody is asked to be right here, only to go on: a map that
    stays bounded, a covariance that stays positive definite.
    """
    fields = {"clutter": 5.0, "detection_probability": 0.7, "doubles": 0.2, **overrides}
    return djnn_world(50, name=name, **fields)


def grove_world(*, name: str = "grove", **overrides: Any) -> World:
    """A hundred and fifty trees along the package's course, their trunks 0.08 to 0.5 m in radius, and eight
    pedestrians, as a laser scanner sees them: beams, not sightings.

    It breaks detectors: trunks far away are hit by one beam or none, trees and people hide each other wholly or in
    part, and a pedestrian is as round as a tree.
    """
    rng = map_stream(7, _TRUNKS)
    landmarks = apart(along_course(2 * _TRUNKS), _TRUNKS_APART, _TRUNKS)
    fields = {
        "scanner": "sick",
        "radii": np.round(rng.uniform(0.08, 0.5, _TRUNKS), 3),
        "movers": 8,
        "max_range": 40.0,
        "sigma_range": 0.05,
        "sigma_bearing_deg": 0.3,
        **overrides,
    }
    return make_world(name, landmarks, course_waypoints(), fields)


def _orchard_way(first: float, last: float) -> np.ndarray:
    """Way-points (K, 2) m: straight through the lanes, whose trees begin and end at these x, by the yard where the
    order of the lanes steps back."""
    points: list[tuple[float, float]] = []
    for number, lane in enumerate(_LANES):
        y, onward = _ROW_STEP * lane, 1.0 - 2.0 * (number % 2)
        begin, end = (first, last) if onward > 0 else (last, first)
        if number and lane < _LANES[number - 1]:
            yard = begin - onward * _YARD
            points += [(yard, points[-1][1]), (yard + onward * 10.0, y), (begin - onward * _HEADLAND, y)]
        points += [(begin, y), (end, y), (end + onward * _HEADLAND, y)]
    return np.array(points)


def _group(centre: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 2) m: features from `centre` on, each 0.3 to 0.6 m from the nearest one."""
    members = np.array([centre])
    while len(members) < count:
        beside = members[rng.integers(len(members))]
        angle, gap = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(_GROUP_LEAST, _GROUP_MOST)
        member = beside + gap * np.array([np.cos(angle), np.sin(angle)])
        if np.hypot(*(members - member).T).min() >= _GROUP_LEAST:
            members = np.append(members, member[None], axis=0)
    return members
