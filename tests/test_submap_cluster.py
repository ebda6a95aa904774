"""The tree of joins on a local cluster of two workers: landmark maps and contour maps."""

import numpy as np
import pytest

from kalmap.slam.contours.join import join_contours
from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.joiner import LandmarkJoiner
from submap_problems import LinearDrive
from wall_maps import wall_map, wall_samples

pytest.importorskip("distributed", reason="needs the extra kalmap[cluster]")

HALL = np.array(
    [
        [0, 0, 7, 0], [7, 0, 7, -1], [7, -1, 10, -1], [10, -1, 10, 0], [10, 0, 20, 0], [20, 0, 20, 4],
        [20, 4, 15, 4], [15, 4, 15, 3], [15, 3, 13, 3], [13, 3, 13, 4], [13, 4, 0, 4], [0, 4, 0, 0],
    ],
    dtype=float,
)  # fmt: skip
"""(12, 4) m, seen from inside: 20 m x 4 m with a niche and a pillar."""


def landmark_maps(dense_limit):
    """A joiner and 11 maps."""
    maps = LinearDrive(np.random.default_rng(3), 44).maps(4, heading_variance=1e-8)
    return LandmarkJoiner(gate=1.0, dense_limit=dense_limit), maps


def contour_maps():
    """A joiner and 7 maps, each of 7 m of the hall; the last but one shows the upper wall 0.3 m too far out."""
    rng, maps = np.random.default_rng(4), []
    for k in range(7):
        start, end = (np.array([1.0 + 2.5 * i, 2.0, 0.1 * (-1) ** i]) for i in (k, k + 1))
        points, normals = wall_samples(HALL, 0.3, 0.05 + 0.03 * k, start[0] - 2.0, start[0] + 5.0)
        points = points + 0.3 * (k == 5) * (points[:, 1:] > 2.0) * [0.0, 1.0]
        maps.append(wall_map(rng, start, end, points, normals, drift=(0.005, 0.005, 0.001)))
    return join_contours, maps


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("problem", ["landmarks", "landmarks in information form", "contours"])
def test_two_workers_come_to_the_same_numbers_bit_for_bit(problem):
    """Oracle: the forest in this process."""
    from distributed import Client, LocalCluster, get_task_stream

    from kalmap.slam.submaps.cluster import join_on_cluster

    sparse, refused = problem == "landmarks in information form", problem == "contours"
    joiner, maps = contour_maps() if problem == "contours" else landmark_maps(60 if sparse else 10**9)
    forest = Forest(joiner)
    for each in maps:
        forest.close(each)
    forest.finish()
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        with get_task_stream(client) as tasks:
            there = join_on_cluster(client, joiner, maps)
        workers = {task["worker"] for task in tasks.data}
    assert len(workers) == 2
    assert (forest.maps[0].covariance is None) == sparse and (forest.refusals > 0) == refused
    assert there.refusals == forest.refusals
    assert len(there.maps) == len(forest.maps) < len(maps)
    for here, joined in zip(forest.maps, there.maps):
        for name in here.__struct_fields__:
            expected, got = getattr(here, name), getattr(joined, name)
            assert type(got) is type(expected)
            if isinstance(expected, np.ndarray):
                assert got.tobytes() == expected.tobytes(), name
