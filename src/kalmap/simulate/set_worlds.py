"""Worlds for random finite sets: false sightings and misses in every frame, most of them as publications set them.

Filters of sets are compared look by look, so the published worlds hold as many looks as their sources say.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from kalmap.simulate.courses import (
    Area,
    along_course,
    apart,
    course_waypoints,
    course_world,
    make_world,
    map_stream,
    random_landmarks,
    rounded,
)
from kalmap.simulate.drive import drive
from kalmap.simulate.world import World

# Yan et al.: features in the square of 120 m, m from one to the next, m nearest and farthest from the way
_PHD_FEATURES, _PHD_APART, _PHD_NEAR, _PHD_FAR = 39, 4.0, 2.0, 29.0
PHD_AREA: Area = (-60.0, -25.0, 60.0, 95.0)
# corners of the way before they are scaled to 726 looks, the radius they are rounded with in m, and how many
# way-points are driven a second time
_PHD_CORNERS = ((44, 0), (44, 88), (15, 88), (15, 40), (-15, 40), (-15, 88), (-44, 88), (-44, 0))
_PHD_SCALE, _PHD_ROUND, _PHD_AGAIN = 0.8398, 10.0, 4

# Kaltiokallio et al.: features in the square of 1 km, m from one to the next, m nearest to the way
_FIELD_FEATURES, _FIELD_APART, _FIELD_NEAR = 160, 58.0, 5.0
FIELD_AREA: Area = (-500.0, -70.0, 500.0, 930.0)
# likewise, for 4,000 looks: up and down six lanes
_FIELD_CORNERS = (
    *((390, 0), (390, 780), (234, 780), (234, 160), (78, 160), (78, 780)),
    *((-78, 780), (-78, 160), (-234, 160), (-234, 780), (-390, 780), (-390, 0)),
)
_FIELD_SCALE, _FIELD_ROUND = 1.10465, 30.0
_FIELD_FIELDS: dict[str, Any] = {
    "wheelbase": 3.0,
    "dt": 1.0,
    "observe_every": 1,
    "at_waypoint": 5.0,
    "max_range": 150.0,
    "sigma_speed": 0.8,
    "sigma_steering_deg": 0.5,
    "sigma_range": 0.8,
    "sigma_bearing_deg": 0.3,
    "clutter": 5.0,
    "detection_probability": 0.95,
}

# Leung and Inostroza: features, m/s, the segments of the course and the seconds of one, the fastest turn in rad/s,
# looks from one feature to the next, m nearest and farthest that the sensor sees
_RFS_FEATURES, _RFS_SPEED, _RFS_SEGMENTS, _RFS_SEGMENT, _RFS_TURN = 50, 0.2, 20, 15.0, 0.5
_RFS_LOOKS_A_FEATURE, _RFS_MIN, _RFS_MAX = 60, 0.5, 2.5
# the drawn course that is taken, way-points of one segment, and the scale that makes it 3,000 looks
_RFS_DRAW, _RFS_WAYPOINTS, _RFS_SCALE = 3, 10, 1.03279
# variance of speed and turn rate in one sample, (m/s)^2 and (rad/s)^2
_RFS_VARIANCE = 0.002
# m rad: what clutter per m and rad is multiplied with for clutter a scan
RFS_CLUTTER_AREA = 2.0 * math.pi * (_RFS_MAX - _RFS_MIN)
_RFS_FIELDS: dict[str, Any] = {
    "laps": 1,
    "speed": _RFS_SPEED,
    "wheelbase": _RFS_SPEED,  # so the turn rate is the sine of the steering
    "max_steering_deg": 45.0,
    "steering_rate_deg": 90.0,
    "dt": 0.1,
    "observe_every": 1,
    "at_waypoint": 0.1,
    "min_range": _RFS_MIN,
    "max_range": _RFS_MAX,
    "field_of_view_deg": 360.0,
    "sigma_speed": math.sqrt((2.0 - _RFS_SPEED**2) * _RFS_VARIANCE),  # steering does the rest, sideways
    "sigma_steering_deg": math.degrees(math.sqrt(_RFS_VARIANCE)),
    "sigma_range": math.sqrt(0.0005),
    "sigma_bearing_deg": math.degrees(math.sqrt(0.00005)),
}


def phd_world(mean: int, *, name: str | None = None, **overrides: Any) -> World:
    """The world of Yan et al. (2014), section 4.1: 39 features in a square of 120 m, P_D 0.95, on average `mean`
    false sightings in every look (1, 2 and 3 in the paper's table 2), 726 looks.

    Vehicle, sensor and noise are Bailey and Nieto's, and `World`'s defaults; the paper names them, but for wheelbase,
    greatest steering angle and the time from look to look. Its 20 deg/s are the rate of the steering. It states
    neither the features' places nor the way. Chosen here: one lap with a fold to the middle, 340 m, of which
    the first quarter is driven again; features anywhere in the square (`PHD_AREA`, which the way lies in the middle
    of), 2 to 29 m from the way, so that each is seen, and at least 4 m apart.
    """
    lap = _lap(np.array(_PHD_CORNERS) * _PHD_SCALE, _PHD_ROUND)
    waypoints = np.concatenate([lap, lap[:_PHD_AGAIN]])
    fields = {"laps": 1, "clutter": float(mean), "detection_probability": 0.95, **overrides}
    way = _way(waypoints, fields)
    drawn, gaps = _drawn(way, PHD_AREA, map_stream(8, _PHD_FEATURES), _PHD_FEATURES)
    landmarks = apart(drawn[(gaps > _PHD_NEAR) & (gaps < _PHD_FAR)], _PHD_APART, _PHD_FEATURES)
    return make_world(name or f"phd-{mean}", landmarks, waypoints, fields)


def field_world(*, name: str = "field-160", **overrides: Any) -> World:
    """The synthetic world of PHD-SLAM 3.0 (Kaltiokallio et al.): 160 features in a square of 1 km, 4,000 looks,
    one a second, P_D 0.95, on average five false sightings a look.

    From its simulation_setup.m: a sensor that reaches 150 m, 90 deg to either side, with 0.8 m and 0.3 deg; 0.8 m/s
    and 0.5 deg/s of noise on speed and turn rate; clutter uniform in range and bearing (there misses take their
    share of the clutter, too, which leaves 4.75). Its map, way and speed are in a binary file and not known here.
    Chosen: 3 m/s; two laps of 6 km in three fingers, which pass everything; features in the square (`FIELD_AREA`), at
    least 58 m apart, so that two or more are in view at every look (with features anywhere at all there would be
    stretches of a hundred metres without one), and 5 m from the way. There the vehicle turns at a commanded rate,
    here it is steered: with a wheelbase of 3 m the noise of 0.5 deg on the steering is 0.5 deg/s on the turn rate.
    """
    waypoints = _lap(np.array(_FIELD_CORNERS) * _FIELD_SCALE, _FIELD_ROUND)
    fields = {**_FIELD_FIELDS, **overrides}
    drawn, gaps = _drawn(_way(waypoints, fields), FIELD_AREA, map_stream(9, _FIELD_FEATURES), _FIELD_FEATURES)
    landmarks = apart(drawn[gaps > _FIELD_NEAR], _FIELD_APART, _FIELD_FEATURES)
    return make_world(name, landmarks, waypoints, fields)


def rfs_world(detection: float, clutter: float, *, name: str | None = None, **overrides: Any) -> World:
    """The grid of RFS-SLAM's simulator (Leung and Inostroza): 50 features, 3,000 looks, one every 0.1 s, all round
    from 0.5 to 2.5 m; P_D `detection`, on average `clutter` false sightings a look.

    From its cfg/rbphdslam2dSim.xml and src/rbphdslam2dSim.cpp: variances of 0.0005 m^2 and 0.00005 rad^2 of a
    sighting; of 0.002 on each velocity, forwards, sideways and turning, anew in every step; clutter uniform in
    range and bearing, so many per m and rad, times 12.57 (`RFS_CLUTTER_AREA`) a look; 20 segments of 15 s with a
    speed of 0.1 to 0.3 m/s and a turn rate within 0.5 rad/s, both constant; every 60 looks a feature somewhere
    within 2.5 m of the vehicle, uniform in range.

    Here the course is drawn by the same rule, once, with the mean speed of 0.2 m/s throughout, and a small steered
    vehicle (wheelbase 0.2 m) follows it, turning at up to 0.7 rad/s for moments. The noise of the steering gives the
    turn rate that variance straight ahead, a tenth less on average; that of the speed is so large that the
    position's error grows as fast as there, where the vehicle also slips sideways. It does not stand still for the
    first 5 s, and a sighting may be off the limits by its noise.
    """
    fields = {**_RFS_FIELDS, "clutter": clutter, "detection_probability": detection, **overrides}
    waypoints = _arcs(map_stream(10, _RFS_DRAW))
    where = drive(_way(waypoints, fields)).poses[::_RFS_LOOKS_A_FEATURE][:_RFS_FEATURES]
    shares = map_stream(11, _RFS_FEATURES).random((_RFS_FEATURES, 2))
    angle = where[:, 2] + 2.0 * math.pi * shares[:, 1]
    offset = _RFS_MAX * shares[:, :1] * np.column_stack([np.cos(angle), np.sin(angle)])
    name = name or f"rfs-{100 * detection:.0f}-{clutter:.0f}"
    return make_world(name, where[:, :2] + offset, waypoints, fields)


def cluttered_world(*, name: str = "clutter-20-70", **overrides: Any) -> World:
    """The package's course with 35 features, each missed in three frames of ten, and twenty false sightings a frame.

    It breaks those who let a feature fade with every miss, as filters without a memory do.
    """
    return course_world(35, name=name, **{"clutter": 20.0, "detection_probability": 0.7, **overrides})


def faded_world(*, name: str = "faded-35", **overrides: Any) -> World:
    """The package's course with 35 features, which are sighted the more rarely the farther they are: P_D is 0.95
    at the sensor and falls straight to 0.3 at 30 m.

    It breaks those who take one P_D for all: what is missed far away is no sign that nothing is there.
    """
    return course_world(35, name=name, **{"detection_probability": 0.95, "detection_far": 0.3, **overrides})


def restless_world(*, name: str = "restless-35", **overrides: Any) -> World:
    """The package's course with 35 features, of which five move at 0.1 m/s and 30 stand; three false sightings a
    frame, one feature of ten missed.

    Those that move are movers: they start anywhere in the box around the others, by the log's seed, and have no
    id. While they are passed they look like features; in the second lap they are elsewhere, 10 m or so. It breaks
    those who believe that what was once in the map stays there.
    """
    fields = {"movers": 5, "mover_speed": 0.1, "clutter": 3.0, "detection_probability": 0.9, **overrides}
    return make_world(name, along_course(30), course_waypoints(), fields)


def _lap(corners: np.ndarray, radius: float) -> np.ndarray:
    """Way-points of a closed way with rounded corners (K, 2) m that begins and ends at the start."""
    return np.concatenate([rounded(corners, radius), [[0.0, 0.0]]])


def _way(waypoints: np.ndarray, fields: dict[str, Any]) -> World:
    """The world without its features: what their places are chosen by."""
    return make_world("way", np.zeros((0, 2)), waypoints, fields)


def _drawn(way: World, area: Area, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Twenty times `count` places (M, 2) m in the area, and how far each is from the way (M,) m."""
    driven = drive(way).poses[:: way.observe_every, :2]
    drawn = random_landmarks(20 * count, area, rng)
    return drawn, np.asarray(cKDTree(driven).query(drawn)[0])


def _arcs(rng: np.random.Generator) -> np.ndarray:
    """Way-points (200, 2) m along arcs of 15 s each, one smoothly after the other, from the start pose on."""
    time = _RFS_SEGMENT / _RFS_WAYPOINTS
    turns = time * np.repeat(rng.uniform(-_RFS_TURN, _RFS_TURN, _RFS_SEGMENTS), _RFS_WAYPOINTS)
    chords = _RFS_SPEED * time * np.sinc(turns / (2.0 * math.pi))
    headings = np.cumsum(turns) - turns / 2.0
    steps = chords[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.asarray(_RFS_SCALE * np.cumsum(steps, axis=0))
