"""Loops between closed maps: what is believed, what is left open, what is undone. Oracle: the true frames."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contour_drives import SICK, Drive, closed_of, rules_for
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.simulate.catalogue import world_by_name
from kalmap.simulate.floor_run import simulate_floor
from kalmap.simulate.rooms import rooms_world
from kalmap.slam.contours.belief import CONTRADICTS
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.matching import Overlay
from kalmap.slam.contours.wider import Glimpse
from made_maps import made_map, room

ROOM = [*room(0.0, 0.0, 6.0, 4.0), [1.5, 2.8, 1.5, 1.2], [1.5, 1.2, 2.4, 1.2]]
"""Not the same from any other side."""
HALL = [[0.0, 9.0, 20.0, 9.0], [20.0, 9.0, 20.0, 14.0], [20.0, 14.0, 0.0, 14.0], [7.0, 11.0, 7.0, 12.5]]


def moved(walls, x, y):
    return [[x1 + x, y1 + y, x2 + x, y2 + y] for x1, y1, x2, y2 in walls]


def with_end(closed, end, sigma, turn):
    """The same map with another end, as sure as sigma m and turn rad say, independent of its samples."""
    mean, covariance = closed.mean.copy(), closed.covariance.copy()
    mean[:3] = end
    covariance[:3], covariance[:, :3] = 0.0, 0.0
    covariance[:3, :3] = np.diag([sigma**2, sigma**2, turn**2])
    return msgspec.structs.replace(closed, mean=mean, covariance=covariance)


def driven(places, *, sigma=0.05, turn=0.01, seed=1, wrong=None):
    """Loops after maps of walls, each at its true frame. places: (walls, frame) in turn.

    Between frames the maps' ends err by sigma m and turn rad; wrong: {number: (3,)}, by how much more.
    """
    rng, loops = np.random.default_rng(seed), Loops()
    frames = [np.asarray(frame, dtype=float) for _, frame in places]
    for k, (walls, _) in enumerate(places):
        after = frames[min(k + 1, len(frames) - 1)]
        end = compose(inverse(frames[k]), after) + rng.normal(0, [sigma, sigma, turn])
        if wrong is not None and k in wrong:
            end = end + np.asarray(wrong[k])
        loops.close(
            with_end(made_map(walls, frames[k], after, rng=rng, phase=0.07 * (k % 4)), end, sigma, turn)
        )
    return loops, np.array(frames)


def errors(loops, frames):
    """(n,) m and (n,) rad."""
    truth = np.array([compose(inverse(frames[0]), frame) for frame in frames])
    found = loops.graph.frames
    return np.hypot(*(found - truth)[:, :2].T), np.abs(wrap(found[:, 2] - truth[:, 2]))


def pairs(loops):
    return {(r.first, r.second) for r in loops.graph.relations if r.loop}


AWAY = (HALL, [10.0, 11.5, 0.5])
HERE = [(ROOM, [3.0, 2.0, 0.1]), (ROOM, [3.5, 2.5, 2.0]), (ROOM, [2.8, 1.5, -1.0])]


def test_a_true_loop_is_found():
    """There, away, and back with 0.3 m of drift."""
    loops, frames = driven([HERE[0], AWAY, HERE[1]], sigma=0.3, turn=0.04, seed=2)
    assert (0, 2) in pairs(loops) and not {(0, 1), (1, 2)} & pairs(loops)
    off, turned = errors(loops, frames)
    assert off[2] < 0.03 and turned[2] < 0.01
    spread = np.sqrt(np.diag(loops.graph.covariance()))[-3:]
    assert spread[0] < 0.1 and spread[2] < 0.02


def test_two_rooms_that_are_the_same_are_not_confused():
    """The way to the second is known to 1 m, so that either could be meant: left open or told apart."""
    other, told = moved(ROOM, 6.3, 0.0), []
    for seed in range(8):
        places = [([*ROOM, *other], [3.0, 2.0, 0.1]), AWAY, (other, [9.3, 2.0, 0.1])]
        loops, frames = driven(places, sigma=1.0, turn=0.03, seed=seed)
        off, _ = errors(loops, frames)
        assert (0, 2) not in pairs(loops) or off[2] < 0.1
        told.append("loop" if (0, 2) in pairs(loops) else loops.open.get((0, 2), "nothing found"))
    assert told.count("nothing found") < 5
    for seed in range(8):  # and to 2 m, which is more than is searched: never believed
        loops, _ = driven(places, sigma=2.0, turn=0.05, seed=seed)
        assert (0, 2) not in pairs(loops)


def test_a_place_that_contradicts_the_drive_is_not_believed():
    """Another room that looks the same, 6.3 m away by an odometry that is sure: no loop."""
    loops, frames = driven([HERE[0], (moved(ROOM, 6.3, 0.0), [9.3, 2.0, 0.1])], sigma=0.05)
    assert pairs(loops) == set()
    loops, _ = driven([HERE[0], AWAY, (moved(ROOM, 1.2, 0.0), [4.2, 2.0, 0.1])], sigma=0.05)
    assert pairs(loops) == set() and (0, 2) in loops.open
    loops, frames = driven([HERE[0], AWAY, (moved(ROOM, 0.9, 0.0), [3.9, 2.0, 0.1])], sigma=0.05)
    assert pairs(loops) == set() and loops.open[0, 2].startswith(CONTRADICTS)
    assert errors(loops, frames)[0].max() < 0.3


def test_a_jump_of_the_drive_is_outvoted():
    """The drive says that it knows the way away and back to 3 cm, and is wrong by 0.4 m: three maps say where it is.

    (Farther than 0.3 m and 3 deviations nothing is searched: a jump that the drive does not know of stays.)
    """
    again = [(ROOM, [3.3, 2.2, 0.6]), (ROOM, [2.5, 2.4, -0.4])]
    loops, frames = driven([*HERE, AWAY, *again], sigma=0.03, wrong={3: [0.3, -0.25, 0.0]})
    off, turned = errors(loops, frames)
    assert {(0, 4), (1, 4), (2, 4)} & pairs(loops)
    assert off[4:].max() < 0.06 and turned[4:].max() < 0.02


def test_a_false_place_that_maps_vote_for_is_undone():
    """Two maps say the same false place of a third that loops hold elsewhere: all is as it was."""
    loops, frames = driven([*HERE, (ROOM, [3.3, 2.2, 0.6])])
    assert len(pairs(loops)) == 6
    before, kept = loops.graph.frames.copy(), dict(loops.open)
    shifted = frames[3] + [0.5, 0.3, 0.0]
    false = [
        Overlay(compose(inverse(frames[k]), shifted), 1e-4 * np.eye(3), np.zeros((3, 3)), 15.0, 0.9, 10.0, 70)
        for k in (0, 1)
    ]
    loops._vote([Glimpse(k, 3, place) for k, place in enumerate(false)])
    assert np.array_equal(loops.graph.frames, before) and loops.open == kept
    assert pairs(loops) == {(i, j) for j in range(4) for i in range(j)}
    assert errors(loops, frames)[0].max() < 0.03


def test_maps_without_samples_do_no_harm():
    loops, frames = driven([HERE[0], (ROOM, [3.5, 2.5, 0.3])])
    bare = made_map(ROOM, frames[1], frames[1])
    empty = msgspec.structs.replace(
        bare,
        mean=bare.mean[:3],
        covariance=1e-4 * np.eye(3),
        normals=np.zeros((0, 2)),
        sightings=np.zeros(0, int),
    )
    for _ in range(2):
        loops.close(empty)
    assert np.isfinite(loops.graph.frames).all() and len(loops.graph.frames) == 4


def closed_loops(world, seed):
    log, loops = simulate_floor(world, seed), Loops()
    drive = Drive(log, rules_for(log), on_closed=loops.close)
    loops.close(closed_of(drive.live))
    off, turned = errors(loops, np.array(drive.starts))
    wrong = [
        relation
        for relation in loops.graph.relations
        if relation.loop and np.hypot(*(relation.pose - _true(drive, relation))[:2]) > 1.0
    ]
    far = [
        relation
        for relation in loops.graph.relations
        if relation.loop and relation.second - relation.first > 2
    ]
    return loops, off, turned, far, wrong


def _true(drive, relation):
    return compose(inverse(drive.starts[relation.first]), drive.starts[relation.second])


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_a_floor_of_rooms_end_to_end(seed):
    """rooms-4 with a SICK. Seeds 1 to 5: frames at most 0.02 to 0.05 m off, the chain alone 0.06 to 0.14 m."""
    _, off, turned, far, wrong = closed_loops(rooms_world(4, **SICK), seed)
    assert off.max() < 0.1 and turned.max() < 0.01
    assert len(far) >= 3 and not wrong


@pytest.mark.parametrize("seed", [1, 2])
def test_the_papers_floor_end_to_end(seed):
    """floor-115 with a URG. Measured, seeds 1 to 3: 0.14 to 0.23 m, the chain alone 0.37 to 0.48 m."""
    _, off, turned, far, wrong = closed_loops(world_by_name("floor-115"), seed)
    assert off.max() < 0.35 and turned.max() < 0.03
    assert len(far) >= 2 and not wrong
