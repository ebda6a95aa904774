"""Does a map of several local maps err as it says? Oracle: the simulated truth."""

from __future__ import annotations

import os

import msgspec
import numpy as np
import pytest

from kalmap.evaluation.consistency import pose_nees
from kalmap.simulate.catalogue import world_by_name
from kalmap.simulate.floor_run import simulate_floor
from kalmap.slam.build import slam_from_config

WORLDS = ("floor-115", "floor-170", "rooms-12")


def mean_nees(world, seed):
    """Of the poses at all scans of a drive, as they are told in the end."""
    log = simulate_floor(world_by_name(world), seed)
    contour = msgspec.structs.replace(log.defaults.contour, method="dc-slasem", background=False)
    slam = slam_from_config(msgspec.structs.replace(log.defaults, contour=contour), log)
    for event in log:
        slam.step(event)
    course, truth = slam.estimate().trajectory, log.references[0]
    rows = np.searchsorted(truth.times, course.times - 1e-9)
    poses = np.column_stack([truth.positions, truth.headings])[rows]
    return float(np.nanmean(pose_nees(poses, course.poses, course.covariances)))


@pytest.mark.slow
def test_poses_over_many_local_maps_are_as_sure_as_they_say():
    """Three floors of 12 to 25 local maps by turns, with seed 1, 2 and so on: KALMAP_SLOW_SEEDS drives (default 12).

    Errors of one drive hang together: one number says little. So the geometric mean over the drives is judged, and the
    worst one. Measured over 12: 2.5, and 4.9 at worst (before loops were judged by what they share: 12.8).
    """
    drives = range(int(os.environ.get("KALMAP_SLOW_SEEDS", "12")))
    values = np.array([mean_nees(WORLDS[k % len(WORLDS)], 1 + k // len(WORLDS)) for k in drives])
    assert 1.2 < np.exp(np.log(values).mean()) < 3.6
    assert values.max() < 8.0
