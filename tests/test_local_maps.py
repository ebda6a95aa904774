"""The published local maps, joined by their ids: against batch least squares and truth."""

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.stats import chi2

from batch_local_maps import batch
from kalmap.data.local_maps import read_local_maps
from kalmap.records import LogError
from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.joiner import LandmarkJoiner
from kalmap.slam.submaps.local_map import local_map
from kalmap.slam.submaps.recovery import Recovery
from real_data import data_root  # noqa: F401
from submap_problems import rows_by_id

NAMES = ("VicPark_200", "DLR_200", "sim_8240_50")
COUNTS = {"VicPark_200": (200, 299), "DLR_200": (200, 549), "sim_8240_50": (50, 612)}


@pytest.fixture(scope="module", params=NAMES)
def case(request, data_root):  # noqa: F811
    """Name, the stored maps, the joined map."""
    folder = data_root / "local_maps" / request.param
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    stored = read_local_maps(folder)
    forest = Forest(LandmarkJoiner(gate=1.0))
    for each in stored:
        forest.close(local_map(each.mean, each.covariance, each.ids))
    forest.finish()
    (joined,) = forest.maps
    return request.param, stored, joined


def _truth(root, name, ids):
    """(N, 2): the simulator's, or the published batch solution of the raw data."""
    if name == "sim_8240_50":
        rows = loadmat(root / "local_maps" / name / "store_beaconsTrue.mat")["store_beaconsTrue"]
        return rows[np.searchsorted(rows[:, 0], ids), 1:]
    file = {
        "VicPark_200": "victoria_park/LS_result_VicPark_original_cov_global_minimum.mat",
        "DLR_200": "dlr/LS_result_DLR_original_cov_global_minimum.mat",
    }[name]
    state = loadmat(root / file)["Xstate_LS"]
    points = state[state[:, 1] == 2]
    numbers, places = points[::2, 2].astype(int), points[:, 0].reshape(-1, 2)
    order = np.argsort(numbers)
    return places[order][np.searchsorted(numbers[order], ids)]


def _rms(difference):
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def test_joined_maps_are_within_five_percent_of_the_batch(case, data_root):  # noqa: F811
    """Independent: tests/batch_local_maps.py, which shares no code with the joins."""
    name, stored, joined = case
    assert (len(stored), len(joined)) == COUNTS[name]
    ids, landmarks, end, squared = batch(stored)
    mine = joined.landmarks[rows_by_id(joined, ids)]
    truth = _truth(data_root, name, ids)
    assert _rms(mine - truth) <= 1.05 * _rms(landmarks - truth)
    assert _rms(mine - landmarks) < 1e-4
    assert np.abs(joined.end[:2] - end[:2]).max() < 1e-4
    assert joined.squared == pytest.approx(squared, rel=1e-6)


def test_the_simulated_map_knows_how_wrong_it_is(case, data_root):  # noqa: F811
    """All landmarks jointly against truth, in the frame of the start, which is exactly known: no gauge is left."""
    name, _, joined = case
    if name != "sim_8240_50":
        pytest.skip("no truth")
    error = (joined.landmarks - _truth(data_root, name, joined.ids)).ravel()
    covariance = Recovery(joined).joint(np.array([], dtype=int), np.arange(len(joined)))
    nees = float(error @ np.linalg.solve(covariance, error))
    low, high = chi2.ppf([0.025, 0.975], len(error))
    assert low < nees < high


def test_what_is_no_folder_of_local_maps_is_told(tmp_path):
    with pytest.raises(LogError, match="localmap_1"):
        read_local_maps(tmp_path)
    (tmp_path / "localmap_1.mat").write_bytes(b"nothing of the kind")
    with pytest.raises(LogError, match="localmap_1"):
        read_local_maps(tmp_path)
