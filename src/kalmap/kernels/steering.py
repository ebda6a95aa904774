"""The true vehicle of a simulated world, driven to a way-point."""

import math

from kalmap.kernels.compiled import compiled


@compiled
def steer_to(goal_x, goal_y, near, step, most_turn, limit, turn_per_sine, state, course):
    """Drive until the way-point is nearer than `near` m, from and in `state` (4,): x, y, heading, steering angle.

    In each step of `step` m the front wheel turns towards the way-point, by `most_turn` rad at most and up to `limit`
    rad; turn_per_sine: rad that the heading changes by, for a sine of the steering angle of one. course (L, 4): the
    state after each step. Returns how many these are, and whether the way-point is reached in so many.
    """
    x, y, heading, steering = state
    turn = 2.0 * math.pi
    dx, dy = goal_x - x, goal_y - y
    steps = 0
    while dx * dx + dy * dy >= near * near:
        if steps == len(course):
            break
        change = (math.atan2(dy, dx) - heading - steering + math.pi) % turn - math.pi
        steering += max(-most_turn, min(most_turn, change))
        steering = max(-limit, min(limit, steering))
        x += step * math.cos(steering + heading)
        y += step * math.sin(steering + heading)
        heading = (heading + turn_per_sine * math.sin(steering) + math.pi) % turn - math.pi
        course[steps, 0], course[steps, 1], course[steps, 2], course[steps, 3] = x, y, heading, steering
        steps += 1
        dx, dy = goal_x - x, goal_y - y
    state[0], state[1], state[2], state[3] = x, y, heading, steering
    return steps, not dx * dx + dy * dy >= near * near
