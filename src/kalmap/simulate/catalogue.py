"""Worlds by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np

from kalmap.records import ConfigError
from kalmap.simulate.breakers import (
    breaker_world,
    clusters_world,
    clutter_world,
    djnn_world,
    doubles_world,
    grove_world,
    missed_world,
    orchard_world,
)
from kalmap.simulate.courses import (
    HARD_NOISE,
    bailey_world,
    course_world,
    lawn_world,
    same_world,
    wide_world,
)
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.floors import crowd, floor_115, floor_170, hall, lab, standstill, straight_corridor
from kalmap.simulate.rooms import office, rooms_world
from kalmap.simulate.set_worlds import (
    RFS_CLUTTER_AREA,
    cluttered_world,
    faded_world,
    field_world,
    phd_world,
    restless_world,
    rfs_world,
)
from kalmap.simulate.world import World

Maps = Callable[[str], tuple[np.ndarray, np.ndarray]]

BAILEY_MAP = "example_webmap"

# far beyond what a covariance of all features fits into
_MOST_LANDMARKS = 1_000_000
_KINDS = {"course": course_world, "same": same_world, "wide": wide_world, "lawn": lawn_world}
# here <N> is no number of features, and what is too much the world itself says
_DISTURBED: dict[str, Callable[[int], World]] = {
    "djnn": djnn_world,
    "clutter": clutter_world,
    "phd": phd_world,
}
# P_D, and clutter per m and rad, as RFS-SLAM's scripts set them
_RFS_GRID = {
    "rfs-99-0": (0.99, 0.0001),
    "rfs-90-1": (0.9, 0.1),
    "rfs-70-6": (0.7, 0.46),
    "rfs-50-13": (0.5, 1.0),
}
_SINGLE: dict[str, Callable[[], World]] = {
    "missed-35": missed_world,
    "missed-50": partial(missed_world, name="missed-50", detection_probability=0.5),
    "doubles-35": doubles_world,
    "orchard": orchard_world,
    "clusters": clusters_world,
    "breaker": breaker_world,
    "grove": grove_world,
    "field-160": field_world,
    **{
        name: partial(rfs_world, detection, RFS_CLUTTER_AREA * intensity, name=name)
        for name, (detection, intensity) in _RFS_GRID.items()
    },
    "clutter-20-70": cluttered_world,
    "faded-35": faded_world,
    "restless-35": restless_world,
}
_FLOORS: dict[str, Callable[[], FloorWorld]] = {
    "floor-115": floor_115,
    "floor-170": floor_170,
    "office": office,
    "hall": hall,
    "lab": lab,
    "corridor": straight_corridor,
    "crowd": crowd,
    "standstill": standstill,
}


def world_names() -> list[str]:
    """The names that `world_by_name` knows, the default first.

    `<N>` stands for a number: of features, of movers in `djnn-<N>`, of false sightings a frame in `clutter-<N>` and
    `phd-<N>`, of rooms in `rooms-<N>`.
    """
    plain = ["course-35", "course-70", "bailey-35", "bailey-70", *(f"{kind}-<N>" for kind in _KINDS)]
    some = ["djnn-10", "djnn-50", "clutter-5", "phd-1", "phd-2", "phd-3"]
    return [*plain, *some, *(f"{kind}-<N>" for kind in _DISTURBED), *_SINGLE, *_FLOORS, "rooms-<N>"]


def world_by_name(name: str, maps: Maps | None = None) -> World | FloorWorld:
    """The world of that name.

    `course-35` is the package's own course, `course-<N>` the same with N features; `course-70` also
    has twice the control noise (the papers' set b). `same-<N>`, `wide-<N>` and `lawn-<N>` grow: see
    `same_world`, `wide_world`, `lawn_world`. `bailey-35` and `bailey-70` are the standard map of
    Bailey and Nieto's simulator, the second with 35 features more and twice the control noise.

    The others are made to break data association, each in its own way, which its function in `breakers` tells:
    `djnn-<N>` (`djnn_world`: 252 features, N objects that move), `clutter-<N>` (N false sightings a frame),
    `missed-35`, `doubles-35`, `orchard`, `clusters`, `breaker`, and `grove`, whose log holds laser scans; `missed-50`
    is `missed-35` with half of all sightings missed.

    For filters of random finite sets, told in `set_worlds`: the published `phd-<N>` (`phd_world`: 39 features,
    N false sightings a look, 726 looks), `field-160` (`field_world`: a square of 1 km, 4,000 looks), and `rfs-99-0`,
    `rfs-90-1`, `rfs-70-6`, `rfs-50-13` (`rfs_world`: P_D in percent, false sightings a look, rounded; 3,000 looks);
    and on the package's course `clutter-20-70` (twenty false sightings, P_D 0.7), `faded-35` (P_D falls with the
    range) and `restless-35` (5 of 35 features move).

    Floors, driven by a robot with two wheels and a laser scanner, told in `floors` and `rooms`: `floor-115` and
    `floor-170` (the kind of Sun et al. 2010: 115 m, two loops; 170 m, one loop; URG-04LX), `office` (SICK, 12 rooms,
    300 m), `hall` (curved walls, round columns), `lab` (tables and shelves, hardly any contour), `corridor` (nothing
    tells how far one is), `crowd` (40 people),
    `standstill` (never moves); and `rooms-<N>`, a floor of N rooms, of which `rooms-<N>-<M>` is the M-th.

    maps: given a map's name ("example_webmap") returns its landmarks (N, 2) and way-points (K, 2);
        needed for the Bailey worlds only, whose map is not part of this package.

    Raises `ConfigError` for an unknown name, or a Bailey world without `maps`.
    """
    if name in _FLOORS:
        return _FLOORS[name]()
    match = re.fullmatch(r"rooms-([0-9]{1,7})(?:-([0-9]{1,9}))?", name)
    if match is not None:
        return rooms_world(int(match[1]), int(match[2] or 1), name=name)
    return landmark_world_by_name(name, maps)


def landmark_world_by_name(name: str, maps: Maps | None = None) -> World:
    """The same, for those that are no floors."""
    if name in ("bailey-35", "bailey-70"):
        if maps is None:
            raise ConfigError(
                f"world {name} needs the map {BAILEY_MAP} of Bailey's simulator, which is not here"
            )
        landmarks, waypoints = maps(BAILEY_MAP)
        if name == "bailey-35":
            return bailey_world(landmarks, waypoints, name=name)
        return bailey_world(landmarks, waypoints, extra=35, name=name, **HARD_NOISE)
    if name == "course-70":
        return course_world(70, **HARD_NOISE)
    if name in _SINGLE:
        return _SINGLE[name]()
    match = re.fullmatch(r"([a-z]+)-([0-9]{1,7})", name)
    if match is not None and match[1] in _DISTURBED:
        return _DISTURBED[match[1]](int(match[2]))
    if match is None or match[1] not in _KINDS or int(match[2]) > _MOST_LANDMARKS:
        raise ConfigError(f"unknown world {name!r}; known are {', '.join(world_names())}")
    return _KINDS[match[1]](int(match[2]))
