"""Steer the true vehicle from way-point to way-point, free of noise."""

from __future__ import annotations

import math
from array import array

import msgspec
import numpy as np

from kalmap.kernels.steering import steer_to
from kalmap.records import KalmapError
from kalmap.simulate.world import World

_AT_ONCE = 4096  # control steps between two looks at whether a way-point can be reached at all


class Drive(msgspec.Struct, frozen=True, eq=False):
    """A driven course. steering: (T,) rad, of each control step; poses: (T + 1, 3), start first, headings
    in [-pi, pi)."""

    steering: np.ndarray
    poses: np.ndarray


def drive(world: World) -> Drive:
    """Drive `world.laps` times through the way-points, starting at (0, 0, 0) with straight wheels.

    In each step the front wheel turns towards the next way-point, limited in rate and angle, and the
    vehicle moves as a front-wheel point:
    x += V dt cos(G + phi), y += V dt sin(G + phi), phi += V dt sin(G) / wheelbase
    (Bailey and Nieto's simulator, compute_steering.m and vehicle_model.m). The drive ends when the last
    way-point of the last lap is reached.

    Raises `KalmapError` naming the way-point if one cannot be reached, such as one inside the circle
    that the vehicle cannot turn tighter than.
    """
    legs = np.tile(np.asarray(world.waypoints, dtype=float), (world.laps, 1))
    step = float(world.speed * world.dt)
    limit, most_turn = math.radians(world.max_steering_deg), math.radians(world.steering_rate_deg) * world.dt
    rules = float(world.at_waypoint), step, most_turn, limit, step / world.wheelbase
    state, course = np.zeros(4), np.empty((_AT_ONCE, 4))
    # arrays of numbers, not lists: a large lawn is driven in ten million steps
    steerings, poses = array("d"), array("d", state[:3])
    for number, goal in enumerate(legs):
        left, reached = _patience(world, math.hypot(*(goal - state[:2]))), False
        while not reached:
            if left == 0:
                raise KalmapError(_stuck(world, number))
            steps, reached = steer_to(*goal, *rules, state, course[:left])
            left -= steps
            poses.frombytes(course[:steps, :3].tobytes())
            steerings.frombytes(course[:steps, 3].tobytes())
    return Drive(np.frombuffer(steerings), np.frombuffer(poses).reshape(-1, 3))


def _patience(world: World, distance: float) -> int:
    """Steps after which a way-point `distance` m away is given up: four times the straight way and ten
    full circles."""
    circle = 2.0 * math.pi * world.wheelbase / math.sin(math.radians(world.max_steering_deg))
    return math.ceil((4.0 * distance + 10.0 * circle) / (world.speed * world.dt))


def _stuck(world: World, number: int) -> str:
    lap, waypoint = divmod(number, len(world.waypoints))
    return (
        f"world {world.name}: way-point {waypoint + 1} of lap {lap + 1} is never reached; it may lie "
        f"inside the vehicle's turning circle or at_waypoint ({world.at_waypoint:g} m) may be too small"
    )
