"""What stands about in rooms and corridors: boxes, bins, and the legs of tables and chairs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.plans import along, box_walls

# m that a robot's way and a person's stay free of furniture
CLEAR_OF_DRIVE, CLEAR_OF_PEOPLE = 0.45, 0.35
_TRIES = 30
_KINDS = ("box", "box", "table", "chair", "chair", "bin")
_AGAINST_A_WALL = 0.6


def furnish(world: FloorWorld, drive: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Furniture as walls (S, 4) and circles (C, 3), drawn for every area of the floor.

    drive: (F, 2) m, where the robot passes. A piece that finds no free place after a few tries is left out: it stays
    inside its area, `CLEAR_OF_DRIVE` off the robot's way, `CLEAR_OF_PEOPLE` off the walkways, and off other pieces and
    columns.
    """
    from scipy.spatial import cKDTree

    ways = [(cKDTree(drive), CLEAR_OF_DRIVE)]
    ways += [(cKDTree(along(way, 0.1, closed=True)), CLEAR_OF_PEOPLE) for way in world.walkways]
    placed = [tuple(column) for column in world.columns]
    walls, circles = [np.zeros((0, 4))], [np.zeros((0, 3))]
    for *area, mean in world.areas:
        for _ in range(rng.poisson(mean * world.furniture)):
            kind, width, depth = _piece(rng)
            spot = _spot(np.array(area), width, depth, ways, placed, rng)
            if spot is None:
                continue
            x, y, heading = spot
            placed.append((x, y, 0.5 * math.hypot(width, depth)))
            if kind == "box":
                walls.append(box_walls(x, y, width, depth, heading))
            elif kind == "bin":
                circles.append(np.array([[x, y, 0.5 * width]]))
            else:
                circles.append(_legs(x, y, width, depth, heading, 0.03 if kind == "table" else 0.018))
    return np.concatenate(walls), np.concatenate(circles)


def _piece(rng: np.random.Generator) -> tuple[str, float, float]:
    """Kind, width and depth m."""
    kind = _KINDS[rng.integers(len(_KINDS))]
    share, other = rng.random(2)
    if kind == "box":
        return kind, 0.4 + 0.8 * share, 0.3 + 0.3 * other
    if kind == "table":
        return kind, 1.0 + 0.6 * share, 0.6 + 0.2 * other
    if kind == "chair":
        return kind, 0.42, 0.42
    diameter = 0.25 + 0.2 * share
    return kind, diameter, diameter


def _legs(x: float, y: float, width: float, depth: float, heading: float, radius: float) -> np.ndarray:
    """(4, 3): four legs, each a circle that touches its corner's two sides."""
    corners = box_walls(x, y, width - 2.0 * radius, depth - 2.0 * radius, heading)[:, :2]
    return np.column_stack([corners, np.full(4, radius)])


def _spot(
    area: np.ndarray,
    width: float,
    depth: float,
    ways: list[tuple[Any, float]],
    placed: list[tuple[float, ...]],
    rng: np.random.Generator,
) -> tuple[float, float, float] | None:
    """x, y, heading of a free place, square to the walls where it stands against one; None if there is none."""
    reach = 0.5 * math.hypot(width, depth)
    for _ in range(_TRIES):
        across, up, turn, against, side = rng.random(5)
        at_wall = against < _AGAINST_A_WALL
        heading = 0.5 * math.pi * math.floor(2.0 * turn) if at_wall else math.pi * turn
        c, s = abs(math.cos(heading)), abs(math.sin(heading))
        margin = 0.5 * np.array([width * c + depth * s, width * s + depth * c]) + 0.02
        low, high = area[:2] + margin, area[2:] - margin
        if (low > high).any():
            continue
        place = low + (high - low) * np.array([across, up])
        if at_wall:
            wall = int(4.0 * side)
            place[wall % 2] = (low, high)[wall // 2][wall % 2]
        clear = all(tree.query(place)[0] - reach >= apart for tree, apart in ways)
        if clear and all(math.hypot(place[0] - x, place[1] - y) > reach + r + 0.05 for x, y, r in placed):
            return float(place[0]), float(place[1]), heading
    return None
