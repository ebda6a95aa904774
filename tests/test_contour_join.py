"""Joining contour maps. Oracles: batch least squares, central differences, dense algebra, the true walls."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.stats import chi2

from kalmap.gaussian import NotPositiveError
from kalmap.geometry.se2 import compose, inverse, rotate
from kalmap.geometry.segments import segment_distances
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.join import Association, join_contours, joined
from kalmap.slam.contours.map_corners import corners_of, same_corner
from kalmap.slam.contours.stacked import Constraint, Stacked, condition, in_first_frame
from kalmap.slam.contours.strands import strands
from kalmap.slam.contours.stretches import on_one_curve, shared_stretches
from kalmap.slam.contours.thinning import farthest_first, thinned
from wall_maps import LAST, MIDDLE, ROOM, room_pair, wall_map, wall_samples

START = np.array([0.8, 2.0, 0.0])


def numerical(function, x, step=1e-6):
    """(m, n) central differences."""
    columns = []
    for k in range(len(x)):
        ends = [function(x + sign * step * np.eye(len(x))[k]) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.column_stack(columns)


def stretches_of(first, second, stacked, limit=0.3):
    mean = stacked.mean
    normals = rotate(mean[2], second.normals)
    return shared_stretches(first, second, stacked.first(mean), stacked.placed(mean), normals, limit)


# --- parts --------------------------------------------------------------------------------------------------------


def test_strands_walk_along_open_and_closed_contours():
    found = strands(np.array([[3, 1], [1, 5], [0, 2], [2, 4], [4, 0]]), 7)
    assert sorted(len(each) for each in found) == [3, 4]
    open_one = next(each for each in found if len(each) == 3)
    assert open_one.tolist() in ([3, 1, 5], [5, 1, 3])
    ring = next(each for each in found if len(each) == 4)
    assert ring[0] == ring[-1] == 0 and set(ring) == {0, 2, 4}


@pytest.mark.parametrize("seed", range(5))
def test_farthest_first_keeps_the_ends_and_what_is_far_apart(seed):
    rng = np.random.default_rng(seed)
    at = np.sort(rng.uniform(0.0, 3.0, 40))
    points = np.column_stack([at, np.zeros(40)])
    kept = farthest_first(points, 11)
    assert len(kept) == 11 and kept[0] == 0 and kept[-1] == 39
    gaps = np.diff(at[kept])
    drawn = [np.diff(at[np.sort([0, 39, *rng.choice(np.arange(1, 39), 9, False)])]).min() for _ in range(200)]
    assert gaps.min() > np.quantile(drawn, 0.99)  # no random choice leaves them so far apart


def test_the_derivatives_are_those_of_central_differences():
    first, second = room_pair(np.random.default_rng(1))
    stacked = Stacked(first, second)
    mean = stacked.mean
    stretch = stretches_of(first, second, stacked)[0]

    def distances(x):
        places = np.concatenate([stacked.first(x), stacked.placed(x)])[stretch.rows]
        return stretch.curve.distance(places)

    zero = on_one_curve(stacked, mean, stretch, "zero")
    np.testing.assert_allclose(zero.matrix.toarray(), numerical(distances, mean), atol=1e-6)
    np.testing.assert_allclose(zero.value, distances(mean), atol=1e-12)
    ones, others = corners_of(first), corners_of(second)
    made = same_corner(stacked, mean, ones[0], others[0])
    slope = numerical(lambda x: same_corner(stacked, x, ones[0], others[0]).value, mean)
    np.testing.assert_allclose(made.matrix.toarray(), slope, atol=1e-6)


def test_the_second_map_moves_by_the_exact_jacobian():
    first, second = room_pair(np.random.default_rng(2))
    stacked = Stacked(first, second)
    rng = np.random.default_rng(3)
    root = 0.01 * rng.standard_normal((len(stacked.mean), len(stacked.mean)))
    mean, covariance = in_first_frame(stacked, stacked.mean, root @ root.T)

    def moved(x):
        end = compose(x[:3], x[stacked.start : stacked.start + 3])
        return np.concatenate([end, stacked.first(x).ravel(), stacked.placed(x).ravel()])

    jacobian = numerical(moved, stacked.mean)
    np.testing.assert_allclose(mean, moved(stacked.mean), atol=1e-12)
    np.testing.assert_allclose(covariance, jacobian @ root @ root.T @ jacobian.T, atol=1e-8)


def test_constraints_that_say_a_thing_twice_count_once():
    rng = np.random.default_rng(4)
    root = rng.standard_normal((6, 6))
    prior, mean = root @ root.T, rng.standard_normal(6)
    rows = rng.standard_normal((2, 6))
    once = Constraint(csr_array(rows), rows @ mean, np.zeros((2, 2)))
    more = np.vstack([rows, rows[0] - 3.0 * rows[1], rows[1]])
    twice = Constraint(csr_array(more), more @ mean, np.zeros((4, 4)))
    a, b = (condition(mean, prior, [each], mean) for each in (once, twice))
    assert (a.freedom, b.freedom) == (2, 2)
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-10)
    np.testing.assert_allclose(a.covariance(prior), b.covariance(prior), atol=1e-10)
    # by hand: what is left is square to the rows
    null = np.linalg.svd(rows)[2][2:].T
    exact = null @ np.linalg.inv(null.T @ np.linalg.inv(prior) @ null) @ null.T
    np.testing.assert_allclose(a.covariance(prior), exact, atol=1e-9)
    with pytest.raises(NotPositiveError):
        condition(mean, prior - 3.0 * np.eye(6) * np.linalg.eigvalsh(prior)[-1], [once], mean)


# --- exactness ----------------------------------------------------------------------------------------------------


def straight_pair(rng):
    """Two maps of two parallel walls at known headings; the maps lie apart by whole shifts, so that all is linear."""
    walls = np.array([[8.0, 2.0, 0.0, 2.0], [0.0, 0.0, 8.0, 0.0]])
    start, middle, end = np.array([1.0, 1.0, 0.0]), np.array([4.0, 1.0, 0.0]), np.array([7.0, 1.0, 0.0])
    exact = {"drift": (0.02, 0.02, 0.0), "knots": 1}
    first = wall_map(None, start, middle, *wall_samples(walls, 0.3, 0.1, 0.0, 5.0), **exact)
    second = wall_map(None, middle, end, *wall_samples(walls, 0.3, 0.2, 3.0, 8.0), **exact)
    shifted = []
    for each in (first, second):
        mean = each.mean.copy()
        mean[:2] += 0.02 * rng.standard_normal(2)
        mean[3:] += np.tile(0.02 * rng.standard_normal(2), len(each.samples))
        shifted.append(msgspec.structs.replace(each, mean=mean))
    return shifted


def batch(stacked, stretches):
    """Least squares over both maps and the walls' own unknowns, two a stretch, solved whole from the normal equations.

    The maps' covariances have no inverse (a sample is exact along its wall but for the drift), so the maps are written
    with their errors as unknowns: state = mean + root e, e ~ N(0, I).
    """
    values, vectors = np.linalg.eigh(stacked.covariance)
    root = vectors[:, values > 1e-14] * np.sqrt(values[values > 1e-14])
    rows, right, weights = [], [], []
    count = root.shape[1]
    places = np.concatenate([stacked.first(stacked.mean), stacked.placed(stacked.mean)])
    for number, stretch in enumerate(stretches):
        for row in stretch.rows:
            own = (
                3 + 2 * row if row < stacked.counts[0] else stacked.start + 3 + 2 * (row - stacked.counts[0])
            )
            read = root[own + 1] + (root[1] if row >= stacked.counts[0] else 0.0)
            line = np.zeros(2 * len(stretches))
            line[2 * number : 2 * number + 2] = [-1.0, -places[row, 0]]
            rows.append(np.concatenate([read, line]))
            right.append(-places[row, 1])
            weights.append(1.0 / stretch.roughness**2)
    design, weight = np.array(rows), np.array(weights)
    information = design.T @ (weight[:, None] * design)
    information[:count, :count] += np.eye(count)
    covariance = np.linalg.inv(information)
    error = covariance @ design.T @ (weight * np.array(right))
    return stacked.mean + root @ error[:count], root @ covariance[:count, :count] @ root.T


@pytest.mark.parametrize("seed", range(3))
def test_a_join_equals_batch_least_squares_where_all_is_linear(seed):
    first, second = straight_pair(np.random.default_rng(seed))
    stacked = Stacked(first, second)
    stretches = stretches_of(first, second, stacked)
    assert len(stretches) >= 2 and not corners_of(first)
    constraints = [on_one_curve(stacked, stacked.mean, each, "curve") for each in stretches]
    solved = condition(stacked.mean, stacked.covariance, constraints, stacked.mean)
    mean, covariance = batch(stacked, stretches)
    np.testing.assert_allclose(solved.mean, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solved.covariance(stacked.covariance), covariance, rtol=0, atol=1e-9)
    # the whole join takes its derivatives again at the end, where the walls have a slope of some 1e-4
    end, spread = in_first_frame(stacked, mean, covariance)
    whole = join_contours(first, second)
    np.testing.assert_allclose(whole.mean[:3], end[:3], rtol=0, atol=1e-5)
    np.testing.assert_allclose(whole.covariance[:3, :3], spread[:3, :3], rtol=0, atol=1e-7)


def test_corners_are_forced_equal():
    first, second = room_pair(np.random.default_rng(5))
    assert len(corners_of(first)) == 2 and len(corners_of(second)) == 2  # each sees one end of the room
    wide = wall_map(np.random.default_rng(6), MIDDLE, LAST, *wall_samples(ROOM, 0.3, 0.23, -1.0, 7.0))
    association = Association(first, wide, Stacked(first, wide), "curve")
    association.run()
    assert len(association.corners) == 2
    solved, found = association.solved, association._found
    for i, j in association.corners:
        made = same_corner(association.stacked, solved.mean, found[0][i], found[1][j])
        assert np.abs(made.value).max() < 1e-6
        left = solved.spread(association.stacked.covariance, made.matrix)
        assert np.abs(left).max() < 1e-9


def test_as_published_all_samples_lie_on_their_curves():
    first, second = room_pair(np.random.default_rng(7))
    association = Association(first, second, Stacked(first, second), "zero")
    association.run()
    mean = association.solved.mean
    for each in association.stretches:
        assert np.abs(on_one_curve(association.stacked, mean, each, "zero").value).max() < 1e-6


# --- whole joins --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_joined_maps_lie_on_the_walls_and_are_thinned(seed):
    first, second = room_pair(np.random.default_rng(seed), drift=(0.01, 0.01, 0.002))
    whole = join_contours(first, second)
    assert len(whole.samples) < len(first.samples) + len(second.samples) - 10
    places = compose(START, np.column_stack([whole.samples, np.zeros(len(whole.samples))]))[:, :2]
    off = segment_distances(places, ROOM)
    assert off.mean() < 0.05 and off.max() < 0.2
    # no gap on any wall: a sample within 0.45 m of every point of it
    every, _ = wall_samples(ROOM, 0.05, 0.05, -1.0, 7.0)
    near = np.hypot(*(every[:, None] - places[None]).transpose(2, 0, 1)).min(axis=1)
    assert near.max() < 0.45
    values = np.linalg.eigvalsh(whole.covariance)
    assert values[0] > -1e-12 * values[-1]


@pytest.mark.parametrize("seed", [None, 8])
def test_thinning_is_an_exact_linear_map_and_keeps_the_shape(seed):
    first, second = room_pair(None if seed is None else np.random.default_rng(seed))
    stacked = Stacked(first, second)
    association = Association(first, second, stacked, "curve")
    association.run()
    solved = association.solved
    mean, covariance = in_first_frame(stacked, solved.mean, solved.covariance(stacked.covariance))
    normals = np.concatenate([first.normals, rotate(solved.mean[2], second.normals)])
    union = ClosedMap(mean, covariance, normals, np.full(len(normals), 3), 0.3)
    thin = thinned(union, association.stretches)

    def thin_mean(x):
        return thinned(msgspec.structs.replace(union, mean=x), association.stretches).mean

    jacobian = numerical(thin_mean, mean, 1e-7)
    # to first order in how far the samples are off their curves: exactly where they lie on them
    close = 1e-9 if seed is None else 3e-6
    np.testing.assert_allclose(thin.covariance, jacobian @ covariance @ jacobian.T, atol=close)
    lines = np.hstack([union.samples[:-1], union.samples[1:]])
    lines = lines[np.hypot(*(lines[:, 2:] - lines[:, :2]).T) < 0.5]
    assert segment_distances(thin.samples, lines).mean() < 0.01
    assert thin.sightings.sum() == union.sightings.sum()


def test_maps_that_share_nothing_are_chained():
    walls = np.array([[4.0, 2.0, 0.0, 2.0], [9.0, 0.0, 14.0, 0.0]])
    middle, end = np.array([5.0, 1.0, 0.3]), np.array([9.0, 1.2, -0.2])
    rng = np.random.default_rng(9)
    first = wall_map(rng, START, middle, *wall_samples(walls[:1], 0.3, 0.1, 0.0, 5.0))
    second = wall_map(rng, middle, end, *wall_samples(walls[1:], 0.3, 0.1, 8.0, 15.0))
    result = joined(first, second)
    assert result.map is not None and result.freedom == 0 and result.agreement is None
    np.testing.assert_allclose(result.map.mean[:3], compose(first.end, second.end), atol=1e-12)
    assert len(result.map.samples) == len(first.samples) + len(second.samples)


def test_maps_that_contradict_each_other_are_not_joined():
    first, second = room_pair(None, drift=(0.003, 0.003, 0.0005))
    torn = second.mean.copy()
    upper = rotate(MIDDLE[2], second.samples)[:, 1] > 0.0  # in the second's copy the room is 25 cm wider
    torn[3:].reshape(-1, 2)[upper] += rotate(-MIDDLE[2], np.array([0.0, 0.25]))
    result = joined(first, msgspec.structs.replace(second, mean=torn))
    assert result.map is None and result.why


def nees(seed):
    first, second = room_pair(np.random.default_rng([77, seed]))
    whole = join_contours(first, second)
    assert whole is not None
    true = compose(inverse(START), LAST)
    error = [*(whole.mean[:3] - true)]
    reads = [np.eye(len(whole.mean))[k] for k in range(3)]
    own = compose(inverse(START), np.column_stack([ROOM.reshape(-1, 2), np.zeros(8)]))[:, :2].reshape(-1, 4)
    for wall in own:
        way = wall[2:] - wall[:2]
        normal = np.array([-way[1], way[0]]) / np.hypot(*way)
        rows = np.flatnonzero(whole.normals @ normal > 0.9)
        along = (whole.samples[rows] - wall[:2]) @ way
        for row in (rows[along.argmin()], rows[along.argmax()]):
            read = np.zeros(len(whole.mean))
            read[3 + 2 * row : 5 + 2 * row] = normal
            error.append(float((whole.samples[row] - wall[:2]) @ normal))
            reads.append(read)
    reads, error = np.array(reads), np.array(error)
    spread = reads @ whole.covariance @ reads.T
    return error @ np.linalg.solve(spread, error), error[:3] @ np.linalg.solve(spread[:3, :3], error[:3])


def test_joined_maps_are_as_sure_as_they_should_be():
    runs = 60
    values = np.array([nees(seed) for seed in range(runs)])
    for total, degrees in zip(values.sum(axis=0), (11, 3)):
        low, high = chi2.ppf([0.001, 0.999], runs * degrees)
        assert low < total < high, (total / runs, degrees)
