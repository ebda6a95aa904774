"""Ray casting on many walls, whose beams the kernel picks out by angle before it tries them."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.simulate.raycast import SICK_180, URG, cast, cast_hits

NO_CIRCLES = np.zeros((0, 3))


def every_pair(poses, bearings, max_range, segments):
    """Slow twin: every beam against every segment, by Cramer's rule on whole arrays; nothing is left out by angle."""
    ranges, names = [], []
    for x, y, heading in poses:
        u = np.array([np.cos(heading + bearings), np.sin(heading + bearings)])[:, :, None]
        a = (segments[:, :2] - [x, y]).T[:, None]
        d = (segments[:, 2:] - segments[:, :2]).T[:, None]
        cross = u[0] * d[1] - u[1] * d[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a[0] * d[1] - a[1] * d[0]) / cross
            w = (a[0] * u[1] - a[1] * u[0]) / cross
        t[~((t > 0) & (w >= 0) & (w <= 1)) | (cross == 0)] = np.inf
        nearest = t.min(axis=1)
        met = nearest <= max_range
        ranges.append(np.where(met, nearest, np.inf))
        names.append(np.where(met, t.argmin(axis=1), -1))
    return np.array(ranges), np.array(names)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scanner", [URG, SICK_180])
def test_many_walls_against_every_pair(seed, scanner):
    """Oracle: `every_pair`; walls of all lengths, some of no length, headings of several turns."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-8, 8, (20, 2)), rng.uniform(-20, 20, 20)])
    start = rng.uniform(-10, 10, (120, 2))
    segments = np.column_stack(
        [start, start + rng.normal(0, rng.choice([0.01, 1.0, 20.0], (120, 1)), (120, 2))]
    )
    segments[:3, 2:] = segments[:3, :2]
    ranges, targets = cast_hits(poses, NO_CIRCLES, scanner.bearings, 6.0, segments=segments)
    expected, names = every_pair(poses, scanner.bearings, 6.0, segments)
    assert np.isfinite(expected).mean() > 0.5 and np.isinf(expected).any()
    np.testing.assert_array_equal(targets, names)
    np.testing.assert_allclose(ranges, expected, rtol=0, atol=1e-9)


def test_bearings_of_more_than_a_turn_and_in_falling_order():
    """Oracle: `every_pair`; the same wall is met on every turn."""
    rng = np.random.default_rng(1)
    segments = rng.uniform(-5, 5, (30, 4))
    bearings = np.linspace(3.7 * np.pi, -2.2 * np.pi, 500)
    ranges = cast(np.zeros((1, 3)), NO_CIRCLES, bearings, 20.0, segments=segments)
    np.testing.assert_allclose(ranges, every_pair(np.zeros((1, 3)), bearings, 20.0, segments)[0], atol=1e-9)


def test_a_closed_polygon_lets_no_beam_through():
    """Neighbours share their corners exactly: no beam may slip between two walls, whatever its angle."""
    rng = np.random.default_rng(2)
    angles = np.linspace(0, 2 * np.pi, 721)[:-1]
    corners = 3.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    segments = np.column_stack([corners, np.roll(corners, -1, axis=0)])
    poses = np.column_stack([rng.uniform(-1.5, 1.5, (200, 2)), rng.uniform(-4, 4, 200)])
    assert np.isfinite(cast(poses, NO_CIRCLES, URG.bearings, 10.0, segments=segments)).all()
    ranges = cast(np.zeros((1, 3)), NO_CIRCLES, angles, 10.0, segments=segments)
    np.testing.assert_allclose(ranges, 3.0, atol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e-12, -1e-12, 1e-7, -1e-7, 1e-3])
def test_a_sensor_on_or_close_to_a_wall(offset):
    """Oracle: `every_pair`; a wall through the sensor, one hair to either side, and another wall ahead."""
    segments = np.array([[-2.0, offset, 3.0, offset], [1.0, -2.0, 1.0, 2.0]])
    poses = np.array([[0.0, 0.0, 0.3]])
    ranges, targets = cast_hits(poses, NO_CIRCLES, URG.bearings, 5.0, segments=segments)
    expected, names = every_pair(poses, URG.bearings, 5.0, segments)
    np.testing.assert_array_equal(targets, names)
    np.testing.assert_allclose(ranges, expected, rtol=1e-9, atol=1e-12)


def test_the_coarse_sick():
    assert len(SICK_180.bearings) == 180 and SICK_180.max_range == 80.0
    np.testing.assert_allclose(np.rad2deg(SICK_180.bearings[[0, 90, 179]]), [-90, 0, 89])
