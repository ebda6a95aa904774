"""The floors themselves: where walls stand and where the robot drives; furniture and people come with the seed.

Every plan is drawn from a fixed seed and laid out in millimetres, so a name means the same floor on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from kalmap.simulate.courses import map_stream
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.plans import Box, Point, arc, corridor, meets, outline

WIDE, DOOR, WALL, NICHE = 2.2, 1.0, 0.2, 0.12
"""m: width of a corridor and of a door, thickness of a wall, depth of a closed door in it."""

# share of doors along a corridor that stand open, m from one door to the next, m of a room behind an open one
_OPEN, _APART, _DEEP = 0.3, (2.6, 5.5), (2.5, 4.0)
_PILLAR, _PILLARS = 0.25, 0.25  # m that a pillar stands out of a wall, and how many there are to a door


class Plan(msgspec.Struct):
    """A plan on the drawing board: boxes carved free, solid ones put back, areas for furniture."""

    free: list[Box]
    solid: list[Box] = msgspec.field(default_factory=list)
    areas: list[tuple[float, ...]] = msgspec.field(default_factory=list)

    def room(self, box: Box, furniture: float) -> None:
        """Carve a room and furnish it."""
        self.free.append(box)
        self.areas.append((*box, furniture))

    def walls(self, replaced: list[Box] | None = None) -> np.ndarray:
        """(S, 4) m."""
        return outline(self.free, self.solid, replaced)


def floor_115(*, name: str = "floor-115", **overrides: Any) -> FloorWorld:
    """The kind of floor of Sun et al. (2010), first experiment: into a room, once round it, out, once round the
    corridors: two loops on about 115 m, with a URG-04LX.

    overrides: fields of `FloorWorld`, here and in the other floors.
    """
    centre: list[Point] = [(0.0, 0.0), (26.4, 0.0), (26.4, 15.2), (0.0, 15.2)]
    room: Box = (2.2, -7.1, 10.2, -1.3)
    plan = Plan(corridor(centre, WIDE))
    plan.room(room, 7.0)
    plan.free.append((5.7, room[3], 5.7 + DOOR, -1.1))
    line_with_doors(plan, centre, map_stream(20, 115))
    plan.areas += [(*box, 1.5) for box in plan.free[:4]]
    way: list[Point] = [
        (2.0, 0.0),
        (6.2, 0.0),
        (6.2, -2.5),
        (9.0, -2.5),
        (9.0, -5.9),
        (3.4, -5.9),
        (3.4, -2.5),
    ]
    way += [(6.2, -2.5), (6.2, 0.0), *centre[1:], (0.0, 0.0), (12.9, 0.0)]
    walks = (np.array(centre), np.array([*way[1:8], *way[2:0:-1]]))
    return finished(name, plan.walls(), way, plan.areas, walks, overrides)


def floor_170(*, name: str = "floor-170", **overrides: Any) -> FloorWorld:
    """The kind of floor of Sun et al. (2010), second experiment: once round the corridors, one loop on about 170 m,
    with a URG-04LX."""
    centre: list[Point] = [(0.0, 0.0), (48.0, 0.0), (48.0, 20.0), (30.0, 20.0), (30.0, 33.0), (0.0, 33.0)]
    plan = Plan(corridor(centre, WIDE))
    line_with_doors(plan, centre, map_stream(20, 170))
    plan.areas += [(*box, 2.0) for box in plan.free[:6]]
    way: list[Point] = [(4.0, 0.0), *centre[1:], (0.0, 0.0), (13.0, 0.0)]
    return finished(name, plan.walls(), way, plan.areas, (np.array(centre),), overrides)


def hall(*, name: str = "hall", **overrides: Any) -> FloorWorld:
    """A hall of 26 m x 16 m with round corners, an apse, a rotunda and two rows of round columns, entered from a
    corridor that bends in a quarter circle."""
    box: Box = (0.0, 0.0, 26.0, 16.0)
    corners: list[Box] = [(0, 0, 4, 4), (22, 0, 26, 4), (22, 12, 26, 16), (0, 12, 4, 16)]
    apse: Box = (26.0, 5.0, 29.0, 11.0)
    bend: Box = (-7.0, 6.9, -2.0, 11.9)
    free = [box, apse, (-2.0, 6.9, 0.0, 9.1), bend, (-7.0, 11.9, -4.8, 20.0)]
    inner = arc(-2.0, 11.9, 2.8, 180.0, 270.0)
    curves = [
        arc(4.0, 4.0, 4.0, 180.0, 270.0),
        arc(22.0, 4.0, 4.0, 270.0, 360.0),
        arc(22.0, 12.0, 4.0, 0.0, 90.0),
        arc(4.0, 12.0, 4.0, 90.0, 180.0),
        arc(26.0, 8.0, 3.0, -90.0, 90.0),
        arc(-2.0, 11.9, 5.0, 180.0, 270.0),
        inner,
    ]
    walls = np.concatenate([outline(free, replaced=[*corners, apse, bend]), *curves])
    columns = [(x, y, 0.35) for y in (4.5, 11.5) for x in (5.0, 9.0, 17.0, 21.0)]
    columns.append((13.0, 8.0, 2.0))
    areas = [(8.0, 0.2, 18.0, 1.2, 2.0), (8.0, 14.8, 18.0, 15.8, 2.0)]
    ring: list[Point] = [(5.0, 2.7), (21.0, 2.7), (23.4, 5.2), (24.0, 8.0), (26.8, 8.0), (24.0, 10.0)]
    ring += [(23.4, 11.0), (21.0, 13.3), (5.0, 13.3), (2.6, 11.0), (2.6, 8.0)]
    inside: list[Point] = [(7.0, 8.0), (8.5, 6.2), (13.0, 4.4), (17.5, 6.2), (19.0, 8.0), (17.5, 9.8)]
    inside += [(13.0, 11.6), (8.5, 9.8), (7.0, 8.0)]
    entrance: list[Point] = [(-5.9, 18.0), (-5.9, 11.9), (-5.4, 9.9), (-4.0, 8.5), (-2.0, 8.0)]
    way = [*entrance, (2.6, 8.0), (2.6, 5.2), *ring, *inside, (2.6, 8.0), (-1.0, 8.0)]
    return finished(name, walls, way, areas, (np.array(ring), np.array(inside[:-1])), overrides, columns)


def lab(*, name: str = "lab", **overrides: Any) -> FloorWorld:
    """A room of 15 m x 15 m full of tables and chairs, along its walls shelves whose fronts are broken every few
    decimetres: hardly any contour, and hundreds of thin things. The robot drives through all of its aisles."""
    rng, low, high = map_stream(22, 15), 0.0, 15.0
    box: Box = (low, low, high, high)
    plan = Plan([box])
    for side in range(4):
        at = 0.8
        while at < high - 0.8:
            length, depth, there = rng.uniform(0.1, 0.5), rng.uniform(0.05, 0.45), rng.random() < 0.7
            first, last = (high - depth, high) if side % 2 else (low, low + depth)
            piece = (at, first, at + length, last) if side < 2 else (first, at, last, at + length)
            if there:
                x0, y0, x1, y1 = np.round(piece, 3).tolist()
                plan.solid.append((x0, y0, x1, y1))
            at += length
    for x in (2.6, 8.1):
        for y in (2.6, 6.1, 9.6):
            plan.areas.append((x, y, x + 4.3, y + 2.4, 6.0))
    way: list[Point] = [
        (7.5, 1.6),
        (13.4, 1.6),
        (13.4, 13.2),
        (1.6, 13.2),
        (1.6, 5.5),
        (7.5, 5.5),
        (7.5, 9.1),
    ]
    way += [(13.4, 9.1), (13.4, 5.5), (7.5, 5.5), (7.5, 1.6), (1.6, 1.6), (1.6, 9.1), (6.5, 9.1)]
    return finished(name, plan.walls(), way, plan.areas, (), overrides)


def straight_corridor(*, name: str = "corridor", **overrides: Any) -> FloorWorld:
    """Two bare parallel walls of 100 m, and a drive of 60 m along the middle: no end is ever within the URG's range,
    so that nothing in a scan tells how far the robot has come."""
    walls = np.array([[-20.0, 1.1, 80.0, 1.1], [-20.0, -1.1, 80.0, -1.1]])
    return finished(name, walls, [(0.0, 0.0), (60.0, 0.0)], [], (), overrides)


def crowd(*, name: str = "crowd", **overrides: Any) -> FloorWorld:
    """`floor-115` with 40 people who walk about in it."""
    return floor_115(name=name, **{"people": 40, **overrides})


def standstill(*, name: str = "standstill", **overrides: Any) -> FloorWorld:
    """A robot that never moves: a minute of scans from one place in a furnished room."""
    plan = Plan([])
    plan.room((-3.5, -2.5, 3.5, 2.5), 6.0)
    plan.free += [(3.5, -0.5, 3.7, 0.5), (3.7, -1.5, 6.0, 1.5)]
    return finished(name, plan.walls(), [(0.0, 0.0)], plan.areas, (), {"stand": 60.0, **overrides})


def line_with_doors(plan: Plan, centre: list[Point], rng: np.random.Generator) -> None:
    """Doors along both walls of a closed line of corridors: most closed, in niches, the others open, with a room
    behind; and pillars between them. None where something else is free already."""
    taken = list(plan.free)
    for start, end in pairwise([*centre, centre[0]]):
        for side in (-1.0, 1.0):
            _doors(plan, taken, np.array(start), np.array(end), side, rng)


def _doors(
    plan: Plan, taken: list[Box], start: np.ndarray, end: np.ndarray, side: float, rng: np.random.Generator
) -> None:
    length = float(np.abs(end - start).sum())
    ahead = (end - start) / length
    out = side * np.array([-ahead[1], ahead[0]])

    def box(first: float, last: float, near: float, far: float) -> Box:
        """From `first` to `last` m along the corridor, `near` to `far` m behind its wall."""
        a = start + first * ahead + (0.5 * WIDE + near) * out
        b = start + last * ahead + (0.5 * WIDE + far) * out
        (x0, y0), (x1, y1) = np.round(np.minimum(a, b), 3), np.round(np.maximum(a, b), 3)
        return float(x0), float(y0), float(x1), float(y1)

    at = 0.5 * WIDE + rng.uniform(0.5, 2.0)
    while at < length - 0.5 * WIDE - 0.5:
        opened, gap, deep, pillar = rng.random(), rng.uniform(*_APART), rng.uniform(*_DEEP), rng.random()
        room = box(at - 0.45 * gap, at + 0.45 * gap, WALL, deep)
        if not meets(box(at - 0.8, at + 0.8, 0.01, 0.3), taken):
            if opened < _OPEN and not meets(room, taken, WALL):
                plan.free += [box(at - 0.5 * DOOR, at + 0.5 * DOOR, 0.0, WALL), room]
                taken.append(room)
            else:
                plan.free.append(box(at - 0.5 * DOOR, at + 0.5 * DOOR, 0.0, NICHE))
            if pillar < _PILLARS and at + 1.8 < length - 0.5 * WIDE:
                plan.solid.append(box(at + 0.9, at + 1.3, -_PILLAR, 0.0))
        at += gap


def finished(
    name: str,
    walls: np.ndarray,
    way: list[Point],
    areas: Sequence[tuple[float, ...]],
    walks: tuple[np.ndarray, ...],
    overrides: dict[str, Any],
    columns: list[tuple[float, float, float]] | None = None,
) -> FloorWorld:
    """A floor of this plan; overrides: fields of `FloorWorld`."""
    fields: dict[str, Any] = {
        "name": name,
        "walls": walls,
        "waypoints": np.array(way, dtype=float),
        "areas": np.array(areas, dtype=float).reshape(-1, 5),
        "walkways": walks,
        "columns": np.array(columns or [], dtype=float).reshape(-1, 3),
    }
    return FloorWorld(**{**fields, **overrides})


def sick(overrides: dict[str, Any]) -> dict[str, Any]:
    """The overrides, on top of what a floor with a SICK scanner has."""
    fields = {"scanner": "sick", "max_range": 80.0, "sigma_beam_ratio": 0.0, "quantum": 0.01, "speed": 0.5}
    return {**fields, **overrides}
