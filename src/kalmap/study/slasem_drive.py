"""A drive through a floor mapped by SLASEM: one map that grows, or local maps that are closed and joined."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.models.motion import motion_from_config
from kalmap.records import Log, Odometry, RunConfig, Scan
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.live import LiveMap, Rules, prepare, rules_of
from kalmap.slam.filters import resolve_filter


class Driven(msgspec.Struct):
    """What a drive left behind.

    times: (F,) s of the scans; part: which local map each was in; poses: (F, 3) in that map. live_seconds: (F,) that
    the live map took from scan to scan; join_seconds: (F,) that closing and joining took there. samples: (F,) in the
    live map. maps: the closed maps, the last one closed at the end of the drive.
    """

    times: np.ndarray
    part: np.ndarray
    poses: np.ndarray
    live_seconds: np.ndarray
    join_seconds: np.ndarray
    samples: np.ndarray
    maps: list[ClosedMap]


def rules_for(config: RunConfig) -> Rules:
    """The rules of the local maps, from the settings of a run."""
    lineariser, _ = resolve_filter(config.filter)
    motion = motion_from_config(config.motion)
    return rules_of(motion, lineariser, config.filter.coordinates, config.sensor, config.contour)


def closed_map(live: LiveMap) -> ClosedMap:
    """What stays of a live map: pose and samples; the scanner's calibration is marginalised out."""
    belief = live.belief
    belief.flush()
    kept = np.concatenate([np.arange(3), np.arange(belief.n - 2 * live.count, belief.n)])
    return ClosedMap(
        belief.mean[kept],
        belief.block(kept),
        live.normals.copy(),
        live.sightings.copy(),
        live.rules.contour.spacing,
    )


def drive_floor(
    log: Log, config: RunConfig, close: Callable[[ClosedMap], None] | None, most_scans: int | None = None
) -> Driven:
    """Feed the log's events; a scan is used every `update_distance` or `update_angle_deg`.

    close: takes every local map that is closed at `close_samples`; None keeps one map.
    """
    rules, settings = rules_for(config), config.contour
    live = LiveMap(rules)
    maps: list[ClosedMap] = []
    used: np.ndarray | None = None
    rows: list[tuple[float, int, np.ndarray, float, float, int]] = []
    live_time = 0.0
    for event in log:
        started = time.perf_counter()
        if isinstance(event, Odometry):
            live.predict(event)
            live_time += time.perf_counter() - started
            continue
        if not isinstance(event, Scan):
            continue
        if used is None or _moved(used, live.pose, settings.update_distance, settings.update_angle_deg):
            live.observe(prepare(event, rules, live.calibration.mean))
            used = live.pose
        live_time += time.perf_counter() - started
        row = (event.time, len(maps), live.pose, live_time, live.count)
        started, live_time = time.perf_counter(), 0.0
        if close is not None and live.count >= settings.close_samples:
            maps.append(closed_map(live))
            live, used = LiveMap(rules, live.calibration), None
            close(maps[-1])
        rows.append((*row[:4], time.perf_counter() - started, row[4]))
        if most_scans is not None and len(rows) >= most_scans:
            break
    maps.append(closed_map(live))
    if close is not None:
        started = time.perf_counter()
        close(maps[-1])
        rows[-1] = (*rows[-1][:4], rows[-1][4] + time.perf_counter() - started, rows[-1][5])
    times, part, poses, live_seconds, join_seconds, samples = (
        np.array(each) for each in zip(*rows, strict=True)
    )
    return Driven(times, part, poses, live_seconds, join_seconds, samples, maps)


def _moved(before: np.ndarray, now: np.ndarray, distance: float, angle_deg: float) -> bool:
    """Whether the vehicle has gone as far or turned as much as one update is made for."""
    far = math.hypot(now[0] - before[0], now[1] - before[1]) >= distance
    return far or abs(float(wrap(now[2] - before[2]))) >= math.radians(angle_deg)
