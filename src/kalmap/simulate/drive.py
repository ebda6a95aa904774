"""Steer the true vehicle from way-point to way-point, free of noise."""

from __future__ import annotations

import math
from array import array

import msgspec
import numpy as np

from kalmap.records import KalmapError
from kalmap.simulate.world import World


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
    legs = [(float(x), float(y)) for x, y in world.waypoints] * world.laps
    step, at_waypoint_squared = world.speed * world.dt, world.at_waypoint**2
    limit, most_turn = math.radians(world.max_steering_deg), math.radians(world.steering_rate_deg) * world.dt
    turn_per_sine = step / world.wheelbase
    pi, turn, atan2, sin, cos = math.pi, 2.0 * math.pi, math.atan2, math.sin, math.cos
    x = y = heading = steering = 0.0
    # arrays of numbers, not lists: a large lawn is driven in ten million steps
    steerings, poses = array("d"), array("d", (x, y, heading))
    for number, (goal_x, goal_y) in enumerate(legs):
        left = _patience(world, math.hypot(goal_x - x, goal_y - y))
        dx, dy = goal_x - x, goal_y - y
        while dx * dx + dy * dy >= at_waypoint_squared:
            if left == 0:
                raise KalmapError(_stuck(world, number))
            left -= 1
            change = (atan2(dy, dx) - heading - steering + pi) % turn - pi
            steering += max(-most_turn, min(most_turn, change))
            steering = max(-limit, min(limit, steering))
            x += step * cos(steering + heading)
            y += step * sin(steering + heading)
            heading = (heading + turn_per_sine * sin(steering) + pi) % turn - pi
            steerings.append(steering)
            poses.extend((x, y, heading))
            dx, dy = goal_x - x, goal_y - y
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
