"""The graph of frames. Oracles: scipy's least squares on the same residuals, plain normal equations, Monte Carlo."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares

import kalmap.slam.contours.graph as module
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.slam.contours.graph import FrameGraph, Relation, beside_the_end


def ring(rng, count=8, noise=0.02, loops=((0, 7), (1, 6), (2, 5))):
    """Frames on a ring that passes heading pi, measured with noise, and its loops; the true frames (n, 3)."""
    angle = np.linspace(0.0, 1.8 * np.pi, count)
    truth = np.column_stack([4 * np.sin(angle), 4 * (1 - np.cos(angle)), wrap(angle)])
    graph = FrameGraph()

    def measured(i, j):
        root = rng.normal(0, noise, (3, 3)) + 0.5 * noise * np.eye(3)
        covariance = root @ root.T + 1e-6 * np.eye(3)
        return compose(inverse(truth[i]), truth[j]) + rng.multivariate_normal(
            np.zeros(3), covariance
        ), covariance

    for i in range(count - 1):
        graph.append(*measured(i, i + 1))
    for i, j in loops:
        pose, covariance = measured(i, j)
        graph.add(Relation(i, j, pose, np.linalg.inv(covariance), loop=True))
    return graph, truth


def whitened(graph, frames):
    """All residuals of frames (3 n - 3,), whitened, one relation after the other."""
    frames = np.vstack([np.zeros(3), frames.reshape(-1, 3)])
    out = []
    for r in graph.relations:
        error = compose(inverse(frames[r.first]), frames[r.second]) - r.pose
        error[2] = wrap(error[2])
        out.append(np.linalg.cholesky(r.information).T @ error)
    return np.concatenate(out)


@pytest.mark.parametrize("seed", range(4))
def test_solve_is_least_squares(monkeypatch, seed):
    """Without the weights (CAUCHY beyond all distances)."""
    monkeypatch.setattr(module, "CAUCHY", 1e12)
    graph, _ = ring(np.random.default_rng(seed))
    start = graph.frames[1:].ravel()
    best = least_squares(lambda x: whitened(graph, x), start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    graph.solve(50, 1e-12)
    expected = best.x.reshape(-1, 3)
    assert np.allclose(graph.frames[1:, :2], expected[:, :2], rtol=0, atol=1e-6)
    assert np.allclose(wrap(graph.frames[1:, 2] - expected[:, 2]), 0.0, atol=1e-7)
    assert (graph.frames[0] == 0.0).all()
    jacobian = best.jac
    assert np.allclose(graph.covariance()[3:, 3:], np.linalg.inv(jacobian.T @ jacobian), rtol=1e-4, atol=1e-9)
    assert (graph.covariance()[:3] == 0.0).all() and (graph.covariance()[:, :3] == 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_solve_with_weights_is_a_minimum_of_cauchys_loss(seed):
    """Gross errors among the loops: at the end the gradient of sum c log(1 + d^2 / c) vanishes. Oracle: differences."""
    graph, truth = ring(np.random.default_rng(seed), loops=((0, 7), (1, 6), (2, 5), (0, 6), (1, 7)))
    wrong = Relation(0, 4, compose(inverse(truth[0]), truth[4]) + [1.0, 0.5, 0.1], 1e3 * np.eye(3), loop=True)
    graph.add(wrong)
    graph.solve(200, 1e-12)

    def loss(x):
        squared = (whitened(graph, x).reshape(-1, 3) ** 2).sum(axis=1)
        return module.CAUCHY * np.log1p(squared / module.CAUCHY).sum()

    x = graph.frames[1:].ravel()
    gradient = np.array([(loss(x + d) - loss(x - d)) / 2e-6 for d in 1e-6 * np.eye(len(x))])
    scale = np.sqrt(np.diag(graph.covariance())[3:])
    assert np.abs(gradient * scale).max() < 1e-3
    assert np.hypot(*(graph.frames[:, :2] - truth[:, :2]).T).max() < 0.3
    assert graph.distances()[-1] > 100.0


def test_the_scale_holds_for_every_relation():
    """Oracle: the same graph with every covariance that much larger, those of before the scale was known as well."""
    scaled, whole = (ring(np.random.default_rng(4))[0] for _ in range(2))
    scaled.rescale(2.5)
    whole.replace([msgspec.structs.replace(r, information=r.information / 2.5) for r in whole.relations])
    for graph in (scaled, whole):
        graph.solve(50, 1e-12)
    assert np.allclose(scaled.frames, whole.frames, rtol=0, atol=1e-10)
    assert np.allclose(scaled.distances(), whole.distances(), rtol=1e-8)
    assert np.allclose(scaled.covariance(), whole.covariance(), rtol=1e-8, atol=1e-15)
    assert scaled.copy().scale == 2.5


def test_loops_that_err_alike_are_not_counted_twice():
    """Four maps see the last one in the same wrong place, as it is bent. Oracle: Monte Carlo, mean NEES of the frame.

    If all four were independent, they would be four times as sure: a mean NEES of about 9 instead of at most 3.
    """
    values, independent = [], []
    loose, sure = np.diag([1.0, 1.0, 0.1]), np.diag([0.02, 0.02, 0.005]) ** 2
    for seed in range(150):
        rng, graph = np.random.default_rng(seed), FrameGraph()
        truth = np.column_stack([np.arange(7.0), np.zeros(7), np.zeros(7)])
        for k in range(6):
            step = compose(inverse(truth[k]), truth[k + 1])
            graph.append(step, loose if k > 2 else 1e-3 * sure)
        bent = compose(truth[6], rng.multivariate_normal(np.zeros(3), sure))
        for k in range(4):
            graph.add(Relation(k, 6, compose(inverse(truth[k]), bent), np.linalg.inv(sure), loop=True))
        graph.solve()
        error = graph.frames[6] - truth[6]
        values.append(error @ np.linalg.solve(graph.own_covariances()[6], error))
        graph.replace([msgspec.structs.replace(r, loop=False) for r in graph.relations])
        independent.append(error @ np.linalg.solve(graph.own_covariances()[6], error))
    assert 1.5 < np.mean(values) < 3.6
    assert np.mean(independent) > 6.0


def test_what_an_overlay_adds_to_the_end_of_its_map():
    """Oracle: the error of the best linear estimate from both, by Monte Carlo over errors that they share."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        root = rng.normal(0, 0.1, (6, 6))
        joint = root @ root.T + 1e-4 * np.eye(6)
        added = beside_the_end(joint[:3, :3], joint[3:, 3:], joint[3:, :3])
        both = np.vstack([np.eye(3), np.eye(3)])
        gain = np.linalg.solve(both.T @ np.linalg.solve(joint, both), np.linalg.solve(joint, both).T)
        errors = gain @ np.linalg.cholesky(joint) @ rng.standard_normal((6, 100_000))
        claimed = np.linalg.inv(np.linalg.inv(joint[:3, :3]) + added)
        ratio = np.linalg.eigvals(np.linalg.solve(claimed, np.cov(errors))).real
        assert np.allclose(ratio, 1.0, atol=0.05)
    same = np.diag([1e-4, 1e-4, 1e-5])
    assert np.abs(beside_the_end(same, same + 1e-9 * np.eye(3), same)).max() < 1e-3 / 1e-5


def test_distances():
    graph, _ = ring(np.random.default_rng(1))
    expected = (whitened(graph, graph.frames[1:].ravel()).reshape(-1, 3) ** 2).sum(axis=1)
    assert np.allclose(graph.distances(), expected, rtol=1e-9)


@pytest.mark.parametrize(("first", "second"), [(0, 5), (5, 0), (2, 6), (6, 3), (4, 4)])
def test_between(first, second):
    """Oracle: numerical differences of the relation by both frames, and the joint covariance."""
    graph, _ = ring(np.random.default_rng(2))
    graph.solve()
    pose, covariance = graph.between(first, second)

    def relation(x):
        return compose(inverse(x[:3]), x[3:])

    at = np.r_[graph.frames[first], graph.frames[second]]
    design = np.array([approx_fprime(at, lambda x, i=i: relation(x)[i], 1e-7) for i in range(3)])
    entries = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
    expected = design @ graph.covariance()[np.ix_(entries, entries)] @ design.T
    assert np.allclose(pose, relation(at), atol=1e-12)
    assert np.allclose(covariance, expected, rtol=1e-4, atol=1e-10)


def test_from_each_is_between_one_by_one():
    """The frame itself and the first one, which is known, among them; and of no frame at all."""
    graph, _ = ring(np.random.default_rng(2))
    graph.solve()
    poses, covariances = graph.from_each([0, 3, 5, 7], 5)
    for row, first in enumerate((0, 3, 5, 7)):
        pose, covariance = graph.between(first, 5)
        assert np.array_equal(poses[row], pose) and np.array_equal(covariances[row], covariance)
    nowhere, unknown = graph.from_each([], 5)
    assert nowhere.shape == (0, 3) and unknown.shape == (0, 3, 3)


def test_the_covariance_of_a_solved_ring_is_honest():
    """Oracle: Monte Carlo, mean NEES of the last frame over 200 rings within its 99.9 % band about 3."""
    values = []
    for seed in range(200):
        graph, truth = ring(np.random.default_rng(seed), noise=0.005)
        graph.solve()
        error = graph.frames[-1] - truth[-1]
        error[2] = wrap(error[2])
        values.append(error @ np.linalg.solve(graph.covariance()[-3:, -3:], error))
    assert 2.45 < np.mean(values) < 3.6


def test_a_copy_is_its_own():
    graph, _ = ring(np.random.default_rng(3))
    other, frames, count = graph.copy(), graph.frames.copy(), len(graph.relations)
    other.append(np.array([1.0, 0, 0]), 1e-4 * np.eye(3))
    other.add(Relation(0, 2, np.zeros(3), np.eye(3), loop=True))
    other.solve()
    assert np.array_equal(graph.frames, frames) and len(graph.relations) == count
    assert graph.covariance().shape == (3 * len(frames), 3 * len(frames))


def test_one_frame_alone():
    graph = FrameGraph()
    graph.solve()
    assert graph.distances().shape == (0,)
    assert np.array_equal(graph.frames, np.zeros((1, 3))) and np.array_equal(
        graph.covariance(), np.zeros((3, 3))
    )
    pose, covariance = graph.between(0, 0)
    assert np.array_equal(pose, np.zeros(3)) and np.array_equal(covariance, np.zeros((3, 3)))


def laps(rng, wrong=()):
    """Two laps of 30 frames each round a ring: relations as (first, second, pose, covariance, loop).

    Every map's end; every third map laid on the one before as well; loops from lap to lap. wrong: (first, second) of
    loops that say a place 0.8 m and 0.2 rad beside the true one, and are as sure of it as the others.
    """
    angle = 2.0 * np.pi * np.arange(60) / 30
    truth = np.column_stack([4.0 * np.sin(angle), 4.0 * (1.0 - np.cos(angle)), angle])
    pairs = [(k, k + 1, False) for k in range(59)] + [(k, k + 1, True) for k in range(0, 59, 3)]
    pairs += [(k, k + 30 + k % 3, True) for k in range(0, 28, 2)] + [
        (0, 30, True),
        (0, 59, True),
        (4, 36, True),
    ]
    pairs += [(first, second, True) for first, second in wrong]
    relations = []
    for first, second, loop in pairs:
        root = rng.normal(0.0, 1.0, (3, 3)) * [[0.02], [0.02], [0.005]]
        covariance = root @ root.T + np.diag([0.01, 0.01, 0.003]) ** 2
        pose = compose(inverse(truth[first]), truth[second]) + rng.multivariate_normal(
            np.zeros(3), covariance
        )
        pose += [0.8, -0.5, 0.2] if (first, second) in wrong else np.zeros(3)
        pose[2] = wrap(pose[2])
        relations.append((first, second, pose, covariance, loop))
    return relations


def between_frames(a, b):
    """(R, 3) T_a_b of frames (R, 3), which may be complex: a tiny imaginary part carries an exact derivative."""
    way, c, s = b[:, :2] - a[:, :2], np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack([c * way[:, 0] + s * way[:, 1], c * way[:, 1] - s * way[:, 0], b[:, 2] - a[:, 2]])


def derivatives(a, b):
    """(R, 3, 6) of `between_frames` by both frames: complex steps."""
    step, both = 1e-30, np.column_stack([a, b])
    columns = [both + step * 1j * unit for unit in np.eye(6)]
    return np.stack([between_frames(each[:, :3], each[:, 3:]).imag / step for each in columns], axis=-1)


class DenseFrames:
    """The oracle: frames from relations by normal equations that are written out whole, solved and inverted by numpy.

    frames: (60, 3). covariance: (180, 180), the first frame's being zero.
    """

    def __init__(self, relations, scale, robust):
        self.first, self.second = np.array([each[:2] for each in relations]).T
        self.poses = np.array([each[2] for each in relations])
        self.weights = np.linalg.inv(scale * np.array([each[3] for each in relations]))
        self.robust = robust
        far = np.array([each[4] and each[1] - each[0] > 1 for each in relations])
        ends = [*self.first[far], *self.second[far]]
        used = [max(ends.count(i), ends.count(j)) for i, j in zip(self.first, self.second)]
        self.shares = np.where(far, 1.0 / np.maximum(1, used), 1.0)
        steps = [each[2] for each in relations if each[1] == each[0] + 1 and not each[4]]
        self.frames = np.zeros((1, 3))
        for step in steps:
            self.frames = np.vstack([self.frames, compose(self.frames[-1], step)])
        for _ in range(300):
            matrix, right = self.normal(np.ones(len(relations)))
            moves = np.linalg.solve(matrix, right).reshape(-1, 3)
            self.frames[1:] += moves
            if np.abs(moves).max() < 1e-13:
                break
        self.covariance = np.zeros((180, 180))
        self.covariance[3:, 3:] = np.linalg.inv(self.normal(self.shares)[0])

    def normal(self, shares):
        a, b = self.frames[self.first], self.frames[self.second]
        errors = between_frames(a, b) - self.poses
        errors[:, 2] -= 2.0 * np.pi * np.round(errors[:, 2] / (2.0 * np.pi))
        design = np.zeros((len(a), 3, 180))
        for row, own in enumerate(derivatives(a, b)):
            i, j = 3 * self.first[row], 3 * self.second[row]
            design[row, :, i : i + 3], design[row, :, j : j + 3] = own[:, :3], own[:, 3:]
        squared = np.einsum("ri,rij,rj->r", errors, self.weights, errors)
        held = shares / (1.0 + squared / module.CAUCHY) if self.robust else shares
        weighed = (held[:, None, None] * self.weights @ design).reshape(-1, 180)
        matrix, right = design.reshape(-1, 180).T @ weighed, -weighed.T @ errors.ravel()
        return matrix[3:, 3:], right[3:]

    def between(self, first, second):
        design = derivatives(self.frames[[first]], self.frames[[second]])[0]
        entries = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
        return design @ self.covariance[np.ix_(entries, entries)] @ design.T


def as_graph(relations, scale):
    """The same problem as the program takes it."""
    graph = FrameGraph()
    for first, second, pose, covariance, loop in relations:
        if loop:
            graph.add(Relation(first, second, pose, np.linalg.inv(covariance), loop=True))
        else:
            graph.append(pose, covariance)
    graph.rescale(scale)
    return graph


def off(ours, theirs):
    """The largest difference of two covariances (..., k, k), as a share of the standard deviations of its entry."""
    sigma = np.sqrt(np.diagonal(theirs, axis1=-2, axis2=-1))
    return (np.abs(ours - theirs) / (sigma[..., :, None] * sigma[..., None, :])).max()


WRONG = ((3, 40), (10, 50), (12, 44))
"""Loops that contradict all others, and each other."""


@pytest.mark.parametrize("form", ["dense", "qdldl", "superlu"])
@pytest.mark.parametrize(("wrong", "robust"), [((), False), ((), True), (WRONG, True)])
def test_dense_and_sparse_say_what_plain_normal_equations_say(monkeypatch, form, wrong, robust):
    """Frames, every frame's covariance, all of them jointly, and of pairs. Measured 3e-12 of a deviation."""
    if form == "qdldl":
        pytest.importorskip("qdldl")
    if form != "dense":
        monkeypatch.setattr("kalmap.slam.contours.spread.DENSE_FRAMES", 10)
        monkeypatch.setattr("kalmap.slam.submaps.sparse_cholesky._library", lambda: form)
    if not robust:
        monkeypatch.setattr(module, "CAUCHY", np.inf)
    relations = laps(np.random.default_rng(5), wrong)
    graph, oracle = as_graph(relations, 1.7), DenseFrames(relations, 1.7, robust)
    graph.solve(300, 1e-13, robust=robust)
    assert type(graph.spread()).__name__ == ("Dense" if form == "dense" else "Sparse")
    far = graph.distances()[[r.loop and (r.first, r.second) in wrong for r in graph.relations]]
    assert len(far) == len(wrong) and (far > 100.0).all()

    blocks = np.array([oracle.covariance[k : k + 3, k : k + 3] for k in range(3, 180, 3)])
    sigma = np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
    moved = graph.frames - oracle.frames
    moved[:, 2] = wrap(moved[:, 2])
    assert (moved[0] == 0.0).all() and (np.abs(moved[1:]) / sigma).max() < 1e-10
    own, whole = graph.own_covariances(), graph.covariance()
    assert (own[0] == 0.0).all() and (whole[:3] == 0.0).all() and (whole[:, :3] == 0.0).all()
    assert off(own[1:], blocks) < 1e-10
    assert off(whole[3:, 3:], oracle.covariance[3:, 3:]) < 1e-10
    pairs = [
        (i, j)
        for one in (0, 1, 33, 59)
        for other in range(60)
        for i, j in ((one, other), (other, one))
        if i != j
    ]
    handed = np.array([graph.between(*pair)[1] for pair in pairs])
    assert off(handed, np.array([oracle.between(*pair) for pair in pairs])) < 1e-10
