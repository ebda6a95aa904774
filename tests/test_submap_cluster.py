"""The tree of joins on a local cluster of two workers."""

import numpy as np
import pytest

from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.joiner import LandmarkJoiner
from submap_problems import LinearDrive

pytest.importorskip("distributed")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dense_limit", [10**9, 60])
def test_two_workers_come_to_the_same_numbers_bit_for_bit(dense_limit):
    """Oracle: the forest in this process."""
    from distributed import Client, LocalCluster, get_task_stream

    from kalmap.slam.submaps.cluster import join_on_cluster

    maps = LinearDrive(np.random.default_rng(3), 44).maps(4, heading_variance=1e-8)
    joiner = LandmarkJoiner(gate=1.0, dense_limit=dense_limit)
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
    (here,), (joined,) = forest.maps, there.maps
    assert len(workers) == 2
    assert (joined.covariance is None) == (dense_limit == 60)
    for name in ("frames", "end", "landmarks", "end_covariance", "ids", "sightings"):
        assert getattr(joined, name).tobytes() == getattr(here, name).tobytes(), name
    if joined.covariance is not None:
        assert joined.covariance.tobytes() == here.covariance.tobytes()
    assert there.refusals == forest.refusals
