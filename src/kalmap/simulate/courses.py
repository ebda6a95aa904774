"""The worlds themselves: where features stand and where the vehicle drives.

Every generator draws from a fixed seed and rounds to millimetres, so a name means the same world on
every machine.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmap.records import ConfigError
from kalmap.simulate.world import World

Area = tuple[float, float, float, float]

# the noise of the papers' harder setting (set b: 70 features)
HARD_NOISE: dict[str, Any] = {"sigma_speed": 0.6, "sigma_steering_deg": 6.0}
BAILEY_AREA: Area = (-130.0, -100.0, 105.0, 95.0)

_COURSE_LENGTH = 640.0
_COURSE_WAYPOINTS = 17
_COURSE_SEED = 2024
# share of the mean radius by which each harmonic (2, 3, 5 waves a round) bends the course
_COURSE_BENDS = ((2, 0.16), (3, 0.10), (5, 0.05))
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def random_landmarks(n: int, area: Area, rng: np.random.Generator) -> np.ndarray:
    """(n, 2) m, uniform over the box `area` = (x least, y least, x most, y most)."""
    if n < 0:
        raise ConfigError(f"the number of landmarks must be zero or more, got {n}")
    return np.asarray(rng.uniform(area[:2], area[2:], (n, 2)))


def course_world(n: int = 35, *, name: str | None = None, **overrides: Any) -> World:
    """The package's own course: a closed anticlockwise curve of 640 m through the start, n features along it.

    Features stand 4 to 22 m to either side of the curve, evenly spread along it whatever n is; a smaller
    course's features are the first of a larger one's. overrides: fields of `World`.
    """
    if n < 1:
        raise ConfigError(f"a course needs at least one landmark, got {n}")
    return make_world(name or f"course-{n}", along_course(n), course_waypoints(), overrides)


def same_world(n: int, *, name: str | None = None, **overrides: Any) -> World:
    """The same course with n features uniform over a box around it: more features, more of them in view."""
    waypoints = course_waypoints()
    landmarks = random_landmarks(n, _around(waypoints), map_stream(2, n))
    return make_world(name or f"same-{n}", landmarks, waypoints, overrides)


def wide_world(n: int, *, name: str | None = None, **overrides: Any) -> World:
    """Course and box scaled by sqrt(n / 35): as many in view as with 35, however many there are."""
    if n < 5:
        raise ConfigError(f"wide-{n}: the course is too small to drive; take 5 landmarks or more")
    scale = math.sqrt(n / 35.0)
    waypoints = course_waypoints()
    landmarks = scale * random_landmarks(n, _around(waypoints), map_stream(3, n))
    return make_world(name or f"wide-{n}", landmarks, scale * waypoints, overrides)


def lawn_world(n: int, *, name: str | None = None, **overrides: Any) -> World:
    """Mow a square like a lawn in lanes 40 m apart, once, and come back to the start.

    One feature to 250 m^2, so that about 5 are in view and the map grows with the way.
    """
    side = math.sqrt(250.0 * n) if n > 0 else 0.0
    if side < 45.0:
        raise ConfigError(f"lawn-{n}: the lawn is too small to turn on; take 9 landmarks or more")
    landmarks = random_landmarks(n, (-15.0, -15.0, side + 15.0, side + 15.0), map_stream(4, n))
    ends = [(15.0, side - 15.0), (side - 15.0, 15.0)]
    lanes = [(x, 40.0 * lane) for lane in range(int(side // 40.0) + 1) for x in ends[lane % 2]]
    waypoints = np.array([*lanes, (0.0, side / 2.0), (10.0, 10.0)])
    return make_world(name or f"lawn-{n}", landmarks, waypoints, {"laps": 1, **overrides})


def bailey_world(
    landmarks: np.ndarray,
    waypoints: np.ndarray,
    *,
    extra: int = 0,
    seed: int = 70,
    name: str | None = None,
    **overrides: Any,
) -> World:
    """A map of Bailey and Nieto's simulator, landmarks (N, 2) and waypoints (K, 2) in m.

    extra: so many more features, uniform over `BAILEY_AREA`, from their own `seed` (the papers' set b
        has 35 more than the standard map). overrides: fields of `World`.
    """
    more = random_landmarks(extra, BAILEY_AREA, np.random.default_rng(np.random.SeedSequence(seed)))
    landmarks = np.concatenate([np.asarray(landmarks, dtype=float), np.round(more, 3)])
    fields = {"name": name or f"bailey-{len(landmarks)}", **overrides}
    return World(landmarks=landmarks, waypoints=np.asarray(waypoints, dtype=float), **fields)


def make_world(name: str, landmarks: np.ndarray, waypoints: np.ndarray, overrides: dict[str, Any]) -> World:
    """A world with its places in whole millimetres; overrides: fields of `World`."""
    fields = {"name": name, "landmarks": np.round(landmarks, 3), "waypoints": np.round(waypoints, 3)}
    return World(**{**fields, **overrides})


def map_stream(kind: int, n: int) -> np.random.Generator:
    """Where a kind of world with n features gets its random numbers from; every kind has a number of its own."""
    return np.random.default_rng(np.random.SeedSequence((_COURSE_SEED, kind, n)))


def along_course(n: int) -> np.ndarray:
    """(n, 2) m: places 4 to 22 m to either side of the course, evenly spread along it whatever n is."""
    curve, normals = course_curve(4096)
    index = np.floor(4096 * np.mod(0.5 + _GOLDEN * np.arange(n), 1.0)).astype(int)
    draws = np.random.default_rng(np.random.SeedSequence((_COURSE_SEED, 1))).random((n, 2))
    offsets = (4.0 + 18.0 * draws[:, 0]) * np.where(draws[:, 1] < 0.5, -1.0, 1.0)
    return np.asarray(curve[index] + offsets[:, None] * normals[index])


def course_curve(count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` points at equal distances along the closed course, and its unit normals (to the left).

    A wavy circle r(a) = 1 + sum b_k cos(k a + p_k): one radius for every angle, so it cannot cross
    itself. It is scaled to its length and laid through the origin with its tangent along x.
    """
    phases = np.random.default_rng(np.random.SeedSequence((_COURSE_SEED, 0))).uniform(0, 2 * np.pi, 3)
    angle = np.linspace(0.0, 2.0 * np.pi, 20_001)
    radius = 1.0 + sum(b * np.cos(k * angle + p) for (k, b), p in zip(_COURSE_BENDS, phases))
    fine = (radius * np.exp(1j * angle)).astype(complex)
    along = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(fine)))])
    at = along[-1] / count * np.arange(count)
    points = np.interp(at, along, fine.real) + 1j * np.interp(at, along, fine.imag)
    tangents = np.roll(points, -1) - np.roll(points, 1)
    tangents /= np.abs(tangents)
    points = (points - points[0]) / tangents[0] * (_COURSE_LENGTH / along[-1])
    normals = 1j * tangents / tangents[0]
    return np.column_stack([points.real, points.imag]), np.column_stack([normals.real, normals.imag])


def course_waypoints() -> np.ndarray:
    """(17, 2) m, at equal distances; the start itself is the last one and closes the lap."""
    curve, _ = course_curve(_COURSE_WAYPOINTS * 64)
    return np.roll(curve[::64], -1, axis=0)


def apart(points: np.ndarray, distance: float, count: int) -> np.ndarray:
    """The first `count` of (M, 2) points that are at least `distance` m from every one taken before."""
    taken = np.zeros((0, 2))
    for point in points:
        if len(taken) < count and (np.hypot(*(taken - point).T) >= distance).all():
            taken = np.append(taken, point[None], axis=0)
    if len(taken) < count:
        raise ConfigError(f"there is no room for {count} features {distance:g} m apart")
    return taken


def rounded(corners: np.ndarray, radius: float) -> np.ndarray:
    """Three way-points (3 K, 2) on the arc that rounds each right-angled corner (K, 2) of a closed way."""
    before = np.roll(corners, 1, axis=0) - corners
    after = np.roll(corners, -1, axis=0) - corners
    before, after = (side / np.hypot(*side.T)[:, None] for side in (before, after))
    cut = 1.0 - np.sqrt(0.5)  # of the radius, along both sides: the middle of the arc
    arcs = [corners + radius * before, corners + radius * cut * (before + after), corners + radius * after]
    return np.stack(arcs, axis=1).reshape(-1, 2)


def _around(waypoints: np.ndarray) -> Area:
    """The box around a course with 20 m to spare on every side."""
    (x_least, y_least), (x_most, y_most) = waypoints.min(axis=0) - 20.0, waypoints.max(axis=0) + 20.0
    return float(x_least), float(y_least), float(x_most), float(y_most)
