"""Regression, update and new samples of sampled maps, each against something slow that shares no code with it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kalmap.gaussian import Belief, CentralDifference, Cubature, Jacobian, Unscented
from kalmap.geometry.se2 import rotate
from kalmap.kernels import contour as kernel
from kalmap.kernels import contour_state
from kalmap.kernels.implicit import signed_distance
from kalmap.kernels.layout import (
    BIAS_COUNT,
    INNOVATION_NOT_POSITIVE,
    INVARIANT,
    OK,
    RULE,
    RULE_A,
    RULE_C,
    SETUP_LENGTH,
)

CAL, FIRST = contour_state.CALIBRATION, contour_state.SAMPLES
COLUMNS = 7  # of a distance: pose, bearing scale and range offset, sample
MOUNT = np.array([0.2, -0.1, 0.3])
RULES = [Jacobian(), Unscented(), Unscented(alpha=0.5, beta=2.0), CentralDifference(), Cubature()]


def setup_of(lineariser=None, invariant=False):
    setup = np.zeros(SETUP_LENGTH)
    if lineariser is not None:
        setup[RULE], setup[RULE_A : RULE_C + 1] = lineariser.code, lineariser.rule()
    setup[INVARIANT], setup[BIAS_COUNT] = invariant, FIRST - 3
    return setup


class Distance:
    """The signed distance as a function of an error of (pose, sample): what the kernel regresses, in plain numpy."""

    def __init__(self, pose, sample, curve, invariant):
        self.pose, self.sample, self.curve, self.invariant = pose, sample, curve, invariant

    def __call__(self, x):
        x = np.asarray(x, dtype=float)
        return np.array([self._one(e) for e in x.reshape(-1, 5)]).reshape(*x.shape[:-1], 1)

    def _one(self, e):
        if (
            self.invariant
        ):  # x = exp(xi) x-mean, element by element, with the matrix exponential's closed form
            turn = e[2]
            s = 1.0 if turn == 0.0 else math.sin(turn) / turn
            v = 0.0 if turn == 0.0 else (1.0 - math.cos(turn)) / turn
            left = np.array([[s, -v], [v, s]])
            position = left @ e[:2]
            sample = rotate(turn, self.sample - self.pose[:2]) + left @ e[3:]
        else:
            position, sample, turn = self.pose[:2] + e[:2], self.sample + e[3:], e[2]
        at = rotate(-self.pose[2] - turn, sample - position)
        return signed_distance(*self.curve, *at)[0]

    def jacobian(self, x, h=1e-6):
        return np.column_stack([(self(x + h * d) - self(x - h * d)) / (2 * h) for d in np.eye(5)])

    def minus(self, a, b):
        return a - b


def curves(rng):
    """Three curves near the unit circle about (2, 0): a line, a circle, a cubic; (coef, ox, oy, scale)."""
    line = np.array([0.1, -1.0, 0.3, 0, 0, 0, 0, 0, 0, 0.0])
    circle = np.array([-1.0, 0, 0, 1.0, 0, 1.0, 0, 0, 0, 0])
    cubic = circle + 0.1 * rng.standard_normal(10)
    return np.array([line, circle, cubic]), np.tile([2.0, 0.3], (3, 1)), np.array([1.0, 1.3, 0.9])


def state(rng, n_samples):
    """Mean, joint covariance and where samples begin; the samples stand about the curves, seen from the pose."""
    n = FIRST + 2 * n_samples
    mean = np.concatenate([[0.4, -0.3, 0.2], rng.normal(0, 0.01, FIRST - 3), np.zeros(2 * n_samples)])
    for i in range(n_samples):
        angle = rng.uniform(1.5, 4.5)
        place = np.array([2.0, 0.3]) + 1.2 * np.array([math.cos(angle), math.sin(angle)])
        mean[FIRST + 2 * i : FIRST + 2 * i + 2] = mean[:2] + rotate(mean[2], place)
    root = rng.normal(0, 0.03, (n, n)) / math.sqrt(n)
    return mean, root @ root.T + 1e-4 * np.eye(n)


def packed_of(covariance):
    return covariance[np.tril_indices(len(covariance))].copy()


def regressed(rng, lineariser, invariant, n_samples=6):
    mean, covariance = state(rng, n_samples)
    coef, origin, scale = curves(rng)
    indices, piece = FIRST + 2 * np.arange(n_samples), np.arange(n_samples) % 3
    matrices, distances = np.empty((n_samples, COLUMNS)), np.empty(n_samples)
    residuals = np.empty(n_samples)
    status = kernel.regress_distances(
        setup_of(lineariser, invariant), mean, packed_of(covariance), MOUNT, indices, piece, coef, origin, scale,
        matrices, distances, residuals,
    )  # fmt: skip
    assert status == OK
    curve = [(coef[k], *origin[k], scale[k]) for k in piece]
    return mean, covariance, indices, curve, matrices, distances, residuals


@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize("lineariser", RULES, ids=lambda rule: type(rule).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_regression(lineariser, invariant, seed):
    """Oracle: the general form of the linearisers on the function above; its Jacobian by numerical differences."""
    rng = np.random.default_rng(seed)
    mean, covariance, indices, curve, matrices, distances, residuals = regressed(rng, lineariser, invariant)
    twisted = invariant and not isinstance(lineariser, Jacobian)
    for m, index in enumerate(indices):
        entries = np.r_[0:3, index, index + 1]
        block, sample = covariance[np.ix_(entries, entries)], mean[index : index + 2]
        turn = np.eye(5)
        if twisted:  # xi = T e about the robot: the sample's loses J x d_theta
            turn[3, 2], turn[4, 2] = sample[1] - mean[1], mean[0] - sample[0]
            block = turn @ block @ turn.T
        function = Distance(mean[:3], sample, curve[m], twisted)
        expected = lineariser(function, np.zeros(5), block)
        matrix = (expected.matrix @ turn)[0]
        got = np.r_[matrices[m, :3], matrices[m, -2:]]
        assert np.allclose(got, matrix, rtol=0, atol=1e-7)
        assert distances[m] == pytest.approx(expected.mean[0], abs=1e-10)
        assert residuals[m] == pytest.approx(expected.residual[0, 0], abs=1e-12)


def shown_at(calibration, point, mount):
    """Where the scanner shows, in the robot's frame, what truly is at `point`, if it is corrected by `calibration`.

    Its readings are those of a scanner that is right; the calibration taken out of them moves them.
    """
    way = rotate(-mount[2], point - mount[:2])
    r, bearing = np.hypot(*way) + calibration[1], math.atan2(way[1], way[0]) * (1.0 + calibration[0])
    return mount[:2] + rotate(mount[2], r * np.array([math.cos(bearing), math.sin(bearing)]))


def effect_by_differences(point, normal, mount, h=1e-6):
    return [
        normal @ (shown_at(h * step, point, mount) - shown_at(-h * step, point, mount)) / (2 * h)
        for step in np.eye(2)
    ]


@pytest.mark.parametrize("mount", [np.zeros(3), MOUNT, np.array([0.1, 0.0, 3.0])])
def test_calibration_effect(mount):
    """Oracle: numerical differences of where a scanner shows a point."""
    rng = np.random.default_rng(5)
    points, angle = rng.normal(0, 3, (40, 2)), rng.uniform(-np.pi, np.pi, 40)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    effect = np.empty((40, 2))
    contour_state.calibration_effect(points, normals, mount, effect)
    expected = [effect_by_differences(p, n, mount) for p, n in zip(points, normals, strict=True)]
    assert np.allclose(effect, expected, rtol=0, atol=1e-8)


def test_regression_by_the_calibration():
    """Oracle: the effect above with the other sign: what moves the curve brings the sample nearer."""
    mean, _, indices, curve, matrices, _, _ = regressed(np.random.default_rng(7), Jacobian(), False)
    for m, index in enumerate(indices):
        at = rotate(-mean[2], mean[index : index + 2] - mean[:2])
        _, gx, gy = signed_distance(*curve[m], *at)
        expected = effect_by_differences(at, np.array([gx, gy]), MOUNT)
        assert np.allclose(matrices[m, 3:5], -np.array(expected), rtol=0, atol=1e-7)


def dense_update(mean, covariance, matrix, innovation, noise, invariant):
    """The Kalman filter of the textbook; in invariant coordinates through the exponential, then P <- T P T'."""
    spread = matrix @ covariance @ matrix.T + noise
    gain = covariance @ matrix.T @ np.linalg.inv(spread)
    step = gain @ innovation
    after = covariance - gain @ spread @ gain.T
    moved = mean + step
    if invariant:
        s, v = np.sinc(step[2] / np.pi), (1.0 - math.cos(step[2])) / step[2]
        left, transport = np.array([[s, -v], [v, s]]), np.eye(len(mean))
        for p in (0, *range(FIRST, len(mean), 2)):
            moved[p : p + 2] = mean[p : p + 2] + left @ step[p : p + 2]
            d = moved[p : p + 2] - mean[p : p + 2]
            transport[p, 2] += -d[1]
            transport[p + 1, 2] += d[0]
        after = transport @ after @ transport.T
    return moved, after, innovation @ np.linalg.solve(spread, innovation)


@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize(("n_samples", "count"), [(1, 1), (2, 2), (7, 3), (9, 9), (40, 7), (57, 57)])
def test_apply_distances(invariant, n_samples, count):
    """Oracle: dense numpy algebra."""
    rng = np.random.default_rng(n_samples + count)
    mean, covariance = state(rng, n_samples)
    n = len(mean)
    rows = np.sort(rng.permutation(n_samples)[:count])
    indices, matrices = FIRST + 2 * rows, rng.normal(0, 1, (count, COLUMNS))
    root = rng.normal(0, 0.02, (count, count))
    noise, innovation = root @ root.T + 1e-4 * np.eye(count), rng.normal(0, 0.03, count)
    dense = np.zeros((count, n))
    dense[:, :5] = matrices[:, :5]
    for m, index in enumerate(indices):
        dense[m, index : index + 2] = matrices[m, 5:]
    expected = dense_update(mean, covariance, dense, innovation, noise, invariant)
    belief = Belief(mean, covariance)
    left, right = belief.work(2 * count)
    lower = np.tril(noise) + np.triu(np.full(noise.shape, np.nan), 1)  # the lower triangle alone is read
    status, nis = contour_state.apply_distances(
        setup_of(None, invariant), belief.mean, belief.packed, n, indices, matrices, innovation.copy(), lower,
        left, right,
    )  # fmt: skip
    assert status == OK
    assert nis == pytest.approx(expected[2], rel=1e-9)
    assert np.allclose(belief.mean, expected[0], rtol=0, atol=1e-12)
    assert np.allclose(belief.covariance(), expected[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("broken", ["noise", "innovation"])
@pytest.mark.parametrize("count", [1, 4, 5])
def test_after_an_error_the_state_is_as_it_was(broken, count):
    rng = np.random.default_rng(3)
    mean, covariance = state(rng, 6)
    belief = Belief(mean, covariance)
    noise, innovation = 1e-4 * np.eye(count), np.zeros(count)
    if broken == "noise":
        noise[-1, -1] = -10.0
    else:
        innovation[0] = np.nan
    packed = belief.packed.copy()
    left, right = belief.work(2 * count)
    status, _ = contour_state.apply_distances(
        setup_of(), belief.mean, belief.packed, len(mean), FIRST + 2 * np.arange(count),
        rng.normal(0, 1, (count, COLUMNS)), innovation, noise, left, right,
    )  # fmt: skip
    assert status != OK and (broken != "noise" or status == INNOVATION_NOT_POSITIVE)
    assert np.array_equal(belief.mean, mean) and np.array_equal(belief.packed, packed)


@pytest.mark.parametrize(("n_samples", "count"), [(0, 1), (0, 5), (6, 1), (6, 8)])
def test_append_samples(n_samples, count):
    """Oracle: dense algebra, P' = [I; J] P [I; J]' + the points' noise along their normals."""
    rng = np.random.default_rng(count)
    mean, covariance = state(rng, n_samples)
    n = len(mean)
    points, angle = rng.normal(0, 3, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    effect = rng.normal(0, 1, (count, 2))
    root = rng.normal(0, 0.02, (count, count))
    noise = root @ root.T
    belief = Belief(mean, covariance)
    belief.reserve(n + 2 * count)
    belief.n = contour_state.append_samples(belief.mean, belief.packed, n, points, normal, effect, noise)
    assert belief.n == n + 2 * count
    map_normal, arms = rotate(mean[2], normal), rotate(mean[2], points)
    rows = np.zeros((2 * count, n))
    for m in range(count):
        rows[2 * m : 2 * m + 2, :2] = np.eye(2)
        rows[2 * m : 2 * m + 2, 2] = -arms[m, 1], arms[m, 0]
        rows[2 * m : 2 * m + 2, CAL : CAL + 2] = np.outer(map_normal[m], effect[m])
    across = np.zeros((2 * count, count))
    for m in range(count):
        across[2 * m : 2 * m + 2, m] = map_normal[m]
    grow = np.vstack([np.eye(n), rows])
    expected = grow @ covariance @ grow.T
    expected[n:, n:] += across @ noise @ across.T
    assert np.allclose(belief.mean[n : belief.n].reshape(-1, 2), mean[:2] + arms, rtol=0, atol=1e-12)
    assert np.allclose(belief.covariance(), expected, rtol=0, atol=1e-13)
