"""How far odometry has carried every particle since the last frame: one Gaussian for all of them.

A pose moves by composition with the increments of its odometry, whatever it was; so the way since the last frame is
one increment delta with a covariance, in the frame that the vehicle had then, and every particle's pose is
x compose delta compose exp(G (b - b0) + R e), e ~ N(0, I): R the root of what the odometry's noise adds and G what an
error b - b0 of the constant biases does.
"""

from __future__ import annotations

import math

import numpy as np

from kalmap.gaussian import Belief
from kalmap.gaussian.roots import NotPositiveError
from kalmap.kernels.regression import square_root
from kalmap.records import Odometry
from kalmap.slam.engines import Engine


class Ahead:
    """The way since the last frame, and what the particles know of the biases.

    covariance (nb, nb) of the biases is the same for all particles: what a sampled way tells about them depends on
    the models alone; their means are each particle's own.
    """

    def __init__(self, engine: Engine, means: np.ndarray, covariance: np.ndarray) -> None:
        self.engine, self.covariance = engine, covariance
        self.start(means)

    def start(self, means: np.ndarray) -> None:
        """Begin again at a frame; means (nb,): the biases about which the way is computed."""
        self.reference = means
        size = 3 + len(means)
        covariance = np.zeros((size, size))
        covariance[3:, 3:] = self.covariance
        self.belief = Belief(np.concatenate([np.zeros(3), means]), covariance)

    def predict(self, event: Odometry) -> None:
        """Take odometry. Raises as `Engine.predict`."""
        self.engine.predict(self.belief, event)

    @property
    def delta(self) -> np.ndarray:
        """(3,) the way so far, with the biases at their reference."""
        return self.belief.mean[:3]

    def covariance_of_way(self) -> np.ndarray:
        """(3, 3) of the way, biases and noise together, in the frame of its beginning."""
        return self.belief.robot_covariance()[:3, :3]

    def parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(root (3, 3) of noise and biases together, G (3, nb), cross (nb, 3)), in the body's frame at the way's end.

        cross: covariance of the biases with the way.
        """
        whole = self.belief.robot_covariance()
        cosine, sine = math.cos(self.delta[2]), math.sin(self.delta[2])
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        total = turn @ whole[:3, :3] @ turn.T
        root = np.zeros((3, 3))
        if not square_root(0.5 * (total + total.T), 3, root):
            raise NotPositiveError(
                "the covariance of the way since the last frame is not positive semi-definite"
            )
        cross = turn @ whole[:3, 3:]
        bias = whole[3:, 3:]
        g = cross @ np.linalg.pinv(bias) if len(bias) else np.zeros((3, 0))
        return root, g, cross.T

    def learn(
        self, cross: np.ndarray, ways: np.ndarray, left: np.ndarray, off: np.ndarray, weights: np.ndarray
    ) -> np.ndarray:
        """Shrink the biases' covariance by what the particles' poses tell, and say how their means move: (N, nb).

        cross (nb, 3): see `parts`. ways (N, 3, 3): root of what was not known of each pose before the frame, left
        (N, 3, 3): of what it keeps of that; off (N, 3): how far it was put from where odometry foresaw it; all in the
        body's frame.
        """
        whole = ways @ ways.transpose(0, 2, 1)
        k = cross @ np.linalg.pinv(whole, hermitian=True)
        told = np.einsum("n,nij->ij", weights, whole - left @ left.transpose(0, 2, 1))
        mean = np.einsum("n,nij->ij", weights, k)
        shrunk = self.covariance - mean @ told @ mean.T
        self.covariance = 0.5 * (shrunk + shrunk.T)
        return np.einsum("nij,nj->ni", k, off)
