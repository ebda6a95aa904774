"""LOG on the command line: a path, a map for the simulator, or the name of a world."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data import open_log, read_map
from kalmap.records import ConfigError, Log, LogError
from kalmap.simulate import (
    FloorWorld,
    World,
    bailey_world,
    rooms_world,
    simulate,
    with_clutter,
    world_by_name,
)
from kalmap.simulate import (
    random_landmarks as random_landmarks_in,
)

BAILEY_FOLDER = "bailey_sim"
Topics = tuple[str | None, str | None]


def data_root() -> Path:
    """Where logs lie that are not part of kalmap: $KALMAP_DATA, by default ../shared/data."""
    return Path(os.environ.get("KALMAP_DATA", "../shared/data"))


def bailey_map(name: str) -> tuple[Any, Any]:
    """Landmarks and way-points of a map of Bailey's simulator. Raises LogError if it is not there."""
    path = data_root() / BAILEY_FOLDER / f"{name}.mat"
    if not path.is_file():
        raise LogError("not found; set KALMAP_DATA to the folder that holds bailey_sim", file=path)
    loaded = read_map(path)
    return loaded.landmarks, loaded.waypoints


def find_world(text: str, overrides: dict[str, Any]) -> World | FloorWorld | None:
    """The world of that name or in that map file, with its `world.*` settings; None if LOG is a log."""
    path = Path(text)
    world: World | FloorWorld | None
    if path.exists():
        world = _world_of_map(path)
        if world is None and overrides:
            raise ConfigError(f"world.{next(iter(overrides))}: {text} is a log, not a world")
    else:
        try:
            world = world_by_name(text, bailey_map)
        except ConfigError as problem:
            raise ConfigError(f"{text}: no such file or folder, and {problem}") from problem
    return world if world is None or not overrides else _changed(world, overrides)


def _world_of_map(path: Path) -> World | None:
    if not path.is_file() or path.suffix not in (".mat", ".txt"):
        return None
    try:
        loaded = read_map(path)
    except LogError:
        return None  # not a map: whether it is a log, and what is wrong with it, the log's reader says
    return bailey_world(loaded.landmarks, loaded.waypoints, name=path.stem)


def _changed(world: World | FloorWorld, overrides: dict[str, Any]) -> World | FloorWorld:
    overrides = dict(overrides)
    if isinstance(world, FloorWorld):
        return _changed_floor(world, overrides)
    drawn = {key: overrides.pop(key) for key in ("random_landmarks", "area", "map_seed") if key in overrides}
    if drawn:
        world = _redrawn(world, **drawn)
    known = {field for field in world.__struct_fields__ if isinstance(getattr(world, field), (int, float))}
    known.add("detection_far")  # None until it is set
    for key, value in overrides.items():
        if key not in known:
            raise ConfigError(f"world.{key}: no such setting; there are {', '.join(sorted(known | _DRAWN))}")
        _check_number(key, getattr(world, key), value)
    return msgspec.structs.replace(world, **overrides)


def _check_number(key: str, before: Any, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"world.{key}: expected a number, got {value!r}")
    if isinstance(before, int) and not isinstance(value, int):
        raise ConfigError(f"world.{key}: expected a whole number, got {value!r}")


_DRAWN = {"random_landmarks", "area", "map_seed"}


def _changed_floor(world: FloorWorld, overrides: dict[str, Any]) -> FloorWorld:
    """The floor with other numbers; and another plan, if it is one of those that are drawn (`rooms-<N>`)."""
    kinds = {
        field: type(getattr(world, field))
        for field in world.__struct_fields__
        if field != "name" and isinstance(getattr(world, field), (bool, int, float, str))
    }
    if "map_seed" in overrides:
        world = _redrawn_floor(world, overrides.pop("map_seed"))
    for key, value in overrides.items():
        if key not in kinds:
            raise ConfigError(
                f"world.{key}: no such setting; there are {', '.join(sorted([*kinds, 'map_seed']))}"
            )
        if kinds[key] in (bool, str):
            if not isinstance(value, kinds[key]):
                raise ConfigError(f"world.{key}: expected {_WANTED[kinds[key]]}, got {value!r}")
        else:
            _check_number(key, getattr(world, key), value)
    return msgspec.structs.replace(world, **overrides)


_WANTED = {bool: "true or false", str: "a name"}


def _redrawn_floor(world: FloorWorld, map_seed: Any) -> FloorWorld:
    kind, *numbers = world.name.split("-")
    if kind != "rooms":
        raise ConfigError(f"world.map_seed: the plan of {world.name} is fixed; rooms-<N> has many")
    if not isinstance(map_seed, int) or isinstance(map_seed, bool) or map_seed < 0:
        raise ConfigError("world.map_seed: expected a whole number, 0 or more")
    return rooms_world(int(numbers[0]), map_seed)


def _redrawn(world: World, random_landmarks: Any = None, area: Any = None, map_seed: Any = 1) -> World:
    """The world with its landmarks replaced by uniformly drawn ones, by default around the way-points."""
    if not isinstance(random_landmarks, int) or isinstance(random_landmarks, bool) or random_landmarks < 0:
        raise ConfigError("world.random_landmarks: expected a number of landmarks, 0 or more")
    if not isinstance(map_seed, int) or isinstance(map_seed, bool) or map_seed < 0:
        raise ConfigError("world.map_seed: expected a whole number, 0 or more")
    if area is None:
        low, high = (
            world.waypoints.min(axis=0) - world.max_range,
            world.waypoints.max(axis=0) + world.max_range,
        )
        area = [*low.tolist(), *high.tolist()]
    numbers = isinstance(area, list) and len(area) == 4 and all(isinstance(v, (int, float)) for v in area)
    if not numbers or not (area[0] < area[2] and area[1] < area[3]):
        raise ConfigError("world.area: expected [x_low, y_low, x_high, y_high] in m")
    x_low, y_low, x_high, y_high = map(float, area)
    box = (x_low, y_low, x_high, y_high)
    landmarks = random_landmarks_in(random_landmarks, box, np.random.default_rng(map_seed))
    return msgspec.structs.replace(world, landmarks=landmarks)


def open_source(
    text: str,
    seed: int,
    overrides: dict[str, Any],
    robot: int | None,
    variant: str | None,
    clutter: float | None = None,
    topics: Topics = (None, None),
) -> Log:
    """The log to run: read from a path, or simulated from the seed; clutter: false sightings added to every frame.

    topics: of the scans and of the odometry in a ROS bag; None is chosen by the reader.
    """
    log = _opened(text, seed, overrides, robot, variant, topics)
    return log if clutter is None else with_clutter(log, clutter, seed)


def _opened(
    text: str, seed: int, overrides: dict[str, Any], robot: int | None, variant: str | None, topics: Topics
) -> Log:
    world = find_world(text, overrides)
    if world is not None:
        if robot is not None or variant is not None or topics != (None, None):
            raise ConfigError(f"{text} is a world: --robot and --variant are for logs, and so are topics")
        return simulate(world, seed)
    log = open_log(text, robot=robot, variant=variant, scan_topic=topics[0], odometry_topic=topics[1])
    return msgspec.structs.replace(log, settings={**log.settings, "robot": robot, "variant": variant})
