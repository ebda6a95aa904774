"""How a robot with two wheels drives through way-points: straight on, round bends, on the spot where it goes back."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, exponential
from kalmap.records import ConfigError
from kalmap.simulate.floor import FloorWorld

# rad, sharper than which a bend is turned on the spot; m, narrower than which too
_SHARP, _NARROW = math.radians(120.0), 0.05
_MOST_SCANS = 1_000_000


class FloorDrive(msgspec.Struct, frozen=True, eq=False):
    """The robot at each scan: times (F,) s from 0 on, poses (F, 3) in the plan, the heading in [-pi, pi)."""

    times: np.ndarray
    poses: np.ndarray


class _Moves(msgspec.Struct):
    """Stretches of constant speed and turn rate: start (M, 3), duration s, speed m/s, turn rate rad/s."""

    starts: list[tuple[float, float, float]]
    durations: list[float]
    speeds: list[float]
    rates: list[float]

    def add(self, start: tuple[float, float, float], duration: float, speed: float, rate: float) -> None:
        if duration > 0.0:
            for column, value in zip(
                (self.starts, self.durations, self.speeds, self.rates), (start, duration, speed, rate)
            ):
                column.append(value)  # type: ignore[attr-defined]


def floor_drive(world: FloorWorld) -> FloorDrive:
    """Where the robot is at every scan, from its start to the last way-point; exact, free of noise.

    A bend at a way-point is an arc of `turn_radius` inside the corner, narrower where the legs are short, and driven
    slower where the turn rate asks for it. Raises ConfigError for way-points that lie on each other, and for a drive
    of more than a million scans.
    """
    moves = _moves(world)
    ends = np.cumsum(moves.durations) if moves.durations else np.zeros(1)
    if ends[-1] * world.rate > _MOST_SCANS:
        raise ConfigError(f"floor {world.name}: the drive has more than {_MOST_SCANS} scans")
    times = np.arange(math.floor(ends[-1] * world.rate + 1e-9) + 1) / world.rate
    if not moves.durations:
        return FloorDrive(times, np.array([[*world.waypoints[0], 0.0]], dtype=float))
    number = np.minimum(np.searchsorted(ends, times), len(ends) - 1)
    since = times - (ends - moves.durations)[number]
    along, turned = np.array(moves.speeds)[number] * since, np.array(moves.rates)[number] * since
    steps = exponential(np.column_stack([along, np.zeros(len(along)), turned]))
    return FloorDrive(times, compose(np.array(moves.starts)[number], steps))


def _moves(world: FloorWorld) -> _Moves:
    points = np.asarray(world.waypoints, dtype=float)
    legs = np.diff(points, axis=0)
    lengths = np.hypot(*legs.T) if len(legs) else np.zeros(0)
    if (lengths < 1e-6).any():
        raise ConfigError(f"floor {world.name}: way-points {int(lengths.argmin()) + 1} and the next are one")
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = wrap(np.diff(headings))
    most = math.radians(world.turn_rate_deg)
    moves = _Moves([], [], [], [])
    moves.add((*points[0], float(headings[0]) if len(legs) else 0.0), world.stand, 0.0, 0.0)
    left = 0.0  # of the leg, behind the bend before it
    for k, length in enumerate(lengths):
        turn = float(turns[k]) if k < len(turns) else 0.0
        cut, radius = _bend(world, turn, length, lengths[k + 1] if k < len(turns) else 0.0)
        ahead = np.array([math.cos(headings[k]), math.sin(headings[k])])
        begin, end = points[k] + left * ahead, points[k + 1] - cut * ahead
        moves.add((*begin, float(headings[k])), (length - left - cut) / world.speed, world.speed, 0.0)
        speed = min(world.speed, most * radius)
        rate = math.copysign(speed / radius if radius else most, turn)
        moves.add((*end, float(headings[k])), abs(turn / rate), speed, rate)
        left = cut
    return moves


def _bend(world: FloorWorld, turn: float, before: float, after: float) -> tuple[float, float]:
    """How much of both legs a bend takes away, and its radius; 0, 0 where the robot turns on the spot."""
    tangent = math.tan(0.5 * abs(turn))
    if abs(turn) > _SHARP or tangent < 1e-9:
        return 0.0, 0.0
    cut = min(world.turn_radius * tangent, 0.5 * before, 0.5 * after)
    return (cut, cut / tangent) if cut / tangent > _NARROW else (0.0, 0.0)
