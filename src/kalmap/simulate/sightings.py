"""What a sensor that sights landmarks reports in every frame: seen, missed, twice, moving, or not there at all."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.records import Sightings
from kalmap.simulate.sense import visible
from kalmap.simulate.world import World

Streams = dict[str, np.random.Generator]
# frame (M,), id (M,) and range m, bearing rad (M, 2) of sightings
_Part = tuple[np.ndarray, np.ndarray, np.ndarray]


class Frames(msgspec.Struct, frozen=True):
    """The sightings of all frames one after the other; iterated, a `Sightings` for every frame, made on the way.

    times: (F,) s. edges: (F + 1,) where each frame begins in ids (M,) and values (M, 2). Large worlds have millions.
    """

    times: np.ndarray
    edges: np.ndarray
    ids: np.ndarray
    values: np.ndarray

    def __iter__(self) -> Iterator[Sightings]:
        for number, (time, (a, b)) in enumerate(zip(self.times, pairwise(self.edges), strict=True)):
            yield Sightings(float(time), self.values[a:b], self.ids[a:b], record=number + 1)


NO_LANDMARK = -1


def sightings_of(
    world: World, looks: np.ndarray, times: np.ndarray, tracks: np.ndarray, drawn: Streams
) -> Frames:
    """What is sighted in every frame, in order; one may be empty.

    looks (F, 3): the sensor's poses at `times` (F,) s. tracks (F, K, 2): where the movers are. An id is the row of
    the landmark, also for a second sighting of it, and `NO_LANDMARK` for movers and clutter. Features alone come
    in the order of their rows; with anything else among them a frame is shuffled, so that the order tells nothing.
    """
    parts = _features(world, looks, drawn)
    if world.movers:
        parts.append(_movers(world, looks, tracks, drawn))
    if world.clutter:
        parts.append(_clutter(world, len(looks), drawn["clutter"]))
    frame, ids, values = (np.concatenate(pieces) for pieces in zip(*parts))
    if world.movers or world.clutter or world.doubles:
        order = np.lexsort((drawn["order"].random(len(frame)), frame))
        frame, ids, values = frame[order], ids[order], values[order]
    edges = np.searchsorted(frame, np.arange(len(looks) + 1))
    return Frames(times, edges, ids, values)


def _features(world: World, looks: np.ndarray, drawn: Streams) -> list[_Part]:
    """The features that are in view and not missed, and their second sightings.

    Numbers are drawn for the missed ones too: who is missed changes nothing about the others.
    """
    landmarks = np.asarray(world.landmarks, dtype=float)
    frame, feature, exact = _in_view(world, looks, landmarks)
    feature = feature.astype(np.int64)
    first = _noisy(world, exact, drawn["sightings"])
    seen = drawn["detections"].random(len(frame)) < _chances(world, exact[:, 0])
    parts = [(frame[seen], feature[seen], first[seen])]
    if world.doubles:
        twice = seen & (drawn["doubles"].random(len(frame)) < world.doubles)
        second = _noisy(world, exact, drawn["doubles"])
        parts.append((frame[twice], feature[twice], second[twice]))
    return parts


def _movers(world: World, looks: np.ndarray, tracks: np.ndarray, drawn: Streams) -> _Part:
    frame, _, exact = _in_view(world, looks, tracks)
    values = _noisy(world, exact, drawn["mover-sightings"])
    seen = drawn["mover-detections"].random(len(frame)) < _chances(world, exact[:, 0])
    return frame[seen], np.full(int(seen.sum()), NO_LANDMARK), values[seen]


def _clutter(world: World, frames: int, rng: np.random.Generator) -> _Part:
    frame = np.repeat(np.arange(frames), rng.poisson(world.clutter, frames))
    shares = rng.random((len(frame), 2))
    depth = world.max_range - world.min_range
    ranges = world.min_range + depth * (1.0 - shares[:, 0])  # never 0: nothing stands in the sensor itself
    bearings = np.radians(world.field_of_view_deg) * (shares[:, 1] - 0.5)
    return frame, np.full(len(frame), NO_LANDMARK), np.column_stack([ranges, bearings])


def _in_view(world: World, looks: np.ndarray, points: np.ndarray) -> _Part:
    return visible(looks, points, world.max_range, world.field_of_view_deg, world.min_range)


def _chances(world: World, ranges: np.ndarray) -> np.ndarray | float:
    """The probability that what stands at these ranges (M,) m is sighted; one number if it is the same everywhere."""
    near, far = world.detection_probability, world.detection_far
    return near if far is None else near + (far - near) * ranges / world.max_range


def _noisy(world: World, exact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    sigmas = np.array([world.sigma_range, np.radians(world.sigma_bearing_deg)])
    values = exact + sigmas * rng.standard_normal(exact.shape)
    values[:, 0] = np.abs(values[:, 0])  # a feature at the sensor's feet: no scanner gives a negative range
    values[:, 1] = wrap(values[:, 1])
    return values
