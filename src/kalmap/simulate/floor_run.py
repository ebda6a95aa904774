"""From a floor and a seed to a log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose, inverse
from kalmap.records import Event, Log, Odometry, Reference, Scan, Skipped
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.floor_drive import FloorDrive, floor_drive
from kalmap.simulate.floor_scans import beams_of, floor_ranges
from kalmap.simulate.furniture import furnish
from kalmap.simulate.plans import arc
from kalmap.simulate.streams import streams
from kalmap.simulate.walkers import walkers

_TRUE_SAGITTA = 1e-3  # m, of the chords that stand for a circle in the reference


def simulate_floor(world: FloorWorld, seed: int) -> Log:
    """Drive through the floor and write down what wheels and scanner would have logged.

    For each scan an `Odometry` block of one sample, the increment dx, dy, dtheta in the frame that the robot had at
    the scan before (zero before the first, at t = 0), and then the `Scan`. The reference holds the true pose at every
    scan and the true walls, columns and furniture as segments, both in the frame in which the robot starts at
    (0, 0, 0); people are not in it. The same floor and seed give the same log.
    """
    drawn = streams(seed)
    course = floor_drive(world)
    furniture, legs = furnish(world, course.poses[:, :2], drawn["furniture"])
    walls, circles = np.concatenate([world.walls, furniture]), np.concatenate([world.columns, legs])
    people = walkers(world, course.times, course.poses[:, :2], drawn["starts"], drawn["turns"])
    ranges = floor_ranges(world, course.poses, walls, circles, people, drawn)
    increments = wheel_odometry(world, course.poses, drawn["controls"])
    return Log(
        name=world.name,
        source=f"world:{world.name} seed:{seed}",
        defaults=world.defaults(),
        open=partial(_replay, course.times, increments, ranges, beams_of(world)),
        references=(_reference(course, walls, circles),),
        truth_ids=False,
        settings=_settings(world, seed),
    )


def wheel_odometry(world: FloorWorld, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(F, 3) m, m, rad: what the wheels say of the way from each pose to the next, zero before the first.

    Noise as `MotionConfig` states it for increments, on top of the systematic errors; none where nothing moves.
    """
    exact = np.concatenate([np.zeros((1, 3)), compose(inverse(poses[:-1]), poses[1:])])
    way = np.hypot(exact[:, 0], exact[:, 1])
    said = exact.copy()
    said[:, :2] *= 1.0 + world.distance_scale
    said[:, 2] += np.radians(world.heading_bias_deg) * way
    along = world.sigma_distance_ratio * way
    turn = np.hypot(np.radians(world.sigma_rotation_deg), world.sigma_rotation_ratio * exact[:, 2])
    moved = (exact != 0.0).any(axis=1)
    noise = rng.standard_normal(exact.shape) * np.column_stack([along, along, turn])
    return said + noise * moved[:, None]


def _reference(course: FloorDrive, walls: np.ndarray, circles: np.ndarray) -> Reference:
    T_map_plan = inverse(course.poses[0])
    poses = compose(T_map_plan, course.poses)
    rounds = [arc(x, y, radius, 0.0, 360.0, _TRUE_SAGITTA) for x, y, radius in circles]
    ends = np.concatenate([walls, *rounds]).reshape(-1, 2)
    moved = compose(T_map_plan, np.column_stack([ends, np.zeros(len(ends))]))[:, :2]
    return Reference(
        frame="map",
        kind="truth",
        times=course.times,
        positions=np.ascontiguousarray(poses[:, :2]),
        headings=np.ascontiguousarray(poses[:, 2]),
        walls=np.ascontiguousarray(moved).reshape(-1, 4),
    )


def _settings(world: FloorWorld, seed: int) -> dict[str, Any]:
    """What the log can be simulated from again: every number, and a hash of the plan."""
    values = msgspec.structs.asdict(world)
    arrays = [world.walls, world.columns, world.areas, world.waypoints, *world.walkways]
    drawn = b"".join(np.ascontiguousarray(array, dtype=float).tobytes() for array in arrays)
    scalars = {name: value for name, value in values.items() if not isinstance(value, (np.ndarray, tuple))}
    return {"world": scalars, "seed": seed, "map_sha256": hashlib.sha256(drawn).hexdigest()}


def _replay(
    times: np.ndarray,
    increments: np.ndarray,
    ranges: np.ndarray,
    bearings: np.ndarray,
    skip: Callable[[Skipped], None] | None,
) -> Iterator[Event]:
    """The events, made as they are asked for; nothing in a simulated log can be bad, so `skip` is never called."""
    durations = np.diff(times, prepend=times[0])
    for row, time in enumerate(times):
        yield Odometry(float(time), increments[row : row + 1], durations[row : row + 1], record=row + 1)
        yield Scan(float(time), ranges[row], bearings, record=row + 1)
