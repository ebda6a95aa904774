import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmap.evaluation import pair_by_nearest, score_by_id, score_by_nearest
from kalmap.geometry.alignment import apply

TRUTH = np.random.default_rng(4).uniform(-50, 50, (20, 2))
TRUTH = TRUTH[[np.sort(np.hypot(*(TRUTH - row).T))[1] > 5 for row in TRUTH]]
IDS = np.arange(100, 100 + len(TRUTH))


def test_by_id_by_hand():
    ids = np.array([102, 100, 7])
    positions = np.array([TRUTH[2] + [3, 4], TRUTH[0], [0.0, 0.0]])
    score = score_by_id(ids, positions, IDS, TRUTH)
    assert score.rmse == pytest.approx(np.sqrt(12.5))
    assert (score.matched, score.missed, score.spurious, score.doubled) == (2, len(TRUTH) - 2, 1, 0)


def test_a_doubled_id_counts_once():
    score = score_by_id(np.array([100, 100]), TRUTH[[0, 1]], IDS, TRUTH)
    assert (score.matched, score.spurious, score.doubled, score.rmse) == (1, 1, 1, 0.0)


@given(angle=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_the_aligned_error_forgets_a_rigid_motion(angle, x, y):
    score = score_by_id(IDS, apply(angle, np.array([x, y]), TRUTH), IDS, TRUTH)
    assert score.aligned_rmse < 1e-9
    assert score.matched == len(TRUTH)


def test_by_nearest_counts_missed_spurious_and_doubled():
    positions = np.concatenate([TRUTH[1:] + 0.1, TRUTH[[3]] - 0.3, [[500.0, 500.0]]])
    score = score_by_nearest(positions, TRUTH, cutoff=2.0)
    assert (score.matched, score.missed, score.spurious, score.doubled) == (len(TRUTH) - 1, 1, 2, 1)
    assert score.rmse == pytest.approx(0.1 * np.sqrt(2))
    assert score.aligned_rmse < 1e-9


def test_by_nearest_finds_its_features_in_a_shifted_and_turned_map():
    score = score_by_nearest(apply(0.03, np.array([1.0, -0.5]), TRUTH), TRUTH, cutoff=2.0)
    assert score.matched == len(TRUTH)
    assert score.aligned_rmse < 1e-9 < 0.5 < score.rmse


def test_nearest_pairs_are_one_to_one_and_least_in_total():
    rows, columns = pair_by_nearest(np.array([[0.0, 0], [1.0, 0]]), np.array([[0.9, 0], [2.0, 0]]), 5.0)
    assert list(zip(rows.tolist(), columns.tolist())) == [(0, 0), (1, 1)]
    rows, _ = pair_by_nearest(np.array([[0.0, 0]]), np.array([[5.0, 0]]), 5.0)
    assert len(rows) == 0


@pytest.mark.parametrize(("mine", "theirs"), [(0, 3), (3, 0), (0, 0)])
def test_empty_maps(mine, theirs):
    for score in (
        score_by_nearest(TRUTH[:mine], TRUTH[:theirs]),
        score_by_id(IDS[:mine], TRUTH[:mine], IDS[:theirs], TRUTH[:theirs]),
    ):
        assert score.rmse is score.aligned_rmse is None
        assert (score.matched, score.missed, score.spurious, score.doubled) == (0, theirs, mine, 0)
