"""What scans say of a place of one map on another. Oracle: the true relation of two maps of a simulated room."""

from __future__ import annotations

import numpy as np
import pytest

from contour_rooms import block_log, mapper
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.slam.contours.witness import Witness


@pytest.fixture(scope="module")
def driven():
    """Closed maps and legs of a drive round a block, and the true frames of the maps."""
    log = block_log()
    slam = mapper(log)
    for event in log.open(None):
        slam.step(event)
    joined, truth = slam._worker.settled(), log.references[0]
    frames = []
    for leg in joined.legs:
        row = np.searchsorted(truth.times, leg.times[-1])
        frames.append(compose(np.array([*truth.positions[row], truth.headings[row]]), inverse(leg.poses[-1])))
    return joined, Witness(joined.legs, slam.rules), np.array(frames)


def shares(driven, shift):
    """Of all pairs of maps that stand within 4.5 m of each other, `shift` (3,) beside the true place."""
    joined, witness, frames = driven
    maps, told = joined.loops.maps, []
    for second in range(len(maps)):
        for first in range(second):
            pose = compose(inverse(frames[first]), frames[second])
            if np.hypot(*pose[:2]) < 4.5:
                told.append(witness.share(maps, first, second, pose + shift))
    assert len(told) > 3
    return np.array(told)


def test_scans_see_the_walls_of_a_map_that_lies_where_it_is(driven):
    """All but a few, which see each other from a corner only."""
    told = shares(driven, np.zeros(3))
    assert np.median(told) > 0.85 and (told > 0.8).mean() > 0.8


@pytest.mark.parametrize("shift", [[0.8, 0.0, 0.0], [0.0, -0.8, 0.0], [0.0, 0.0, 0.5], [0.6, 0.6, -0.3]])
def test_scans_look_through_the_walls_of_a_map_that_lies_elsewhere(driven, shift):
    assert shares(driven, np.array(shift)).max() < 0.8


def test_the_share_is_the_same_either_way_round(driven):
    joined, witness, frames = driven
    pose = compose(inverse(frames[0]), frames[1]) + [0.3, 0.0, 0.1]
    pose[2] = wrap(pose[2])
    there, back = (
        witness.share(joined.loops.maps, 0, 1, pose),
        witness.share(joined.loops.maps, 1, 0, inverse(pose)),
    )
    assert there == pytest.approx(back)


def test_a_map_of_which_nothing_is_seen_bears_nothing_out(driven):
    joined, witness, _ = driven
    assert witness.share(joined.loops.maps, 0, 1, np.array([200.0, 0.0, 0.0])) == 0.0
