"""The belief's buffer: growth, delayed motion, marginalisation and memory, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.gaussian import Belief
from kalmap.gaussian.belief import packed_length
from slam_problems import belief_of, random_belief, random_covariance


def test_starts_from_a_semidefinite_covariance():
    """Oracle: the matrix handed in."""
    covariance = np.diag([1.0, 0.0, 2.0])
    belief = Belief(np.array([1.0, 2.0, 3.0]), covariance)
    np.testing.assert_array_equal(belief.covariance(), covariance)
    np.testing.assert_array_equal(belief.robot_covariance(), covariance)
    assert belief.n == belief.robot == 3


def test_reserve_keeps_everything_and_wastes_little():
    """Oracle: the dense covariance before; at most 1.3 n^2 doubles for buffers and work space."""
    rng, n = np.random.default_rng(0), 403
    covariance = random_covariance(rng, n)
    belief = belief_of(rng.standard_normal(n), covariance, 3)
    mean = belief.mean[:n].copy()
    belief.reserve(n + 2)
    belief.work(2 * 10)
    np.testing.assert_array_equal(belief.mean[:n], mean)
    np.testing.assert_array_equal(np.tril(belief.covariance()), np.tril(covariance))
    held = sum(a.nbytes for a in (belief.mean, belief.packed, belief.phi, belief.left, belief.right)) / 8
    assert held <= 1.3 * n**2


def test_growth_reallocates_rarely():
    """Oracle: a tenth of room each time means O(log n) reallocations."""
    belief, sizes = Belief(np.zeros(3), np.eye(3)), set()
    for n in range(5, 1000, 2):
        belief.reserve(n)
        sizes.add(len(belief.mean))
        assert len(belief.packed) == packed_length(len(belief.mean))
    assert len(sizes) < 60


def test_flush_carries_the_motion_to_the_cross_covariance():
    """Oracle: dense T P T' with T = diag(phi, I) on everything but the robot's own block."""
    belief = random_belief(np.random.default_rng(1), biases=1)
    before, phi = belief.covariance(), np.random.default_rng(2).standard_normal((4, 4))
    belief.phi[:], belief.pending = phi, True
    np.testing.assert_array_equal(belief.robot_covariance(), before[:4, :4])
    np.testing.assert_array_equal(belief.variances(), np.diag(before))
    after = belief.covariance()
    np.testing.assert_allclose(after[4:, :4], before[4:, :4] @ phi.T, atol=1e-14)
    np.testing.assert_array_equal(after[4:, 4:], before[4:, 4:])
    assert not belief.pending
    np.testing.assert_array_equal(belief.phi, np.eye(4))


@pytest.mark.parametrize("landmark", [0, 2, 4])
def test_remove_marginalises_exactly(landmark):
    """Oracle: np.delete on the flushed covariance; pending motion must not be lost."""
    belief = random_belief(np.random.default_rng(3))
    belief.phi[:], belief.pending = np.eye(3) + 0.1, True
    twin = random_belief(np.random.default_rng(3))
    twin.phi[:], twin.pending = np.eye(3) + 0.1, True
    full, first = twin.covariance(), 3 + 2 * landmark
    mean = np.delete(belief.mean[: belief.n], [first, first + 1])
    belief.remove(first, 2)
    np.testing.assert_array_equal(belief.mean[: belief.n], mean)
    kept = np.delete(np.arange(len(full)), [first, first + 1])
    np.testing.assert_array_equal(belief.covariance(), full[np.ix_(kept, kept)])


def test_landmark_covariances_are_the_diagonal_blocks():
    """Oracle: slices of the dense covariance."""
    belief = random_belief(np.random.default_rng(4), biases=2, landmarks=6)
    full, blocks = belief.covariance(), belief.landmark_covariances()
    assert blocks.shape == (6, 2, 2)
    for k, block in enumerate(blocks):
        i = 5 + 2 * k
        np.testing.assert_array_equal(block, full[i : i + 2, i : i + 2])


def test_work_spaces_grow_with_rank_and_state_and_are_kept():
    """Oracle: the promised shape, and identity when nothing more is asked."""
    belief = random_belief(np.random.default_rng(5), landmarks=20)
    left, right = belief.work(30)
    assert min(left.shape[0], right.shape[0]) >= 36 and min(left.shape[1], right.shape[1]) >= belief.n
    again, _ = belief.work(12)
    assert again is left
