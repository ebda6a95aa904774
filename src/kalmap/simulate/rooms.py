"""Floors of many rooms: a ring of corridors with rooms around it, drawn at random but always the same for a number."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmap.records import ConfigError
from kalmap.simulate.courses import map_stream
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.floors import DOOR, WALL, WIDE, Plan, finished, line_with_doors, sick
from kalmap.simulate.plans import Box, Point, corridor

_MOST_ROOMS = 200
_WIDTHS, _DEPTHS = (4.0, 7.0), (4.0, 6.5)
# m: least ring, by its middle; off the walls inside a room; how far inside the ring's corners rooms begin
_LEAST, _OFF_WALLS, _CORNER = (14.0, 9.0), 1.2, 0.3
_ROUND = 0.5  # share of the rooms that are driven round; into the others the robot only looks


def rooms_world(count: int, map_seed: int = 1, *, name: str | None = None, **overrides: Any) -> FloorWorld:
    """A ring of corridors with `count` rooms outside it, on average a quarter on each side; another `map_seed`,
    another floor.

    The robot goes once round the ring and a bit farther, and on its way into every room: round half of them, into the
    middle of the others and back. overrides: fields of `FloorWorld`. Raises ConfigError for less than one room or
    more than 200.
    """
    name = name or f"rooms-{count}" + ("" if map_seed == 1 else f"-{map_seed}")
    if not 1 <= count <= _MOST_ROOMS:
        raise ConfigError(f"{name}: take 1 to {_MOST_ROOMS} rooms")
    rng = np.random.default_rng(np.random.SeedSequence((map_seed, 21, count)))
    return _ring(name, _deal(count, rng), rng, 1, overrides)


def office(*, name: str = "office", **overrides: Any) -> FloorWorld:
    """An office floor with a SICK scanner: twelve rooms and a ring of corridors, driven twice, the rooms visited on
    the first lap: about 300 m."""
    rng = map_stream(21, 12)
    return _ring(name, _deal(12, rng), rng, 2, sick(overrides))


def _deal(count: int, rng: np.random.Generator) -> list[list[tuple[float, float]]]:
    """Width and depth of the rooms on the four sides; the long sides get more."""
    sides: list[list[tuple[float, float]]] = [[], [], [], []]
    for number in range(count):
        sides[(0, 2, 1, 0, 2, 3)[number % 6]].append((rng.uniform(*_WIDTHS), rng.uniform(*_DEPTHS)))
    return sides


def _ring(
    name: str,
    sides: list[list[tuple[float, float]]],
    rng: np.random.Generator,
    laps: int,
    overrides: dict[str, Any],
) -> FloorWorld:
    needs = [sum(width + WALL for width, _ in side) + 2.0 * _CORNER for side in sides]
    long = round(max(_LEAST[0], needs[0], needs[2]), 2)
    short = round(max(_LEAST[1], needs[1], needs[3]), 2)
    centre: list[Point] = [(0.0, 0.0), (long, 0.0), (long, short), (0.0, short)]
    plan = Plan(corridor(centre, WIDE))
    lap: list[Point] = []
    for number, side in enumerate(sides):
        lap.append(centre[number])
        spare = (long, short)[number % 2] - needs[number]
        lap += _side(plan, _Side(centre, number), side, spare, rng)
    line_with_doors(plan, centre, rng)
    plan.areas += [(*box, 1.0) for box in plan.free[:4]]
    plain = [*centre[1:], centre[0]]
    way: list[Point] = [(1.5, 0.0), *lap[1:], centre[0]]
    way += plain * (laps - 1)
    way.append((long * 0.5, 0.0))
    return finished(name, plan.walls(), _apart(way), plan.areas, (np.array(centre),), overrides)


class _Side:
    """One side of the ring: places on it by how far along its middle line, and how far out of it."""

    def __init__(self, centre: list[Point], number: int) -> None:
        self.start = np.array(centre[number])
        self.ahead = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][number])
        self.out = np.array([self.ahead[1], -self.ahead[0]])

    def point(self, along: float, out: float) -> Point:
        x, y = np.round(self.start + along * self.ahead + out * self.out, 3)
        return float(x), float(y)

    def box(self, first: float, last: float, near: float, far: float) -> Box:
        (a, b), (c, d) = self.point(first, near), self.point(last, far)
        return min(a, c), min(b, d), max(a, c), max(b, d)


def _side(
    plan: Plan, side: _Side, rooms: list[tuple[float, float]], spare: float, rng: np.random.Generator
) -> list[Point]:
    """Carve the rooms of one side; the way along it, into every room and out again."""
    way: list[Point] = []
    wall = 0.5 * WIDE + WALL
    gaps = spare * np.diff(np.sort(rng.random(len(rooms))), prepend=0.0)
    at = _CORNER
    for (width, depth), gap in zip(rooms, gaps):
        at += gap + 0.5 * WALL
        low, high = at, at + width
        door = rng.uniform(max(low, WIDE) + 0.9, high - 0.9)
        plan.room(side.box(low, high, wall, wall + depth), 0.25 * width * depth)
        plan.free.append(side.box(door - 0.5 * DOOR, door + 0.5 * DOOR, 0.5 * WIDE, wall))
        way.append(side.point(door, 0.0))
        if rng.random() < _ROUND:
            near, far = wall + _OFF_WALLS, wall + depth - _OFF_WALLS
            left, right = low + _OFF_WALLS, high - _OFF_WALLS
            way += [side.point(door, near)]
            way += [side.point(*place) for place in ((right, near), (right, far), (left, far), (left, near))]
            way += [side.point(door, near)]
        else:
            way.append(side.point(door, wall + 0.5 * depth))
        way.append(side.point(door, 0.0))
        at = high + 0.5 * WALL
    return way


def _apart(way: list[Point]) -> list[Point]:
    """The way without points that (nearly) repeat the one before."""
    kept = way[:1]
    for point in way[1:]:
        if abs(point[0] - kept[-1][0]) + abs(point[1] - kept[-1][1]) > 0.05:
            kept.append(point)
    return kept
