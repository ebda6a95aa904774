"""The local region: an index that follows the moving map, and which landmarks it lets take part."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Expected, Nearest, Region
from kalmap.gaussian import Belief
from kalmap.geometry.angles import wrap
from kalmap.models import RangeBearing
from kalmap.records import Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.engines import CompiledEngine
from kalmap.slam.predicted import PredictedMap
from kalmap.slam.region import LandmarkIndex
from slam_problems import LINEARISERS, belief_of, circle_events, motions


def brute(belief: Belief, sensor, reach: float, front: float) -> list[int]:
    """Equation (10), every landmark looked at."""
    gap = belief.mean[belief.robot : belief.n].reshape(-1, 2) - np.array(sensor[:2])
    ahead = gap @ [np.cos(sensor[2]), np.sin(sensor[2])]
    return np.flatnonzero((np.hypot(*gap.T) < reach) & (ahead > front)).tolist()


def scattered(rng, count: int, robot: int = 3, width: float = 60.0) -> Belief:
    """A belief about landmarks all over a square; the covariance plays no part."""
    mean = np.r_[np.zeros(robot), rng.uniform(-width, width, 2 * count)]
    return belief_of(mean, np.eye(len(mean)), robot)


def look(rng, belief: Belief, index: LandmarkIndex) -> list[int]:
    """Ask for a random region, and for the strange ones, and compare: how many landmarks are in each of the six."""
    sizes = []
    sensor = (*rng.uniform(-70, 70, 2).tolist(), float(rng.uniform(-np.pi, np.pi)))
    for reach, front in (
        (rng.uniform(0.1, 40), rng.uniform(-10, 5)),
        (rng.uniform(0.1, 40), -np.inf),
        (np.inf, -3.0),
        (np.inf, -np.inf),
        (1e9, -np.inf),
        (0.0, -np.inf),
    ):
        got = index.within(belief, sensor, reach, front)
        assert got.dtype == np.int64
        assert got.tolist() == brute(belief, sensor, reach, front)
        sizes.append(len(got))
    return sizes


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("robot", [3, 5])
def test_index_equals_brute_force_whatever_happens_to_the_map(seed, robot):
    """Oracle: every landmark looked at, after random founding, moving (by less and by more than is tolerated
    without filing again) and removing."""
    rng = np.random.default_rng(seed)
    belief, index = scattered(rng, int(rng.integers(0, 200)), robot), LandmarkIndex()
    found = np.zeros(6, int)
    for _ in range(60):
        what, count = rng.integers(4), (belief.n - robot) // 2
        if what == 0:
            added = int(rng.choice([1, 5, 80]))
            twin = scattered(rng, count + added, robot)
            twin.mean[: belief.n] = belief.mean[: belief.n]
            belief = twin
        elif what == 1 and count:
            step = rng.choice([0.01, 0.4, 2.0, 9.0]) * rng.uniform(-1, 1, (count, 2))
            belief.mean[robot : belief.n] += step.ravel()
            index.moved(float(np.hypot(*step.T).max()))
        elif what == 2:
            for first in sorted(rng.choice(count, min(count, 3), replace=False).tolist(), reverse=True):
                belief.remove(robot + 2 * first, 2)
                index.removed(first)
        sizes = look(rng, belief, index)
        every = (belief.n - robot) // 2
        assert sizes[3:] == [every, every, 0]  # without limit, very far, and no reach at all
        found += sizes
    assert (found[:3] > 0).all() and (found[:3] < found[3]).all()


@pytest.mark.parametrize("towards", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_landmarks_that_come_in_from_cells_not_asked_for_are_found(towards):
    """Oracle: by hand: filed just beyond the border of a cell, 12 m away, it then moves into reach across it."""
    rng, direction = np.random.default_rng(0), np.array(towards, float)
    belief, index = scattered(rng, 100), LandmarkIndex()
    belief.mean[3 : belief.n] += 1000.0
    belief.mean[9:11] = 12.01 * direction
    origin, reach = (0.0, 0.0, 0.0), 11.995
    assert index.within(belief, origin, reach, -np.inf).tolist() == []
    belief.mean[9:11] = 11.9 * direction
    index.moved(0.11)
    assert index.within(belief, origin, reach, -np.inf).tolist() == [3]


@pytest.mark.parametrize("gone", [0, 50, 98, 99, 100, 104])
def test_removal_at_the_border_of_what_is_filed(gone):
    """Oracle: brute force; a hundred landmarks filed, five founded since, one gone."""
    rng = np.random.default_rng(1)
    belief, index = scattered(rng, 100), LandmarkIndex()
    assert look(rng, belief, index)[3] == 100
    twin = scattered(rng, 105)
    twin.mean[: belief.n] = belief.mean[: belief.n]
    assert look(rng, twin, index)[3] == 105
    twin.remove(3 + 2 * gone, 2)
    index.removed(gone)
    for _ in range(5):
        assert look(rng, twin, index)[3] == 104


def test_empty_map():
    """Oracle: nothing, of the right type."""
    belief, index = Belief(np.zeros(3), np.eye(3)), LandmarkIndex()
    for reach in (5.0, 0.0, np.inf):
        got = index.within(belief, (0.0, 0.0, 0.0), reach, -np.inf)
        assert got.shape == (0,) and got.dtype == np.int64


class Listening(LandmarkIndex):
    """An index that adds up what it is told, and files every landmark whenever it is asked."""

    __slots__ = ("told",)

    def __init__(self) -> None:
        super().__init__()
        self.told = 0.0

    def moved(self, distance: float) -> None:
        self.told += distance
        super().moved(distance)

    def within(self, belief, sensor, reach, front):
        self._file(belief, (belief.n - belief.robot) // 2)
        return super().within(belief, sensor, reach, front)


def landmarks_of(slam: LandmarkSlam) -> dict[int, np.ndarray]:
    """Position by lasting number, a copy."""
    return dict(zip(slam._ids, slam._belief.mean[3 : slam._belief.n].reshape(-1, 2).copy(), strict=True))


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_the_filter_tells_the_index_of_every_correction(coordinates):
    """Oracle: how far the farthest landmark moved in each step, and in a merger: the index is told at least that,
    and no more than three times as much; and its answer is brute force's."""
    slam = LandmarkSlam(
        association=Nearest(gate=0.6, new_gate=0.6),
        coordinates=coordinates,
        start_covariance=np.diag([1.0, 1.0, 0.02]),
    )
    slam._index, moving = Listening(), 0
    steps = [lambda e=event: slam.step(e) for event in circle_events(4, frames=40)]
    for step in [*steps, lambda: slam._merge(0, 1), lambda: slam._merge(2, 3)]:
        before, slam._index.told = landmarks_of(slam), 0.0
        step()
        after = landmarks_of(slam)
        farthest = max((np.hypot(*(after[i] - before[i])) for i in before), default=0.0)
        assert farthest <= slam._index.told <= 3.0 * farthest
        moving += farthest > 0.01
        got = slam._index.within(slam._belief, (*slam.pose,), 15.0, -2.0)
        assert got.tolist() == brute(slam._belief, slam.pose, 15.0, -2.0)
    assert moving > 20 and farthest > 0.1


# --- the region's shape -------------------------------------------------------------------------------


def view(max_range: float, field_of_view: float, sigma: float = 0.0, count: int = 400) -> PredictedMap:
    """A map of `count` landmarks about a robot with a mounted sensor."""
    rng = np.random.default_rng(4)
    belief = scattered(rng, count, width=45.0)
    belief.mean[:3] = (3.0, -2.0, 2.5)
    belief.packed[:6] = (sigma**2, 0.0, 0.25 * sigma**2, 0.0, 0.0, 1e-4)
    sensor = RangeBearing(mount=(1.0, 0.5, 0.3), max_range=max_range, field_of_view=field_of_view)
    engine = CompiledEngine(motions(0)["unicycle"], sensor, LINEARISERS["jacobian"], True, False)
    frame = Sightings(0.0, np.zeros((0, 2)))
    return PredictedMap(engine, belief, sensor, LandmarkIndex(), frame, np.zeros((0, 2, 2)))


def polar(predicted: PredictedMap) -> tuple[np.ndarray, np.ndarray]:
    """Range and bearing of every landmark from the sensor."""
    x, y, heading = predicted.sensor_pose
    gap = predicted.positions(np.arange(predicted.count)) - (x, y)
    return np.hypot(*gap.T), wrap(np.arctan2(gap[:, 1], gap[:, 0]) - heading)


@pytest.mark.parametrize("sigma", [0.0, 1.5])
@pytest.mark.parametrize("field_of_view", [0.5 * np.pi, np.pi, 1.5 * np.pi, 2 * np.pi])
@pytest.mark.parametrize("region", [Region(), Region(pad=4.0, turn=0.3), Region(pad=0.0, turn=0.0)])
def test_candidates_are_equation_10(region, field_of_view, sigma):
    """Oracle: |l - s| < R + d and, where the sensor sees no more than the half plane ahead, (l - s) . ahead >
    -turn R; both wider by three standard deviations of the position."""
    predicted = view(20.0, field_of_view, sigma)
    distance, bearing = polar(predicted)
    expected = distance < 20.0 + region.pad + 3 * sigma
    if field_of_view <= np.pi:
        expected &= distance * np.cos(bearing) > -region.turn * 20.0 - 3 * sigma
    got = region.candidates(predicted)
    assert got.tolist() == np.flatnonzero(expected).tolist()
    assert 0 < len(got) < predicted.count


def test_without_a_region_all_take_part():
    """Oracle: every index."""
    assert Region(local=False).candidates(view(5.0, 1.0)).tolist() == list(range(400))


def polar_expected(count=2000, seed=5) -> Expected:
    rng = np.random.default_rng(seed)
    z = np.c_[rng.uniform(0, 25, count), rng.uniform(-np.pi, np.pi, count)]
    return Expected(np.arange(count), z, np.zeros((count, 2, 5)), np.zeros((count, 2, 2)))


@pytest.mark.parametrize(
    "region", [Region(pad=2.0, turn=0.1), Region(pad=5.0, turn=0.25), Region(reliable_range=12.0)]
)
@pytest.mark.parametrize("field_of_view", [0.4, 0.5 * np.pi, np.pi, 1.5 * np.pi, 2 * np.pi])
def test_inside_is_equation_7(region, field_of_view):
    """Oracle: nearer than R - d, inside the sector, and farther than turn R from both of its edges, as the distance
    from a ray; for the half plane that is the paper's (l - s) . ahead > turn R."""
    expected, reach = polar_expected(), min(20.0, region.reliable_range or 20.0)
    distance, bearing = expected.z.T
    points, half = distance[:, None] * np.c_[np.cos(bearing), np.sin(bearing)], 0.5 * field_of_view
    wanted = (distance < reach - region.pad) & (np.abs(bearing) <= half)
    if field_of_view < 2 * np.pi:
        for edge in (half, -half):
            along = points @ [np.cos(edge), np.sin(edge)]
            foot = np.maximum(along, 0.0)[:, None] * [np.cos(edge), np.sin(edge)]
            wanted &= np.hypot(*(points - foot).T) > region.turn * reach
    if field_of_view == np.pi:
        paper = (distance < reach - region.pad) & (points[:, 0] > region.turn * reach)
        np.testing.assert_array_equal(wanted, paper)
    got = region.in_view(view(20.0, field_of_view), expected, shrink=True)
    np.testing.assert_array_equal(got, wanted)
    assert wanted.any() == (
        field_of_view > 0.4 or region.turn < 0.2
    )  # else the sector is narrower than its edges


@pytest.mark.parametrize("region", [Region(), Region(pad=5.0, turn=0.25), Region(reliable_range=12.0)])
@pytest.mark.parametrize("field_of_view", [0.4, np.pi, 1.5 * np.pi, 2 * np.pi])
def test_the_view_itself_has_no_margin(region, field_of_view):
    """Oracle: the definition, with the angle from the landmark's place: near enough, and to neither side too far."""
    expected, reach = polar_expected(), min(20.0, region.reliable_range or 20.0)
    distance, bearing = expected.z.T
    points = distance[:, None] * np.c_[np.cos(bearing), np.sin(bearing)]
    wanted = (np.hypot(*points.T) < reach) & (np.abs(np.arctan2(*points.T[::-1])) < 0.5 * field_of_view)
    np.testing.assert_array_equal(region.in_view(view(20.0, field_of_view), expected), wanted)


@pytest.mark.parametrize("field_of_view", [1.0, np.pi, 2 * np.pi])
@pytest.mark.parametrize("region", [Region(), Region(pad=0.0, turn=0.0)])
def test_a_sensor_without_limit(region, field_of_view):
    """Oracle: every landmark may take part where the front line is infinitely far behind, those ahead of it where it
    is not moved; nothing is a number that is not one."""
    predicted = view(np.inf, field_of_view)
    got = region.candidates(predicted)
    _, bearing = polar(predicted)
    ahead = np.abs(bearing) < 0.5 * np.pi
    everything = field_of_view > np.pi or region.turn > 0.0
    assert got.tolist() == (list(range(400)) if everything else np.flatnonzero(ahead).tolist())
    inside = region.in_view(predicted, polar_expected(), shrink=True)
    assert inside.dtype == bool and inside.any() == (field_of_view > 6 or region.turn == 0.0)
    assert region.in_view(predicted, polar_expected()).any()
