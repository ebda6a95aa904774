"""What a laser scanner reports on a floor: noise, steps, beams that do not come back, beams that see two things."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.se2 import compose
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.raycast import cast

_EDGE = 0.1  # m from beam to beam that make an edge

Streams = dict[str, np.random.Generator]


def beams_of(world: FloorWorld) -> np.ndarray:
    """(B,) rad: the bearings in the order of the device's own sweep; they fall where it hangs upside down."""
    bearings = world.device.bearings
    return np.ascontiguousarray(-bearings) if world.upside_down else bearings


def floor_ranges(
    world: FloorWorld,
    poses: np.ndarray,
    walls: np.ndarray,
    circles: np.ndarray,
    people: np.ndarray,
    drawn: Streams,
) -> np.ndarray:
    """(F, B) m, +inf where nothing came back: each sweep taken in one instant by a robot at `poses` (F, 3).

    walls (S, 4), circles (C, 3), people (F, K, 3), all in the plan. One number of each kind is drawn for every beam,
    whatever it meets, so that floors that differ in one thing share the other random numbers.
    """
    bearings = beams_of(world)
    sensor = compose(poses, world.mount)
    exact = cast(sensor, circles, bearings, world.max_range, moving=people, segments=walls)
    ranges = _mixed(exact, world.mixed_pixels, drawn["mixed-pixels"])
    scale = np.where(np.isfinite(ranges), ranges, 0.0)
    sigma = np.hypot(world.sigma_beam, world.sigma_beam_ratio * scale)
    ranges = np.abs(ranges + sigma * drawn["beams"].standard_normal(ranges.shape))
    if world.quantum:
        ranges = world.quantum * np.rint(ranges / world.quantum)
    rated = world.device.max_range
    beyond = np.zeros(ranges.shape)
    if world.max_range > rated:
        beyond = np.clip((scale - rated) / (world.max_range - rated), 0.0, 1.0)
    lost = drawn["dropouts"].random(ranges.shape) < world.dropout + (1.0 - world.dropout) * beyond
    ranges[lost | (ranges > world.max_range)] = np.inf
    return ranges


def _mixed(exact: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Ranges of which some beside an edge lie anywhere between its two sides."""
    chance, place = rng.random((2, *exact.shape))
    ranges = exact.copy()
    here, there = exact[:, :-1], exact[:, 1:]
    both = np.isfinite(here) & np.isfinite(there)
    jump = np.subtract(there, here, out=np.zeros(here.shape), where=both)
    hit = (np.abs(jump) > _EDGE) & (chance[:, :-1] < share)
    ranges[:, :-1][hit] += place[:, :-1][hit] * jump[hit]
    return ranges
