"""From a world and a seed to a log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.records import Event, Log, Odometry, Reference, Sightings, Skipped
from kalmap.simulate.drive import Drive, drive
from kalmap.simulate.sense import visible
from kalmap.simulate.world import World


def simulate(world: World, seed: int) -> Log:
    """Drive through the world and write down what a vehicle with this noise would have logged.

    The log alternates one `Odometry` block (the control steps since the last look; speed m/s and steering
    rad with noise, while the true vehicle obeys the noise-free ones) and one `Sightings` frame, which may
    be empty; ids are the rows of `world.landmarks`. A last block without a frame follows if the drive
    does not end on one. The reference holds the true pose at t = 0 and after every control step.

    The same world and seed give the same log. Odometry and sightings draw from independent streams
    spawned from `SeedSequence(seed)`, so worlds that differ only in their sigmas share their random
    numbers. Raises `KalmapError` if the drive never arrives.
    """
    course = drive(world)
    control_stream, sight_stream = np.random.SeedSequence(seed).spawn(2)
    controls = _noisy_controls(world, course, np.random.default_rng(control_stream))
    frames = _noisy_sightings(world, course, np.random.default_rng(sight_stream))
    times = world.dt * np.arange(len(course.poses))
    reference = Reference(
        frame="map",
        kind="truth",
        times=times,
        positions=np.ascontiguousarray(course.poses[:, :2]),
        headings=np.ascontiguousarray(course.poses[:, 2]),
        landmark_ids=np.arange(len(world.landmarks), dtype=np.int64),
        landmarks=np.array(world.landmarks, dtype=float),
    )
    return Log(
        name=world.name,
        source=f"world:{world.name} seed:{seed}",
        defaults=world.defaults(),
        open=partial(_replay, tuple(_events(world, times, controls, frames))),
        references=(reference,),
        settings=_settings(world, seed),
    )


def _settings(world: World, seed: int) -> dict[str, Any]:
    """What the log can be simulated from again: every number, and a hash of the map."""
    scalars = {
        name: value
        for name, value in msgspec.structs.asdict(world).items()
        if not isinstance(value, np.ndarray)
    }
    drawn = np.ascontiguousarray(world.landmarks, dtype=float).tobytes()
    drawn += np.ascontiguousarray(world.waypoints, dtype=float).tobytes()
    return {"world": scalars, "seed": seed, "map_sha256": hashlib.sha256(drawn).hexdigest()}


def _replay(events: tuple[Event, ...], skip: Callable[[Skipped], None] | None) -> Iterator[Event]:
    """Hand the events out again; nothing in a simulated log can be bad, so `skip` is never called."""
    return iter(events)


def _noisy_controls(world: World, course: Drive, rng: np.random.Generator) -> np.ndarray:
    """(T, 2) speed m/s and steering rad, each sample with its own noise."""
    exact = np.column_stack([np.full(len(course.steering), float(world.speed)), course.steering])
    sigmas = np.array([world.sigma_speed, np.radians(world.sigma_steering_deg)])
    return exact + sigmas * rng.standard_normal(exact.shape)


def _noisy_sightings(
    world: World, course: Drive, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values (M, 2) and ids (M,) of every frame, in order."""
    looks = course.poses[world.observe_every :: world.observe_every]
    frame, feature, exact = visible(
        looks, np.asarray(world.landmarks, dtype=float), world.max_range, world.field_of_view_deg
    )
    sigmas = np.array([world.sigma_range, np.radians(world.sigma_bearing_deg)])
    values = exact + sigmas * rng.standard_normal(exact.shape)
    values[:, 0] = np.abs(values[:, 0])  # a feature at the sensor's feet: no scanner gives a negative range
    values[:, 1] = wrap(values[:, 1])
    feature = feature.astype(np.int64)
    edges = np.searchsorted(frame, np.arange(len(looks) + 1))
    return [(values[a:b], feature[a:b]) for a, b in pairwise(edges)]


def _events(
    world: World, times: np.ndarray, controls: np.ndarray, frames: list[tuple[np.ndarray, np.ndarray]]
) -> Iterator[Event]:
    block = world.observe_every
    durations = np.full(block, float(world.dt))
    for number, (values, ids) in enumerate(frames):
        first, end = number * block, (number + 1) * block
        time = float(times[end])
        yield Odometry(time, controls[first:end], durations, record=first + 1)
        yield Sightings(time, values, ids, record=number + 1)
    first = len(frames) * block
    if first < len(controls):
        yield Odometry(
            float(times[-1]), controls[first:], durations[: len(controls) - first], record=first + 1
        )
