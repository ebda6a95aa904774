"""Exact ranges of laser beams to circles and straight walls."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

NOTHING = -1

_SLACK = 1e-9  # rad by which a window of beams is opened, so that rounding loses no beam; each is then tried exactly
_NEARLY = 1e-6  # rad short of half a turn that a segment spans when the sensor is as good as on it


@compiled
def circle_range(x, y, radius, c, s):
    """Range from the origin along (c, s), a unit vector, to the circle about (x, y): the first crossing, else inf."""
    along, across = x * c + y * s, x * s - y * c
    squared = (radius - across) * (radius + across)
    if not squared >= 0.0:
        return math.inf
    half = math.sqrt(squared)
    if along - half > 0.0:
        return along - half
    return along + half if along + half > 0.0 else math.inf


@compiled
def segment_range(x1, y1, x2, y2, c, s):
    """Range from the origin along (c, s), a unit vector, to the segment (x1, y1) to (x2, y2), inf if it is passed by.

    A beam that runs along the segment passes it by: it has no thickness. On which side of the beam an end lies is the
    same number for every segment that ends there, so no beam slips through where two meet.
    """
    first, second = x1 * s - y1 * c, x2 * s - y2 * c
    if (first > 0.0 and second > 0.0) or (first < 0.0 and second < 0.0):
        return math.inf
    dx, dy = x2 - x1, y2 - y1
    turned = c * dy - s * dx
    if turned == 0.0:
        return math.inf
    distance = (x1 * dy - y1 * dx) / turned
    return distance if distance > 0.0 else math.inf


@compiled
def see_circle(x, y, radius, heading, bearings, rays, nearest, target, name):
    """Where the circle about (x, y), m from the sensor, is nearest: lower `nearest` (B,), write `name` to `target`.

    bearings: (B,) ascending; rays: (B, 2) their unit vectors in the world.
    """
    distance = math.hypot(x, y)
    middle = math.atan2(y, x) - heading
    half = (math.pi if distance <= radius else math.asin(radius / distance)) + _SLACK
    # the circle may be met once on every full turn that the beams cover
    turn = math.ceil((bearings[0] - half - middle) / (2.0 * math.pi))
    while middle + 2.0 * math.pi * turn - half <= bearings[-1]:
        centre = middle + 2.0 * math.pi * turn
        b = np.searchsorted(bearings, centre - half)
        while b < len(bearings) and bearings[b] <= centre + half:
            reached = circle_range(x, y, radius, rays[b, 0], rays[b, 1])
            if reached < nearest[b]:
                nearest[b], target[b] = reached, name
            b += 1
        turn += 1.0


@compiled
def segment_distance(x1, y1, x2, y2):
    """Distance of the origin from the segment (x1, y1) to (x2, y2)."""
    dx, dy = x2 - x1, y2 - y1
    squared = dx * dx + dy * dy
    share = 0.0 if squared == 0.0 else min(1.0, max(0.0, -(x1 * dx + y1 * dy) / squared))
    return math.hypot(x1 + share * dx, y1 + share * dy)


@compiled
def see_segment(x1, y1, x2, y2, heading, bearings, rays, nearest, target, name):
    """Where the segment, its ends in m from the sensor, is nearest: lower `nearest` (B,), write `name` to `target`.

    bearings: (B,) ascending; rays: (B, 2) their unit vectors in the world. Only beams between the two ends are tried.
    """
    span = math.atan2(x1 * y2 - y1 * x2, x1 * x2 + y1 * y2)
    middle = math.atan2(y1, x1) + 0.5 * span - heading
    half = 0.5 * abs(span) + _SLACK
    if half > 0.5 * math.pi - _NEARLY:  # the sensor stands on it, and the sign of the span is rounding's
        half = math.pi
    turn = math.ceil((bearings[0] - half - middle) / (2.0 * math.pi))
    while middle + 2.0 * math.pi * turn - half <= bearings[-1]:
        centre = middle + 2.0 * math.pi * turn
        b = np.searchsorted(bearings, centre - half)
        while b < len(bearings) and bearings[b] <= centre + half:
            reached = segment_range(x1, y1, x2, y2, rays[b, 0], rays[b, 1])
            if reached < nearest[b]:
                nearest[b], target[b] = reached, name
            b += 1
        turn += 1.0


@compiled
def cast_rays(poses, circles, moving, segments, bearings, max_range):
    """Range of every beam from every pose, inf beyond `max_range`, and what it met: (F, B), (F, B) int64.

    poses (F, 3), circles (N, 3), moving (F, K, 3), segments (S, 4), bearings (B,) ascending, B > 0. Circles are
    numbered first, then moving ones, then segments; NOTHING where nothing is met.
    """
    still = len(circles)
    round_ones = still + moving.shape[1]
    nearest = np.full((len(poses), len(bearings)), math.inf)
    target = np.full((len(poses), len(bearings)), NOTHING, dtype=np.int64)
    rays = np.empty((len(bearings), 2))
    for f in range(len(poses)):
        x, y, heading = poses[f, 0], poses[f, 1], poses[f, 2]
        for b in range(len(bearings)):
            rays[b, 0], rays[b, 1] = math.cos(heading + bearings[b]), math.sin(heading + bearings[b])
        for n in range(round_ones):
            circle = circles[n] if n < still else moving[f, n - still]
            dx, dy, radius = circle[0] - x, circle[1] - y, circle[2]
            if math.hypot(dx, dy) <= max_range + radius:
                see_circle(dx, dy, radius, heading, bearings, rays, nearest[f], target[f], n)
        for n in range(len(segments)):
            x1, y1, x2, y2 = segments[n, 0] - x, segments[n, 1] - y, segments[n, 2] - x, segments[n, 3] - y
            if segment_distance(x1, y1, x2, y2) <= max_range + _SLACK:
                see_segment(x1, y1, x2, y2, heading, bearings, rays, nearest[f], target[f], round_ones + n)
        for b in range(len(bearings)):
            if nearest[f, b] > max_range:
                nearest[f, b], target[f, b] = math.inf, NOTHING
    return nearest, target
