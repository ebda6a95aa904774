"""From a world and a seed to a log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import msgspec
import numpy as np

from kalmap.records import Event, Log, Odometry, Reference, Scan, Sightings, Skipped
from kalmap.simulate.drive import Drive, drive
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.floor_run import simulate_floor
from kalmap.simulate.movers import mover_tracks
from kalmap.simulate.scans import scans_of
from kalmap.simulate.sightings import sightings_of
from kalmap.simulate.streams import streams
from kalmap.simulate.world import SCANNERS, World


def simulate(world: World | FloorWorld, seed: int) -> Log:
    """Drive through the world and write down what a vehicle with this noise would have logged.

    The log alternates one `Odometry` block (the control steps since the last look; speed m/s and steering
    rad with noise, while the true vehicle obeys the noise-free ones) and one `Sightings` frame, which may
    be empty. Ids are the rows of `world.landmarks`, also for doubles, and -1 for movers and clutter, which
    are known to be no landmark (`false_ids`). A last block without a frame follows if the drive does not
    end on one. The reference holds the true pose at t = 0 and after every control step.

    A world with a scanner gives a `Scan` instead of each `Sightings`, without ids; the log's
    `sighting_truth` then lists, for each scan, the trunks that a beam hits.

    The same world and seed give the same log. Every source of randomness has its own stream
    (`kalmap.simulate.streams`), so worlds that differ only in their sigmas, or in their clutter, share their
    random numbers. Raises `KalmapError` if the drive never arrives.

    A floor is driven by other rules: see `kalmap.simulate.floor_run.simulate_floor`.
    """
    if isinstance(world, FloorWorld):
        return simulate_floor(world, seed)
    course = drive(world)
    drawn = streams(seed)
    controls = _noisy_controls(world, course, drawn["controls"])
    times = world.dt * np.arange(len(course.poses))
    looks, look_times = (
        column[world.observe_every :: world.observe_every] for column in (course.poses, times)
    )
    tracks = mover_tracks(world, seed, len(looks))
    frames: Iterable[Sightings | Scan]
    truth = None
    if world.scanner is None:
        frames = sightings_of(world, looks, look_times, tracks, drawn)
    else:
        frames, truth = scans_of(world, SCANNERS[world.scanner], looks, look_times, tracks, drawn["beams"])
    return Log(
        name=world.name,
        source=f"world:{world.name} seed:{seed}",
        defaults=world.defaults(),
        open=partial(_events, world.observe_every, world.dt, times, controls, frames),
        references=(_reference(world, course, times),),
        settings=_settings(world, seed),
        false_ids=True,
        sighting_truth=truth,
    )


def _reference(world: World, course: Drive, times: np.ndarray) -> Reference:
    return Reference(
        frame="map",
        kind="truth",
        times=times,
        positions=np.ascontiguousarray(course.poses[:, :2]),
        headings=np.ascontiguousarray(course.poses[:, 2]),
        landmark_ids=np.arange(len(world.landmarks), dtype=np.int64),
        landmarks=np.array(world.landmarks, dtype=float),
    )


def _settings(world: World, seed: int) -> dict[str, Any]:
    """What the log can be simulated from again: every number, and a hash of the map."""
    scalars = {
        name: value
        for name, value in msgspec.structs.asdict(world).items()
        if name not in ("landmarks", "waypoints", "radii")
    }
    drawn = np.ascontiguousarray(world.landmarks, dtype=float).tobytes()
    drawn += np.ascontiguousarray(world.waypoints, dtype=float).tobytes()
    if world.radii is not None:
        drawn += np.ascontiguousarray(world.radii, dtype=float).tobytes()
    return {"world": scalars, "seed": seed, "map_sha256": hashlib.sha256(drawn).hexdigest()}


def _noisy_controls(world: World, course: Drive, rng: np.random.Generator) -> np.ndarray:
    """(T, 2) speed m/s and steering rad, each sample with its own noise."""
    exact = np.column_stack([np.full(len(course.steering), float(world.speed)), course.steering])
    sigmas = np.array([world.sigma_speed, np.radians(world.sigma_steering_deg)])
    return exact + sigmas * rng.standard_normal(exact.shape)


def _events(
    block: int,
    dt: float,
    times: np.ndarray,
    controls: np.ndarray,
    frames: Iterable[Sightings | Scan],
    skip: Callable[[Skipped], None] | None,
) -> Iterator[Event]:
    """The events, made as they are asked for; nothing in a simulated log can be bad, so `skip` is never called."""
    durations = np.full(block, float(dt))
    first = 0
    for frame in frames:
        yield Odometry(frame.time, controls[first : first + block], durations, record=first + 1)
        yield frame
        first += block
    if first < len(controls):
        yield Odometry(
            float(times[-1]), controls[first:], durations[: len(controls) - first], record=first + 1
        )
