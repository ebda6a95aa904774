"""A running divide and conquer on disk: the forest, the open local map and the drive, exact to the last bit."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.gaussian import Belief
from kalmap.records import DivideConfig
from kalmap.slam.archive import check_arrays, opened, read_header, write_archive
from kalmap.slam.checkpoint import FilterState, rebuilt, state_of
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.submaps.forest import Tree
from kalmap.slam.submaps.local_map import LocalMap, Part

if TYPE_CHECKING:
    from kalmap.perception import Detector
    from kalmap.slam.submaps.divide import DivideAndConquer

FORMAT = "kalmap-divide/1"


class _Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A joined or closed map. leaves: numbers of the closed maps that it holds, rows: where it has their landmarks."""

    end: np.ndarray
    ids: np.ndarray
    landmarks: np.ndarray
    sightings: np.ndarray
    covariance: np.ndarray | None
    end_covariance: np.ndarray
    frames: np.ndarray
    squared: str
    degrees: int
    aliases: np.ndarray
    leaves: list[int]
    rows: list[np.ndarray]


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything. trees: level and the numbers of its maps in `maps`; the closed maps stand first in `maps`."""

    format: str = FORMAT
    settings: DivideConfig
    live: FilterState
    belief: Belief
    start: np.ndarray
    start_covariance: np.ndarray
    closed: int
    distance: str
    maps: list[_Map]
    trees: list[tuple[int, list[int]]]
    refusals: int
    times: np.ndarray
    parts: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    merged: dict[int, int]
    rejected: list[int]


def save_divided(slam: DivideAndConquer, path: str | os.PathLike[str]) -> None:
    """Write atomically. Raises ConfigError if the filter holds a part that kalmap cannot name."""
    forest, passed = slam._settled(), slam._passed
    leaves = [part.map for each in forest.maps for part in each.leaves]
    numbers = {id(leaf): number for number, leaf in enumerate(leaves)}
    maps = [_record(leaf, numbers) for leaf in leaves]
    trees = []
    for tree in forest.trees:
        held = []
        for each in tree.maps:
            if not each.parts:
                held.append(numbers[id(each)])
                continue
            held.append(len(maps))
            maps.append(_record(each, numbers))
        trees.append((tree.level, held))
    count = len(passed.times)
    state = _State(
        settings=slam.settings,
        live=state_of(slam.live),
        belief=slam.live._belief,
        start=slam.start,
        start_covariance=slam.start_covariance,
        closed=slam._closed,
        distance=slam._distance.hex(),
        maps=maps,
        trees=trees,
        refusals=forest.refusals,
        times=np.array(passed.times),
        parts=np.array(passed.parts, dtype=np.int64),
        poses=np.array(passed.poses).reshape(count, 3),
        covariances=np.array(passed.covariances).reshape(count, 3, 3),
        merged=slam._merged,
        rejected=sorted(slam._rejected),
    )
    write_archive(path, state)


def load_divided(
    kind: type[DivideAndConquer], path: str | os.PathLike[str], detector: Detector | None
) -> DivideAndConquer:
    """Read what `save_divided` wrote. Raises LogError if the file is not one of these or is damaged."""
    with opened(path) as stored:
        state = read_header(stored, _State, FORMAT)
        live = rebuilt(LandmarkSlam, state.live, state.belief, detector)
        _check(state)
        slam = kind(live.twin(), state.settings)
        slam.live, slam.start, slam.start_covariance = live, state.start, state.start_covariance
        leaves = [_map(each, []) for each in state.maps[: state.closed]]
        maps = leaves + [_map(each, leaves) for each in state.maps[state.closed :]]
        trees = [Tree(level, tuple(maps[number] for number in held)) for level, held in state.trees]
        if [part.map for tree in trees for each in tree.maps for part in each.leaves] != leaves:
            raise ValueError("the trees do not hold each closed map once, in the order of the drive")
        slam._forest = slam._new_forest(tuple(trees), state.refusals)
        passed = slam._passed
        passed.times, passed.parts = state.times.tolist(), state.parts.tolist()
        passed.poses, passed.covariances = list(state.poses), list(state.covariances)
        slam._closed, slam._distance = state.closed, float.fromhex(state.distance)
        slam._merged, slam._rejected = state.merged, set(state.rejected)
        return slam


def _record(map_: LocalMap, numbers: dict[int, int]) -> _Map:
    fields = {
        name: getattr(map_, name) for name in map_.__struct_fields__ if name not in ("parts", "squared")
    }
    return _Map(
        **fields,
        squared=float(map_.squared).hex(),
        leaves=[numbers[id(part.map)] for part in map_.parts],
        rows=[part.rows for part in map_.parts],
    )


def _map(record: _Map, leaves: list[LocalMap]) -> LocalMap:
    """The map. Raises ValueError unless its parts fit together."""
    count, frames = len(record.ids), len(record.frames)
    size = 3 * frames + 3 + 2 * count
    check_arrays(
        (record.ids, (count,), "iu"),
        (record.landmarks, (count, 2)),
        (record.sightings, (count,), "iu"),
        (record.covariance, (size, size)),
        (record.end, (3,)),
        (record.end_covariance, (3, 3)),
        (record.frames, (frames, 3)),
        (record.aliases, (len(record.aliases), 2), "iu"),
    )
    if len(record.leaves) != len(record.rows) or (record.leaves and len(record.leaves) != frames + 1):
        raise ValueError("a joined map's parts do not fit its frames")
    parts = tuple(Part(leaves[number], rows) for number, rows in zip(record.leaves, record.rows, strict=True))
    for part in parts:
        check_arrays((part.rows, (len(part.map),), "iu"))
        if len(part.rows) and not 0 <= part.rows.min() <= part.rows.max() < count:
            raise ValueError("a part names landmarks that are not there")
    fields = {
        name: getattr(record, name)
        for name in record.__struct_fields__
        if name not in ("squared", "leaves", "rows")
    }
    return LocalMap(**fields, parts=parts, squared=float.fromhex(record.squared))


def _check(state: _State) -> None:
    """Raise ValueError unless the drive's arrays fit each other."""
    count = len(state.times)
    check_arrays(
        (state.start, (3,)),
        (state.start_covariance, (3, 3)),
        (state.times, (count,)),
        (state.parts, (count,), "iu"),
        (state.poses, (count, 3)),
        (state.covariances, (count, 3, 3)),
    )
    if count and not 0 <= state.parts.min() <= state.parts.max() <= state.closed:
        raise ValueError("the drive was in local maps that are not there")
    if any(each.leaves for each in state.maps[: state.closed]) or len(state.maps) < state.closed:
        raise ValueError("its closed maps are not there")
    if any(not 0 <= number < len(state.maps) for _, held in state.trees for number in held):
        raise ValueError("a tree names a map that is not there")
