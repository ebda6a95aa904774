"""Loops farther off than the drive's search, found by how maps look. Oracles: the true frames, copies of a map."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.slam.contours import wider
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.matching import Overlay
from kalmap.slam.contours.wider import Glimpse, Wider, most_alike, places, signature
from made_maps import made_map, room
from test_contour_loops import errors, pairs, with_end

LOST, LOST_TURN = 12.0, 0.8  # m and rad, how far the drive errs where it is lost
BACK = 12  # maps from a place to when it is seen again


def some_room(rng, x=0.0, y=0.0):
    """Walls of a room with two partitions and a pillar, at (x, y), and a place inside it."""
    width, depth = rng.uniform(6.0, 9.0), rng.uniform(4.5, 7.0)
    walls = room(x, y, x + width, y + depth)
    for _ in range(2):
        left, low = x + rng.uniform(0.5, width - 2.0), y + rng.uniform(0.5, depth - 2.0)
        walls += [
            [left, low + rng.uniform(0.8, 1.8), left, low],
            [left, low, left + rng.uniform(0.8, 1.8), low],
        ]
    return walls, np.array([x + 0.5 * width, y + 0.5 * depth, rng.uniform(-3.0, 3.0)])


def building(seed, count):
    """Rooms in a row, 12 m apart, as (walls, place)."""
    rng = np.random.default_rng(seed)
    return [some_room(rng, 12.0 * k, 3.0 * (k % 2)) for k in range(count)]


def driven(visits, seed, lost_at, shift, *, sigma=0.05, turn=0.005):
    """Loops after maps of the rooms visited, and the true frames. At map `lost_at` the drive errs by `shift` (3,) and
    says that it may; everywhere else it is as good as sigma m and turn rad say. A room is stood in elsewhere each time.
    """
    rng, loops = np.random.default_rng(seed), Loops()
    frames = [place + [*rng.uniform(-0.4, 0.4, 2), rng.uniform(-3.0, 3.0)] for _, place in visits]
    for k, (walls, _) in enumerate(visits):
        after = frames[min(k + 1, len(frames) - 1)]
        end = compose(inverse(frames[k]), after) + rng.normal(0, [sigma, sigma, turn])
        own = (sigma, turn)
        if k == lost_at:
            end, own = end + shift, (LOST, LOST_TURN)
        loops.close(with_end(made_map(walls, frames[k], after, rng=rng, phase=0.07 * (k % 4)), end, *own))
    return loops, np.array(frames)


@pytest.mark.parametrize("seed", range(4))
def test_a_map_looks_the_same_wherever_it_lies(seed):
    """The signatures of one room mapped twice, from different places and with noise, against those of other rooms."""
    rooms = building(seed, 12)
    rng = np.random.default_rng(seed)
    maps = [made_map(walls, place, place, rng=rng) for walls, place in rooms]
    maps += [
        made_map(walls, place + [0.4, -0.3, 2.0], place, rng=rng, phase=0.1) for walls, place in rooms[:4]
    ]
    signatures = np.array([signature(each) for each in maps])
    assert np.allclose(signatures.sum(axis=1), 1.0, atol=1e-4)
    for again in range(4):
        assert again in most_alike(signatures, 12 + again, np.arange(12))[:2]


@pytest.mark.parametrize("seed", range(4))
def test_a_map_is_found_turned_in_any_way(seed):
    """Among the places of a map on an earlier one is the true one, to what both maps' noise says."""
    (walls, place), rng = building(seed, 1)[0], np.random.default_rng(seed)
    there = place + [0.3, -0.5, rng.uniform(-3.0, 3.0)]
    first, second = made_map(walls, place, place, rng=rng), made_map(walls, there, there, rng=rng, phase=0.1)
    best, truth = places(first, second)[0], compose(inverse(place), there)
    assert np.hypot(*(best.pose - truth)[:2]) < 0.03 and abs(wrap(best.pose - truth)[2]) < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_that_is_lost_is_found_again(seed):
    """Twelve rooms; then, by a drive that errs by up to 25 m and 60 degrees and knows it, the first five once more."""
    rooms = building(seed, BACK)
    shift = np.random.default_rng(seed).uniform(-1.0, 1.0, 3) * [25.0, 25.0, 1.0]
    loops, frames = driven([*rooms, *rooms[:5]], seed, BACK - 1, shift)
    assert {(0, 12), (1, 13), (2, 14), (3, 15), (4, 16)} <= pairs(loops)
    off, turned = errors(loops, frames)
    assert off[BACK:].max() < 0.25 and turned[BACK:].max() < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_new_rooms_are_not_taken_for_old_ones(seed):
    """The same drive on into five rooms that were never seen: no loop."""
    loops, _ = driven(building(seed, BACK + 5), seed, BACK - 1, np.array([9.0, -14.0, 0.5]))
    assert not pairs(loops)


@pytest.mark.parametrize("seed", range(3))
def test_two_wings_that_are_the_same_leave_it_open(seed):
    """Five rooms, the same five built again elsewhere, others; lost; and back in five: in which, is not said."""
    rooms = building(seed, 7)
    rng = np.random.default_rng(seed + 9)
    copy = [
        (np.array(walls) + [0.0, 40.0, 0.0, 40.0], place + [0.0, 40.0, 0.0]) for walls, place in rooms[:5]
    ]
    others = [some_room(rng, 12.0 * k, 80.0) for k in range(8)]
    visits = [*rooms[:5], *copy, *others, *rooms[:5]]
    loops, _ = driven(visits, seed, len(visits) - 6, np.array([8.0, 5.0, 0.2]))
    lost = len(visits) - 5
    assert not any(second >= lost > first for first, second in pairs(loops))


def placed(ahead, matched):
    return Overlay(np.array([ahead, 0.0, 0.0]), 1e-4 * np.eye(3), np.zeros((3, 3)), matched, 1.0, 70.0, 70)


def glimpses(*entries):
    """Places of maps in a straight drive of 1 m from frame to frame: (first, second, how far off, matched)."""
    return [
        Glimpse(first, second, placed(second - first + off, matched))
        for first, second, off, matched in entries
    ]


def straight(count):
    loops = Loops()
    for _ in range(count - 1):
        loops.graph.append(np.array([1.0, 0.0, 0.0]), np.diag([0.01, 0.01, 1e-4]) ** 2)
    return loops.graph


@pytest.mark.parametrize(
    ("entries", "believed"),
    [
        ([(0, 20, 5.0, 20.0), (1, 21, 5.0, 20.0), (2, 22, 5.0, 20.0), (3, 23, 5.0, 20.0)], 4),
        (
            [(0, 20, 5.0, 20.0), (1, 21, 5.0, 20.0), (2, 22, 5.0, 20.0)],
            0,
        ),  # against the drive, three are too few
        ([(0, 20, 0.0, 20.0), (1, 21, 0.0, 20.0), (2, 22, 0.0, 20.0)], 3),  # with it they are enough
        ([(0, 20, 0.0, 20.0), (1, 20, 0.0, 20.0), (2, 21, 0.0, 20.0)], 0),  # two maps are not three
        ([(k, 20 + k, 5.0 + 2.0 * k, 20.0) for k in range(4)], 0),  # they contradict each other
        (
            [(0, 20, 5.0, 11.0), (1, 21, 5.0, 11.0), (2, 22, 5.0, 11.0), (3, 23, 5.0, 11.0)],
            0,
        ),  # too little contour
        ([(k, 20 + k, off, 20.0) for k in range(4) for off in (5.0, 9.0)], 0),  # a rival
    ],
)
def test_places_must_bear_each_other_out(entries, believed):
    """By hand: four maps in a row that are as far off as each other, and what is less than that."""
    looks = Wider()
    looks.glimpses = glimpses(*entries)
    agreed = looks.agreed(straight(26), 1.0)
    assert len(agreed) == believed and len({each.second for each in agreed}) == believed


def test_an_error_of_a_place_is_carried_along_the_drive():
    """Against finite differences: an error of one pose, as seen from a pose further on."""
    pose, further = np.array([1.0, -2.0, 0.7]), np.array([3.0, 0.5, -1.2])
    design = np.array(
        [
            compose(inverse(compose(pose, further)), compose(pose + 1e-6 * unit, further)) / 1e-6
            for unit in np.eye(3)
        ]
    ).T
    covariance = np.diag([0.1, 0.2, 0.03])
    assert np.allclose(wider._carried(pose, further, covariance), design @ covariance @ design.T, atol=1e-5)
