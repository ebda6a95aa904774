"""LOG on the command line: a path, a map for the simulator, or the name of a world."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from kalmap.data import open_log, read_map
from kalmap.perception import ReflectorDetector
from kalmap.records import ConfigError, Log, LogError
from kalmap.simulate import World, bailey_world, simulate, world_by_name

BAILEY_FOLDER = "bailey_sim"


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


def find_world(text: str, overrides: dict[str, Any]) -> World | None:
    """The world of that name or in that map file, with its `world.*` settings; None if LOG is a log."""
    path = Path(text)
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


def _changed(world: World, overrides: dict[str, Any]) -> World:
    known = {field for field in world.__struct_fields__ if field not in ("name", "landmarks", "waypoints")}
    for key, value in overrides.items():
        if key not in known:
            raise ConfigError(f"world.{key}: no such setting; there are {', '.join(sorted(known))}")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigError(f"world.{key}: expected a number, got {value!r}")
        if isinstance(getattr(world, key), int) and not isinstance(value, int):
            raise ConfigError(f"world.{key}: expected a whole number, got {value!r}")
    return msgspec.structs.replace(world, **overrides)


def open_source(
    text: str, seed: int, overrides: dict[str, Any], robot: int | None, variant: str | None
) -> Log:
    """The log to run: read from a path, or simulated from the seed."""
    world = find_world(text, overrides)
    if world is not None:
        if robot is not None or variant is not None:
            raise ConfigError(f"{text} is a world: --robot and --variant are for logs")
        return simulate(world, seed)
    return open_log(text, robot=robot, variant=variant, detector=ReflectorDetector())
