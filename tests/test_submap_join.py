"""Joining two local maps: against one big filter, and against scipy's least squares."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from kalmap.gaussian import NotPositiveError
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.records import EstimationError
from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.join import join
from kalmap.slam.submaps.joiner import ById, LandmarkJoiner, chained, join_sparse
from kalmap.slam.submaps.local_map import local_map
from submap_problems import LinearDrive, random_maps, rows_by_id

DENSE = 10**9


@pytest.mark.parametrize("length", [1, 3, 7])
def test_joining_equals_one_big_filter_on_a_linear_problem(length):
    """Independent: a textbook Kalman filter over the whole drive (tests/submap_problems.py)."""
    drive = LinearDrive(np.random.default_rng(5), 33)
    forest = Forest(LandmarkJoiner(gate=1.0, dense_limit=DENSE))
    for each in drive.maps(length):
        forest.close(each)
    forest.finish()
    (joined,) = forest.maps
    mean, cov, ids = drive.filtered(0, 33)
    rows = rows_by_id(joined, ids)
    np.testing.assert_allclose(joined.end[:2], mean[:2], atol=1e-9)
    assert abs(wrap(joined.end[2] - mean[2])) < 1e-9
    np.testing.assert_allclose(joined.landmarks[rows].ravel(), mean[3:], atol=1e-9)
    start = 3 * len(joined.frames)
    entries = np.concatenate([start + np.arange(3), (start + 3 + 2 * rows[:, None] + np.arange(2)).ravel()])
    np.testing.assert_allclose(joined.covariance[np.ix_(entries, entries)], cov, atol=1e-9)


def _by_least_squares(first, second):
    """Mean and covariance of (end of first, end of second, landmarks by id): scipy on the two maps' residuals."""
    ids = np.union1d(first.ids, second.ids)

    def residual(x):
        frame, end, points = x[:3], x[3:6], x[6:].reshape(-1, 2)
        a = np.concatenate([frame, points[np.searchsorted(ids, first.ids)].ravel()]) - first.mean
        local = rotate(-frame[2], points[np.searchsorted(ids, second.ids)] - frame[:2])
        b = np.concatenate([compose(inverse(frame), end), local.ravel()]) - second.mean
        a[2], b[2] = wrap(a[2]), wrap(b[2])
        return np.concatenate(
            [np.linalg.solve(np.linalg.cholesky(m.covariance), r) for m, r in ((first, a), (second, b))]
        )

    begin = np.zeros(6 + 2 * len(ids))
    begin[:3], begin[3:6] = first.end, compose(first.end, second.end)
    begin[6:].reshape(-1, 2)[np.searchsorted(ids, second.ids)] = first.end[:2] + rotate(
        first.end[2], second.landmarks
    )
    begin[6:].reshape(-1, 2)[np.searchsorted(ids, first.ids)] = first.landmarks
    found = least_squares(residual, begin, xtol=1e-15, ftol=1e-15, gtol=1e-13)
    return ids, found.x, np.linalg.inv(found.jac.T @ found.jac), 2.0 * found.cost


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("form", ["dense", "information"])
def test_a_join_is_the_batch_optimum_of_its_two_maps(seed, form):
    """Independent: scipy.optimize.least_squares with numeric Jacobians."""
    first, second = random_maps(np.random.default_rng(seed), 2)
    pairs = ById()(first, second)
    joined = join(first, second, pairs) if form == "dense" else join_sparse(first, second, pairs)
    ids, x, cov, cost = _by_least_squares(first, second)
    rows = rows_by_id(joined, ids)
    mine = np.concatenate([joined.frames[0], joined.end, joined.landmarks[rows].ravel()])
    mine[[2, 5]] = x[[2, 5]] + wrap(mine[[2, 5]] - x[[2, 5]])
    np.testing.assert_allclose(mine, x, atol=1e-6)
    assert joined.squared == pytest.approx(cost, rel=1e-6)
    if form == "dense":
        entries = np.concatenate([np.arange(6), (6 + 2 * rows[:, None] + np.arange(2)).ravel()])
        np.testing.assert_allclose(joined.covariance[np.ix_(entries, entries)], cov, atol=1e-6)
    np.testing.assert_allclose(joined.end_covariance, cov[3:6, 3:6], atol=1e-6)


def test_a_join_keeps_numbers_counts_and_parts():
    first, second = random_maps(np.random.default_rng(8), 2)
    renamed = local_map(second.mean, second.covariance, second.ids + 100)
    pairs = ById()(first, second)
    joined = join(first, renamed, pairs)
    assert len(joined) == len(first) + len(second) - len(pairs)
    assert joined.aliases.tolist() == [[int(second.ids[b]) + 100, int(first.ids[a])] for a, b in pairs]
    assert joined.sightings[pairs[:, 0]].tolist() == [2] * len(pairs)
    assert [len(part.rows) for part in joined.leaves] == [len(first), len(second)]
    for part in joined.leaves:  # every part's landmarks are where it says, to within what the join moved them
        T_map_part = joined.starts[joined.leaves.index(part)]
        placed = T_map_part[:2] + rotate(T_map_part[2], part.map.landmarks)
        assert np.linalg.norm(placed - joined.landmarks[part.rows], axis=1).max() < 0.5


def test_maps_without_a_pair_are_chained():
    first, second = random_maps(np.random.default_rng(9), 2)
    joined = chained(first, second)
    np.testing.assert_allclose(joined.end, compose(first.end, second.end), atol=1e-12)
    np.testing.assert_allclose(joined.landmarks[: len(first)], first.landmarks, atol=0)
    assert joined.degrees == 0 and joined.squared == 0.0


def test_the_order_in_which_neighbours_are_joined_does_not_matter_on_a_linear_problem():
    a, b, c = LinearDrive(np.random.default_rng(6), 12).maps(4)
    joiner = LandmarkJoiner(gate=1.0, dense_limit=DENSE)
    left, right = joiner(joiner(a, b), c), joiner(a, joiner(b, c))
    rows = rows_by_id(right, left.ids)
    np.testing.assert_allclose(left.landmarks, right.landmarks[rows], atol=1e-9)
    np.testing.assert_allclose(left.end_covariance, right.end_covariance, atol=1e-9)
    np.testing.assert_allclose(left.frames, right.frames, atol=1e-9)


def test_what_is_no_local_map_is_refused():
    good = random_maps(np.random.default_rng(1), 1)[0]
    with pytest.raises(EstimationError, match="needs"):
        local_map(good.mean, good.covariance, good.ids[:-1])
    with pytest.raises(EstimationError, match="finite"):
        local_map(np.full_like(good.mean, np.nan), good.covariance, good.ids)
    with pytest.raises(NotPositiveError):
        local_map(good.mean, -good.covariance, good.ids)


def test_a_landmark_known_exactly_twice_is_an_error_with_a_name():
    first, second = random_maps(np.random.default_rng(2), 2)
    exact = [local_map(each.mean, np.zeros_like(each.covariance), each.ids) for each in (first, second)]
    with pytest.raises(NotPositiveError, match="join"):
        join(*exact, ById()(*exact))


def test_maps_that_share_nothing_are_joined_whatever_the_gate():
    first, second = random_maps(np.random.default_rng(9), 2)
    other = local_map(second.mean, second.covariance, second.ids + 100)
    joined = LandmarkJoiner(gate=0.9)(first, other)
    assert joined is not None and len(joined) == len(first) + len(second)
