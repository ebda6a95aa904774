"""A drive through a floor mapped by SLASEM: one map that grows, or local maps that are closed and joined."""

from __future__ import annotations

import math
import time
from typing import Any

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose
from kalmap.models.motion import motion_from_config
from kalmap.records import Log, Odometry, RunConfig, Scan
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.join import join_contours
from kalmap.slam.contours.live import LiveMap
from kalmap.slam.contours.seen import Rules, prepare, rules_of
from kalmap.slam.contours.worker import closed
from kalmap.slam.filters import resolve_filter
from kalmap.slam.submaps.forest import Forest, chain


class Driven(msgspec.Struct):
    """What a drive left behind.

    times: (F,) s of the scans. online: (F, 3) the pose in the map as it was known then; final: (F, 3) as the joined map
    has it in the end. live_seconds: (F,) that the live map took from scan to scan; join_seconds: (F,) that closing a
    map and the joins took there. samples: (F,) in the live map.
    local: (N, 2) m of every closed map, placed by the drive alone; maps: in the end, one, or several where a join was
    refused, in the first one's frame. refusals: of joins.
    """

    times: np.ndarray
    online: np.ndarray
    final: np.ndarray
    live_seconds: np.ndarray
    join_seconds: np.ndarray
    samples: np.ndarray
    local: list[np.ndarray]
    maps: list[np.ndarray]
    refusals: int


class Course(msgspec.Struct):
    """What is noted at every scan: time, local map, pose in it, seconds, samples, pose in the map."""

    rows: list[tuple[Any, ...]] = []

    def columns(self) -> list[np.ndarray]:
        """One array for each quantity."""
        return [np.array(each) for each in zip(*self.rows, strict=True)]


def rules_for(config: RunConfig) -> Rules:
    """The rules of the local maps, from the settings of a run; the wheels are taken at their word, as published."""
    lineariser, _ = resolve_filter(config.filter)
    motion = motion_from_config(config.motion)
    published = msgspec.structs.replace(config.contour, sigma_way_scale=0.0, sigma_turn_scale=0.0)
    return rules_of(motion, lineariser, config.filter.coordinates, config.sensor, published)


def drive_floor(log: Log, config: RunConfig, divide: bool, most_scans: int | None = None) -> Driven:
    """Feed the log's events; a scan is used every `update_distance` or `update_angle_deg`.

    divide: local maps are closed at `close_samples` alone, as published, and joined where the binary counter carries;
    else one map grows. most_scans: end after so many.
    """
    rules, settings = rules_for(config), config.contour
    live, course = LiveMap(rules), Course([])
    forest: Forest[ClosedMap] = Forest(join_contours)
    local, base, before = [], np.zeros(3), np.zeros(3)
    used: np.ndarray | None = None
    spent, part = 0.0, 0
    for event in log:
        started = time.process_time()
        if isinstance(event, Odometry):
            live.predict(event)
        elif isinstance(event, Scan):
            if used is None or _moved(used, live.pose, settings.update_distance, settings.update_angle_deg):
                live.observe(prepare(event, rules, live.calibration.mean, np.zeros(3)))
                used = live.pose
            ended = time.process_time()
            row = (event.time, part, live.pose, compose(base, live.pose), spent + ended - started, live.count)
            started, spent = ended, 0.0
            if divide and live.count >= settings.close_samples:
                forest.close(marked(closed(live)))
                base, part, used = chain(forest.maps)[0], part + 1, None
                local.append(_placed(before, live.samples))
                before = compose(before, live.pose)
                live = LiveMap(rules, live.calibration, live.noise)
                live.observe(prepare(event, rules, live.calibration.mean, np.zeros(3)))
                used = live.pose
            course.rows.append((*row, time.process_time() - started))
            if most_scans is not None and len(course.rows) >= most_scans:
                break
            continue
        spent += time.process_time() - started
    started = time.process_time()
    forest.close(marked(closed(live)))
    forest.finish()
    course.rows[-1] = (*course.rows[-1][:-1], course.rows[-1][-1] + (time.process_time() - started) * divide)
    local.append(_placed(before, live.samples))
    return _driven(course, forest, local)


def marked(each: ClosedMap) -> ClosedMap:
    """The map with two points more, which are on no contour: its start, and a metre ahead of that.

    They have no normal and no uncertainty, so nothing is matched to them, but joins move them along with all the rest:
    afterwards they say where the map's frame has come to lie.
    """
    mean = np.concatenate([each.mean, [0.0, 0.0, 1.0, 0.0]])
    covariance = np.zeros((len(mean), len(mean)))
    covariance[:-4, :-4] = each.covariance
    normals = np.concatenate([each.normals, np.zeros((2, 2))])
    return ClosedMap(mean, covariance, normals, np.concatenate([each.sightings, [0, 0]]), each.spacing)


def frames_of(each: ClosedMap) -> np.ndarray:
    """(K, 3) frames of the local maps that a joined map is made of, by their marks."""
    marks = each.samples[_is_mark(each)].reshape(-1, 2, 2)
    way = marks[:, 1] - marks[:, 0]
    return np.column_stack([marks[:, 0], np.arctan2(way[:, 1], way[:, 0])])


def _is_mark(each: ClosedMap) -> np.ndarray:
    return np.asarray(~each.normals.any(axis=1))


def _driven(course: Course, forest: Forest[ClosedMap], local: list[np.ndarray]) -> Driven:
    times, part, poses, online, live_seconds, samples, join_seconds = course.columns()
    frames, maps, start = [], [], np.zeros(3)
    for each in forest.maps:
        frames.append(compose(np.broadcast_to(start, (len(frames_of(each)), 3)), frames_of(each)))
        maps.append(_placed(start, each.samples[~_is_mark(each)]))
        start = compose(start, each.end)
    final = compose(np.concatenate(frames)[part], poses)
    return Driven(times, online, final, live_seconds, join_seconds, samples, local, maps, forest.refusals)


def _placed(T_map_own: np.ndarray, points: np.ndarray) -> np.ndarray:
    return compose(
        np.broadcast_to(T_map_own, (len(points), 3)), np.column_stack([points, np.zeros(len(points))])
    )[:, :2]


def _moved(before: np.ndarray, now: np.ndarray, distance: float, angle_deg: float) -> bool:
    """Whether the vehicle has gone as far or turned as much as one update is made for."""
    far = math.hypot(now[0] - before[0], now[1] - before[1]) >= distance
    return far or abs(float(wrap(now[2] - before[2]))) >= math.radians(angle_deg)
