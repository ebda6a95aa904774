"""The live pose of maps that stand side by side: against the join of everything."""

import msgspec
import numpy as np
import pytest

from kalmap.geometry.angles import wrap
from kalmap.slam.submaps.forest import Forest, chain
from kalmap.slam.submaps.joiner import LandmarkJoiner
from kalmap.slam.submaps.newest import newest
from submap_problems import LinearDrive


@pytest.mark.parametrize("seed", range(4))
def test_with_few_landmarks_it_is_where_the_join_of_all_maps_ends(seed):
    """Independent: the forest, finished. All shared landmarks are looked at where there are few, so both are exact."""
    maps = LinearDrive(np.random.default_rng(seed), 24, landmarks=14).maps(4)
    forest = Forest(LandmarkJoiner(gate=1.0, dense_limit=10**9))
    for each in maps:
        forest.close(each)
    assert len(forest.maps) == 2
    pose, covariance = newest(forest.maps, 1.0)
    alone = newest(tuple(maps), 1.0)
    forest.finish()
    (joined,) = forest.maps
    for place, spread in ((pose, covariance), alone):
        np.testing.assert_allclose(place[:2], joined.end[:2], atol=1e-9)
        assert abs(wrap(place[2] - joined.end[2])) < 1e-9
        np.testing.assert_allclose(spread, joined.end_covariance, atol=1e-9)
    assert np.trace(chain(maps)[1]) > 1.5 * np.trace(covariance)  # which the ends alone do not know


def test_maps_that_contradict_each_other_are_only_chained():
    maps = LinearDrive(np.random.default_rng(1), 16).maps(8, heading_variance=1e-4)
    bent = maps[1].landmarks + np.random.default_rng(2).normal(0.0, 5.0, maps[1].landmarks.shape)

    second = msgspec.structs.replace(maps[1], landmarks=bent)
    pose, covariance = newest((maps[0], second), 0.9999)
    np.testing.assert_allclose(pose, chain((maps[0], second))[0])
    np.testing.assert_allclose(covariance, chain((maps[0], second))[1], atol=1e-12)


def test_nothing_closed_yet_is_the_start():
    pose, covariance = newest((), 1.0)
    assert not pose.any() and not covariance.any()
