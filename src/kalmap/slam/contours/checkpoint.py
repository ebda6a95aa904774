"""A running map of contours on disk: open and closed maps, their scans and loops, exact to the last bit."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.gaussian import Belief
from kalmap.gaussian.linearisers import BuiltIn
from kalmap.kernels.contour_state import SAMPLES
from kalmap.kernels.packed import pack, unpack
from kalmap.models.motion import BuiltInMotion
from kalmap.records import ContourConfig, SensorConfig
from kalmap.slam.archive import check_arrays, opened, read_header, write_archive
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.graph import Relation
from kalmap.slam.contours.late import Late
from kalmap.slam.contours.leg import Leg, OpenLeg
from kalmap.slam.contours.live import LiveMap
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.scan_store import StoredScans, scans_of, stored_scans
from kalmap.slam.contours.wider import Glimpse
from kalmap.slam.contours.worker import Joined, Worker

if TYPE_CHECKING:
    from kalmap.slam.contours.slam import ContourSlam

FORMAT = "kalmap-contours/4"


class _Live(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The open map, see `LiveMap`; numbers: all that it holds singly, by name. last_pose: (3,) after the last scan
    that was used."""

    belief: Belief
    since: Belief
    last_pose: np.ndarray
    normals: np.ndarray
    sightings: np.ndarray
    open: np.ndarray
    numbers: dict[str, int | float]


class _Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A closed map; packed: the lower triangle of its covariance."""

    mean: np.ndarray
    packed: np.ndarray
    normals: np.ndarray
    sightings: np.ndarray
    spacing: float


class _Places(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """(K, 3) poses and their covariances (K, 3, 3)."""

    poses: np.ndarray
    covariances: np.ndarray


class _Leg(_Places, frozen=True, forbid_unknown_fields=True):
    """Where the scans of a leg were taken; twists, driven: see `Leg`."""

    twists: np.ndarray
    driven: np.ndarray


class _Loops(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """See `Loops` and `FrameGraph`; open: first map, second map, why."""

    maps: list[_Map]
    frames: np.ndarray
    relations: list[Relation]
    open: list[tuple[int, int, str]]
    searched: int
    misfits: np.ndarray
    glimpses: list[Glimpse]


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything. legs: of the closed maps, and in the end the open one; scans: of all of them, in that order."""

    format: str = FORMAT
    motion: BuiltInMotion
    sensor: SensorConfig
    settings: ContourConfig
    lineariser: BuiltIn
    coordinates: str
    start: np.ndarray
    start_covariance: np.ndarray
    live: _Live
    loops: _Loops
    legs: list[_Leg]
    scans: StoredScans
    ends: _Places
    time: float
    moved: bool
    way: float
    turn: float
    twist: np.ndarray
    late: Late
    changes: int
    frames: int


def save_contours(slam: ContourSlam, path: str | os.PathLike[str]) -> None:
    """Write atomically; waits for the joins. Raises ConfigError if the filter holds a part that kalmap cannot name."""
    joined, live = slam._worker.settled(), slam._live
    legs = [*joined.legs, slam._leg.leg()]
    state = _State(
        motion=slam.motion,
        sensor=slam.scanner,
        settings=slam.settings,
        lineariser=slam.lineariser,  # type: ignore[arg-type]
        coordinates=slam.coordinates,
        start=slam._start,
        start_covariance=slam._start_covariance,
        live=_Live(
            live.belief, live._since, live._last_pose, live.normals, live.sightings, live.open, _numbers(live)
        ),
        loops=_record(joined.loops),
        legs=[_Leg(leg.poses, leg.covariances, leg.twists, leg.driven) for leg in legs],
        scans=stored_scans([scan for leg in legs for scan in leg.scans]),
        ends=_Places(
            np.array([pose for pose, _ in slam._ends]).reshape(-1, 3),
            np.array([covariance for _, covariance in slam._ends]).reshape(-1, 3, 3),
        ),
        time=slam._time,
        moved=slam._moved,
        way=slam._way,
        turn=slam._turn,
        twist=slam._twist,
        late=slam._clock.late,
        changes=slam._changes,
        frames=slam._frames,
    )
    write_archive(path, state)


def load_contours(kind: type[ContourSlam], path: str | os.PathLike[str]) -> ContourSlam:
    """Read what `save_contours` wrote. Raises LogError if the file is not one of these or is damaged."""
    with opened(path) as stored:
        state = read_header(stored, _State, FORMAT)
        _check(state)
        slam = kind(
            state.motion,
            state.sensor,
            state.settings,
            state.lineariser,
            state.coordinates,
            start=state.start,
            start_covariance=state.start_covariance,
        )
        slam._live = _live(slam._live, state.live)
        legs = _legs(state)
        slam._leg = OpenLeg()
        for row in zip(legs[-1].scans, legs[-1].poses, legs[-1].covariances, legs[-1].twists, strict=True):
            slam._leg.append(*row)
        slam._leg.driven = legs[-1].driven
        slam._worker = Worker(Joined(_loops(state.loops), legs[:-1]), state.settings.background)
        slam._ends = list(zip(state.ends.poses, state.ends.covariances, strict=True))
        slam._time, slam._moved = state.time, state.moved
        slam._way, slam._turn, slam._twist = state.way, state.turn, state.twist
        slam._clock.late = state.late
        slam._changes, slam._frames = state.changes, state.frames
        return slam


def _record(loops: Loops) -> _Loops:
    maps = []
    for each in loops.maps:
        size = len(each.mean)
        packed = np.empty(size * (size + 1) // 2)
        pack(np.ascontiguousarray(each.covariance), size, packed)
        maps.append(_Map(each.mean, packed, each.normals, each.sightings, each.spacing))
    return _Loops(
        maps=maps,
        frames=loops.graph.frames,
        relations=loops.graph.relations,
        open=[(first, second, why) for (first, second), why in loops.open.items()],
        searched=loops.searched,
        misfits=np.array(loops._misfits, dtype=float),
        glimpses=loops.wider.glimpses,
    )


def _loops(record: _Loops) -> Loops:
    loops = Loops()
    loops.maps = [_map(each) for each in record.maps]
    loops.graph.frames, loops.graph.relations = record.frames, record.relations
    loops.open = {(first, second): why for first, second, why in record.open}
    loops.searched, loops._misfits = record.searched, record.misfits.tolist()
    loops.wider.glimpses = record.glimpses
    loops.graph.rescale(loops.scale)
    return loops


def _map(record: _Map) -> ClosedMap:
    size = len(record.mean)
    covariance = np.empty((size, size))
    unpack(record.packed, size, covariance)
    return ClosedMap(record.mean, covariance, record.normals, record.sightings, record.spacing)


def _live(fresh: LiveMap, record: _Live) -> LiveMap:
    """The open map, from one of the same rules. Raises ValueError unless its numbers are those that a map has."""
    if record.numbers.keys() != _numbers(fresh).keys():
        raise ValueError("the open map's numbers are not those of a map")
    fresh.belief, fresh._since, fresh._last_pose = record.belief, record.since, record.last_pose
    fresh.normals, fresh.sightings, fresh.open = record.normals, record.sightings, record.open
    for name, value in record.numbers.items():
        setattr(fresh, name, value)
    return fresh


def _numbers(live: LiveMap) -> dict[str, int | float]:
    return {name: value for name, value in vars(live).items() if isinstance(value, (int, float))}


def _legs(state: _State) -> list[Leg]:
    """The legs with their scans. Raises ValueError unless there are as many scans as places."""
    scans = scans_of(state.scans)
    if sum(len(each.poses) for each in state.legs) != len(scans):
        raise ValueError("its scans and the places where they were taken are not as many")
    legs, taken = [], 0
    for each in state.legs:
        rows = tuple(scans[taken : taken + len(each.poses)])
        taken += len(rows)
        times = np.array([scan.time for scan in rows], dtype=float)
        stamps = np.array([scan.stamp for scan in rows], dtype=float)
        legs.append(Leg(times, stamps, each.poses, each.covariances, each.twists, rows, each.driven))
    return legs


def _check(state: _State) -> None:
    """Raise ValueError unless the parts fit each other."""
    live, loops, maps = state.live, state.loops, len(state.loops.maps)
    count = len(live.normals)
    if (live.belief.n, live.belief.robot, live.since.n, live.since.robot) != (
        SAMPLES + 2 * count,
        3,
        SAMPLES,
        3,
    ):
        raise ValueError("the open map's arrays do not fit together")
    check_arrays((live.normals, (count, 2), "f"), (live.sightings, (count,), "i"), (live.open, (count,), "i"))
    check_arrays((live.last_pose, (3,), "f"))
    check_arrays((state.start, (3,), "f"), (state.start_covariance, (3, 3), "f"))
    for each in loops.maps:
        size, samples = len(each.mean), len(each.normals)
        check_arrays((each.mean, (3 + 2 * samples,), "f"), (each.packed, (size * (size + 1) // 2,), "f"))
        check_arrays((each.normals, (samples, 2), "f"), (each.sightings, (samples,), "i"))
    check_arrays((loops.frames, (max(1, maps), 3), "f"), (loops.misfits, (len(loops.misfits),), "f"))
    for relation in loops.relations:
        check_arrays((relation.pose, (3,), "f"), (relation.information, (3, 3), "f"))
    for glimpse in loops.glimpses:
        check_arrays((glimpse.pose, (3,), "f"), (glimpse.covariance, (3, 3), "f"))
        check_arrays((glimpse.found.with_end, (3, 3), "f"))
    pairs = [(each.first, each.second) for each in loops.relations]
    pairs += [(each.first, each.second) for each in loops.glimpses]
    pairs += [(first, second) for first, second, _ in loops.open]
    if any(not 0 <= first < second < maps for first, second in pairs):
        raise ValueError("a relation is between maps that are not there")
    for places in (*state.legs, state.ends):
        check_arrays(
            (places.poses, (len(places.poses), 3), "f"), (places.covariances, (len(places.poses), 3, 3), "f")
        )
    rows = len(state.late.ends)
    check_arrays((state.late.begins, (rows,), "f"), (state.late.ends, (rows,), "f"))
    check_arrays((state.late.ways, (rows, 3), "f"), (state.late.covariances, (rows, 3, 3), "f"))
    check_arrays((state.late.poses, (rows, 3), "f"))
    if (np.diff(state.late.ends) < 0.0).any() or (state.late.ends < state.late.begins).any():
        raise ValueError("its odometry is not in the order of time")
    check_arrays((state.twist, (3,), "f"), *((each.driven, (2, 2), "f") for each in state.legs))
    check_arrays(*((each.twists, (len(each.poses), 3), "f") for each in state.legs))
    if (len(state.legs), len(state.ends.poses)) != (maps + 1, maps):
        raise ValueError("its closed maps and their legs are not as many")
