import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmap.evaluation import chi2_band, mean_nees, nis_summary, pose_error, pose_nees, share_inside

COVARIANCE = np.array([[0.5, 0.1, 0.02], [0.1, 0.3, -0.01], [0.02, -0.01, 0.04]])


def draws(count, coordinates):
    """Truths whose error in these coordinates really has COVARIANCE."""
    rng = np.random.default_rng(3)
    poses = rng.uniform(-10, 10, (count, 3)) * [1, 1, 0.3]
    errors = rng.multivariate_normal(np.zeros(3), COVARIANCE, count)
    truth = poses + errors
    if coordinates == "invariant":
        t = errors[:, 2]
        a, b = np.sin(t) / t, (1 - np.cos(t)) / t
        truth[:, 0] = poses[:, 0] + a * errors[:, 0] - b * errors[:, 1]
        truth[:, 1] = poses[:, 1] + b * errors[:, 0] + a * errors[:, 1]
    return truth, poses, errors


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_nees_of_a_right_covariance_is_three(coordinates):
    truth, poses, errors = draws(4000, coordinates)
    np.testing.assert_allclose(pose_error(truth, poses, coordinates), errors, atol=1e-9)
    nees = pose_nees(truth, poses, np.broadcast_to(COVARIANCE, (4000, 3, 3)), coordinates)
    low, high = chi2_band(3, 4000, 0.999)
    assert low < mean_nees(nees) < high
    assert share_inside(nees, 3) == pytest.approx(0.95, abs=0.015)


def test_nees_by_hand():
    nees = pose_nees(np.array([[1.0, 2.0, 0.1]]), np.zeros((1, 3)), np.diag([1.0, 4.0, 0.01])[None])
    assert nees[0] == pytest.approx(3.0)


@given(turn=st.floats(-0.01, 0.01), x=st.floats(-5, 5), y=st.floats(-5, 5))
def test_both_coordinates_agree_for_small_turns(turn, x, y):
    truth, poses = np.array([[x, y, turn]]), np.zeros((1, 3))
    gap = pose_error(truth, poses, "invariant") - pose_error(truth, poses)
    assert np.abs(gap).max() <= abs(turn) * (abs(x) + abs(y)) + 1e-12


def test_errors_wrap_and_half_a_turn_is_no_trouble():
    assert pose_error(np.array([[0, 0, 3.1]]), np.array([[0, 0, -3.1]]))[0, 2] == pytest.approx(
        6.2 - 2 * math.pi
    )
    half = pose_error(np.array([[2.0, 0, np.pi]]), np.zeros((1, 3)), "invariant")
    assert np.isfinite(half).all()


def test_unknown_coordinates_are_refused():
    with pytest.raises(ValueError, match="polar"):
        pose_error(np.zeros((1, 3)), np.zeros((1, 3)), "polar")


def test_no_nees_where_the_covariance_is_not_positive_definite():
    covariances = np.stack(
        [np.zeros((3, 3)), np.diag([1, 1, -1.0]), np.ones((3, 3)), np.full((3, 3), np.nan), np.eye(3) * 1e-12]
    )
    nees = pose_nees(np.full((5, 3), 1e-6), np.zeros((5, 3)), covariances)
    np.testing.assert_array_equal(np.isnan(nees), [True, True, True, True, False])
    assert nees[4] == pytest.approx(3.0)
    assert mean_nees(nees[:4]) is None and share_inside(nees[:4], 3) is None


@pytest.mark.parametrize(("dof", "runs"), [(1, 1), (3, 1), (3, 50), (2000, 1)])
def test_bands_are_scipys(dof, runs):
    chi2 = pytest.importorskip("scipy.stats").chi2
    expected = chi2.ppf([0.025, 0.975], dof * runs) / runs
    np.testing.assert_allclose(chi2_band(dof, runs), expected, rtol=1e-9)


def test_nis_of_right_innovations_is_one_a_degree():
    rng = np.random.default_rng(5)
    dof = np.repeat([0, 2, 4, 6], 500)
    runs = []
    for _ in range(400):
        nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)), np.nan)
        runs.append(nis_summary(nis, dof))
    assert all(run.frames == 1500 for run in runs)
    assert np.mean([run.mean for run in runs]) == pytest.approx(1, abs=0.01)
    assert np.mean([run.inside for run in runs]) == pytest.approx(0.95, abs=0.005)
    # a 95 % band holds the sum of 95 % of the runs, so one run alone proves nothing
    covered = np.mean([run.low <= run.pooled <= run.high for run in runs])
    assert covered == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 400))
    assert nis_summary(2 * nis, dof).pooled > runs[0].high
    assert nis_summary(nis[:500], dof[:500]) is None
