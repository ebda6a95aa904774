"""People who walk through corridors and rooms, and step aside for the robot."""

from __future__ import annotations

import math

import numpy as np

from kalmap.simulate.floor import FloorWorld

# s that someone walks and then stands on average; m that ways lie apart at most, and that stays between two centres
_WALK, _PAUSE = 25.0, 5.0
_STRAY = 0.3
_ASIDE = 0.7


def walkers(
    world: FloorWorld,
    times: np.ndarray,
    robot: np.ndarray,
    starts: np.random.Generator,
    pauses: np.random.Generator,
) -> np.ndarray:
    """(F, people, 3) x, y, radius m: where everyone is at `times` (F,) s.

    Each keeps to one walkway, a little to the side of it, in one direction and at a speed of their own, and stops now
    and then. Who would come nearer to the robot (F, 2) than 0.7 m stands or walks 0.7 m from it instead.
    """
    places = np.empty((len(times), world.people, 3))
    places[:, :, 2] = world.person_radius
    for person in range(world.people):
        way = np.asarray(world.walkways[starts.integers(len(world.walkways))], dtype=float)
        begin, back, angle, away = starts.random(4)
        speed = world.person_speed * min(1.5, max(0.5, 1.0 + 0.2 * starts.standard_normal()))
        ends = np.concatenate([way, way[:1]])
        lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ends, axis=0).T))])
        walked = speed * _walked(times, pauses)
        at = np.mod(begin * lengths[-1] + (walked if back < 0.5 else -walked), lengths[-1])
        stray = _STRAY * math.sqrt(away)
        places[:, person, 0] = np.interp(at, lengths, ends[:, 0]) + stray * math.cos(2.0 * math.pi * angle)
        places[:, person, 1] = np.interp(at, lengths, ends[:, 1]) + stray * math.sin(2.0 * math.pi * angle)
    offset = places[:, :, :2] - robot[:, None]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    near = distance < _ASIDE
    direction = offset[near] / np.maximum(distance[near], 1e-9)[:, None]
    places[near, :2] = np.broadcast_to(robot[:, None], offset.shape)[near] + _ASIDE * direction
    return places


def _walked(times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(F,) s that someone has walked until `times`, without the pauses."""
    count = 10 + math.ceil(2.0 * (times[-1] - times[0]) / (_WALK + _PAUSE))
    walks, stops = _WALK * rng.exponential(size=count), _PAUSE * rng.exponential(size=count)
    knots = np.concatenate([[0.0], np.cumsum(np.column_stack([walks, stops]).ravel())])
    done = np.concatenate([[0.0], np.cumsum(np.column_stack([walks, np.zeros(count)]).ravel())])
    return np.interp(times - times[0], knots, done)
