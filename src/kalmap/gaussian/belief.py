"""The belief: mean and joint covariance of robot and map, in one growing buffer that one owner mutates.

The covariance is kept as its packed lower triangle (half of n^2 doubles). The robot's motion between two
frames waits in a small matrix and reaches the cross-covariance once (`flush`).
"""

from __future__ import annotations

import numpy as np

from kalmap.kernels import packed as kernel


def packed_length(n: int) -> int:
    """How many numbers the lower triangle of an n x n matrix has."""
    return n * (n + 1) // 2


def packed_places(entries: np.ndarray) -> np.ndarray:
    """(k, k), where in a packed covariance that of the entries (k,) stands."""
    high = np.maximum(entries[:, None], entries[None])
    low = np.minimum(entries[:, None], entries[None])
    return np.asarray(high * (high + 1) // 2 + low)


class Belief:
    """Gaussian over (pose 3, biases, landmarks 2 each), n entries of which the first `robot` are the robot's.

    mean, packed: buffers; only their leading n and n (n + 1) / 2 entries mean something.
    phi: (robot, robot), the motion not yet carried to the cross-covariance; call `flush` before reading that.
    """

    __slots__ = ("left", "mean", "n", "packed", "pending", "phi", "right", "robot")

    def __init__(self, mean: np.ndarray, covariance: np.ndarray) -> None:
        """mean: (robot,). covariance: (robot, robot), semi-definite allowed."""
        self.robot = self.n = len(mean)
        self.mean = np.array(mean, dtype=float)
        self.packed = np.zeros(packed_length(self.n))
        kernel.pack(np.ascontiguousarray(covariance, dtype=float), self.n, self.packed)
        self.phi = np.eye(self.robot)
        self.pending = False
        self.left = np.zeros((8, self.n))
        self.right = np.zeros((8, self.n))

    def reserve(self, n: int) -> None:
        """Make room for n entries, and a tenth more, so that growth costs little on the whole."""
        if n > len(self.mean):
            capacity = n + max(16, n // 10)
            self.mean.resize(capacity, refcheck=False)
            self.packed.resize(packed_length(capacity), refcheck=False)

    def work(self, rank: int) -> tuple[np.ndarray, np.ndarray]:
        """Two work spaces of at least (rank + 6, n): O(n rank)."""
        rows, columns = self.right.shape
        if rows < rank + 6 or columns < self.n:
            shape = (max(rows, rank + 6), max(columns, len(self.mean)))
            self.left, self.right = np.zeros(shape), np.zeros(shape)
        return self.left, self.right

    def flush(self) -> None:
        """Carry the motion since the last frame to the cross-covariance with the map: O(n)."""
        if self.pending:
            kernel.transform_leading(self.packed, self.n, self.robot, self.phi)
            self.pending = False

    def remove(self, first: int, count: int) -> None:
        """Marginalise entries first..first+count out, exactly."""
        self.flush()
        self.n = kernel.remove(self.packed, self.mean, self.n, first, count)

    def covariance(self) -> np.ndarray:
        """The joint covariance (n, n), unpacked: a copy."""
        self.flush()
        full = np.empty((self.n, self.n))
        kernel.unpack(self.packed, self.n, full)
        return full

    def robot_covariance(self) -> np.ndarray:
        """(robot, robot), a copy; it is current without a flush."""
        full = np.empty((self.robot, self.robot))
        kernel.unpack(self.packed, self.robot, full)
        return full

    def block(self, entries: np.ndarray) -> np.ndarray:
        """(k, k) covariance of the entries (k,), a copy, without unpacking the rest."""
        return self.packed[packed_places(entries)]

    def variances(self) -> np.ndarray:
        """The diagonal (n,), a copy; current without a flush."""
        i = np.arange(self.n)
        return self.packed[i * (i + 3) // 2]

    def landmark_covariances(self) -> np.ndarray:
        """(N, 2, 2) of all landmarks, a copy."""
        i = np.arange(self.robot, self.n, 2)
        xx = self.packed[i * (i + 3) // 2]
        row = (i + 1) * (i + 2) // 2
        xy, yy = self.packed[row + i], self.packed[row + i + 1]
        return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
