"""Pedestrians: where those who walk about among the features are at every look of the sensor."""

from __future__ import annotations

import math

import numpy as np

from kalmap.simulate.streams import streams
from kalmap.simulate.world import World

# rad / sqrt(s): how far a heading strays; a quarter turn off after half a minute
_TURN = math.radians(15.0)


def mover_tracks(world: World, seed: int, frames: int) -> np.ndarray:
    """(frames, movers, 2) m: where every mover is in every frame, with the log's own seed.

    A mover starts anywhere in the box around the features and walks straight from frame to frame at
    `mover_speed`; its heading is a random walk in time. At a border it is mirrored back. A side of the box
    that is shorter than `max_range` is taken to be that long, and without features the box lies around the
    way-points. With the same seed and number of frames the first movers of a world with more of them are
    the same.
    """
    drawn = streams(seed)
    low, sides = _box(world)
    start = drawn["starts"].random((world.movers, 3))
    step_time = world.dt * world.observe_every
    turns = _TURN * math.sqrt(step_time) * drawn["turns"].standard_normal((world.movers, frames))
    heading = 2.0 * np.pi * start[:, 2:] + np.cumsum(turns, axis=1)
    steps = world.mover_speed * step_time * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    walked = start[:, None, :2] * sides + np.cumsum(steps, axis=1)
    # A mirror at each border is a triangle wave of the way without borders.
    inside = sides - np.abs(sides - np.mod(walked, 2.0 * sides))
    return np.ascontiguousarray(np.swapaxes(low + inside, 0, 1))


def _box(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Least corner (2,) and sides (2,) in m of the box that the movers keep to."""
    points = np.asarray(world.landmarks if len(world.landmarks) else world.waypoints, dtype=float)
    low, high = points.min(axis=0), points.max(axis=0)
    sides = np.maximum(high - low, world.max_range)
    return (low + high - sides) / 2.0, sides
