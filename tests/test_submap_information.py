"""Joined maps in information form: the same answers as with full covariances, covariances on demand."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix, triu

from kalmap.gaussian import NotPositiveError
from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.joiner import LandmarkJoiner, relinearised
from kalmap.slam.submaps.recovery import Recovery
from kalmap.slam.submaps.sparse_cholesky import SparseCholesky
from submap_problems import LinearDrive, random_maps, rows_by_id

DENSE = 10**9


def _joined(maps, dense_limit):
    forest = Forest(LandmarkJoiner(gate=1.0, dense_limit=dense_limit))
    for each in maps:
        forest.close(each)
    forest.finish()
    (joined,) = forest.maps
    return joined


def test_both_forms_agree_on_a_linear_problem():
    """Heading known to 1e-7 rad: as good as linear, and still with an inverse."""
    maps = LinearDrive(np.random.default_rng(7), 40).maps(4, heading_variance=1e-14)
    dense, sparse = _joined(maps, DENSE), _joined(maps, 0)
    assert dense.ids.tolist() == sparse.ids.tolist()
    np.testing.assert_allclose(sparse.landmarks, dense.landmarks, atol=1e-9)
    np.testing.assert_allclose(sparse.frames, dense.frames, atol=1e-9)
    np.testing.assert_allclose(Recovery(sparse).dense().covariance, dense.covariance, atol=1e-9)
    assert sparse.squared == pytest.approx(dense.squared, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_tree_solved_again_is_the_same_whatever_form_it_was_joined_in(seed):
    maps = random_maps(np.random.default_rng(seed), 9)
    dense, sparse, mixed = (_joined(maps, limit) for limit in (DENSE, 0, 46))
    assert mixed.covariance is None and dense.covariance is not None
    again = relinearised(dense)
    for other in (sparse, mixed):
        rows = rows_by_id(other, again.ids)
        np.testing.assert_allclose(other.landmarks[rows], again.landmarks, atol=1e-6)
        np.testing.assert_allclose(other.end_covariance, again.end_covariance, atol=1e-6)
        assert other.squared == pytest.approx(again.squared, rel=1e-8)


def test_covariances_on_demand_against_the_inverse_of_everything():
    """Independent: every landmark of every part is an unknown of one dense information matrix."""
    maps = random_maps(np.random.default_rng(4), 5)
    joined = _joined(maps, 0)
    full = Recovery(joined).dense().covariance
    np.testing.assert_allclose(full, np.linalg.inv(_information(joined)), rtol=1e-7, atol=1e-10)
    recovery, first = Recovery(joined), 3 * len(joined.frames) + 3
    blocks = [
        full[first + 2 * i : first + 2 * i + 2, first + 2 * i : first + 2 * i + 2] for i in range(len(joined))
    ]
    np.testing.assert_allclose(recovery.landmarks(), blocks, rtol=1e-7)
    poses = [full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(maps))]
    np.testing.assert_allclose(recovery.frames(), poses, rtol=1e-7)
    np.testing.assert_allclose(joined.end_covariance, poses[-1], rtol=1e-6)
    some = np.array([3, 0, len(joined) - 1])
    entries = np.concatenate([first - 3 + np.arange(3), (first + 2 * some[:, None] + np.arange(2)).ravel()])
    part = recovery.joint(np.array([len(joined.frames)]), some)
    np.testing.assert_allclose(part, full[np.ix_(entries, entries)], rtol=1e-7, atol=1e-10)


def _information(joined):
    """The Gauss-Newton matrix of frames, end and all landmarks, with numeric Jacobians of all parts."""
    from kalmap.geometry.se2 import compose, inverse, rotate

    poses = len(joined.frames) + 1

    def local(x, number, part):
        frames = np.concatenate([np.zeros((1, 3)), x[: 3 * poses].reshape(-1, 3)])
        points = x[3 * poses :].reshape(-1, 2)[part.rows] - frames[number, :2]
        end = compose(inverse(frames[number]), frames[number + 1])
        return np.concatenate([end, rotate(-frames[number, 2], points).ravel()])

    total, x = np.zeros((joined.size, joined.size)), joined.mean
    for number, part in enumerate(joined.leaves):
        steps = 1e-6 * np.eye(len(x))
        jacobian = np.array([local(x + s, number, part) - local(x - s, number, part) for s in steps]).T / 2e-6
        total += jacobian.T @ np.linalg.inv(part.map.covariance) @ jacobian
    return total


@pytest.mark.parametrize("library", ["qdldl", "superlu"])
def test_the_sparse_factor_against_numpy(library):
    if library == "qdldl":
        pytest.importorskip("qdldl")
    rng = np.random.default_rng(1)
    root = rng.standard_normal((40, 40)) * (rng.random((40, 40)) < 0.08) + np.diag(rng.uniform(1.0, 2.0, 40))
    matrix = root @ root.T
    factor = SparseCholesky(triu(csc_matrix(matrix), format="csc"), library)
    inverse = np.linalg.inv(matrix)
    right = rng.standard_normal((40, 3))
    np.testing.assert_allclose(factor.solve(right), inverse @ right, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(factor.solve(right[:, 0]), inverse @ right[:, 0], rtol=1e-7, atol=1e-9)
    rows, columns = np.nonzero(matrix)
    np.testing.assert_allclose(
        factor.inverse_entries(rows, columns), inverse[rows, columns], rtol=1e-7, atol=1e-9
    )


def test_an_exact_drive_has_no_information_form():
    maps = LinearDrive(np.random.default_rng(7), 8).maps(4)
    with pytest.raises(NotPositiveError, match="information form"):
        _joined(maps, 0)
