"""The models as functions of an error: what a lineariser is handed, in either error coordinates.

Every function here takes a deviation from the mean (its argument is zero at the mean) and returns the deviation
of its output. In additive coordinates deviations are differences; in invariant ones a deviation of (pose,
landmarks) is a twist about the robot's position, which turns the map with the robot. A regression matrix on
twists becomes one on differences by `twist_matrix`.

The argument may be longer than what the function reads (`scope="full"` hands over the whole state): the
function reads its leading entries, Theorem 1 of Chen & Cheng 2012.
"""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import exp_position, log_position, quarter_turn, rotate
from kalmap.models.motion import MotionModel
from kalmap.models.sensor import SensorModel


class _Deviation:
    """A function of a deviation with a numeric Jacobian, and the output's angles already wrapped."""

    size = 0

    def __call__(self, x: np.ndarray) -> np.ndarray:
        raise AttributeError("overridden by every function")

    def minus(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Outputs are deviations: wrapped where they are angles, so they subtract."""
        return a - b

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Central differences of the leading `size` entries; zero on the rest."""
        step = 1e-6
        points = step * np.eye(self.size, len(x))
        difference = (self(x + points) - self(x - points)) / (2.0 * step)
        return np.concatenate([difference.T, np.zeros((difference.shape[1], len(x) - self.size))], axis=1)


class NextPose(_Deviation):
    """Deviation of (pose, biases, control) -> deviation of the next pose."""

    def __init__(
        self,
        motion: MotionModel,
        pose: np.ndarray,
        biases: np.ndarray,
        control: np.ndarray,
        dt: float,
        invariant: bool,
    ) -> None:
        self.motion, self.pose, self.biases, self.control = motion, pose, biases, control
        self.dt, self.invariant = dt, invariant
        self.size = 3 + len(biases) + len(control)
        self.step = motion.increment(control, biases, dt)
        self.next_position = pose[:2] + rotate(pose[2], self.step[:2])

    def next_pose(self, deviation: np.ndarray) -> np.ndarray:
        """The undeviated next pose moved by an output deviation (3,)."""
        shift = exp_position(deviation[2], deviation[:2]) if self.invariant else deviation[:2]
        heading = wrap(self.pose[2] + self.step[2] + deviation[2])
        return np.array([*(self.next_position + shift), heading])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        nb = len(self.biases)
        turn = x[..., 2]
        shift = exp_position(turn, x[..., :2]) if self.invariant else x[..., :2]
        biases, control = self.biases + x[..., 3 : 3 + nb], self.control + x[..., 3 + nb : self.size]
        step = self.motion.increment(control, biases, self.dt)
        position = self.pose[:2] + shift + rotate(self.pose[2] + turn, step[..., :2])
        angle = turn + step[..., 2] - self.step[2]
        moved = position - self.next_position
        moved = log_position(angle, moved) if self.invariant else moved
        return np.concatenate([moved, angle[..., None]], axis=-1)


class SeenLandmark(_Deviation):
    """Deviation of (pose, landmark) -> deviation of (range, bearing)."""

    size = 5

    def __init__(self, sensor: SensorModel, pose: np.ndarray, landmark: np.ndarray, invariant: bool) -> None:
        self.sensor, self.pose, self.landmark, self.invariant = sensor, pose, landmark, invariant
        self.expected = sensor.predict(pose, landmark)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        pose, landmark = self.pose + x[..., :3], self.landmark + x[..., 3:5]
        if self.invariant:
            turn, centre = x[..., 2], self.pose[:2]
            position = centre + exp_position(turn, x[..., :2])
            pose = np.concatenate([position, pose[..., 2:]], axis=-1)
            landmark = centre + rotate(turn, self.landmark - centre) + exp_position(turn, x[..., 3:5])
        z = self.sensor.predict(pose, landmark) - self.expected
        return np.stack([z[..., 0], wrap(z[..., 1])], axis=-1)


class NewLandmark(_Deviation):
    """Deviation of (pose, range, bearing) -> deviation of the landmark that the sighting founds."""

    size = 5

    def __init__(self, sensor: SensorModel, pose: np.ndarray, z: np.ndarray, invariant: bool) -> None:
        self.sensor, self.pose, self.z, self.invariant = sensor, pose, z, invariant
        self.landmark = sensor.locate(pose, z)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        pose, z = self.pose + x[..., :3], self.z + x[..., 3:5]
        if not self.invariant:
            return self.sensor.locate(pose, z) - self.landmark
        turn, centre = x[..., 2], self.pose[:2]
        position = centre + exp_position(turn, x[..., :2])
        landmark = self.sensor.locate(np.concatenate([position, pose[..., 2:]], axis=-1), z)
        return log_position(turn, landmark - centre - rotate(turn, self.landmark - centre))


def twist_matrix(n: int, centre: np.ndarray, positions: dict[int, np.ndarray]) -> np.ndarray:
    """N with xi = N d: twists about `centre` from differences; entry 2 is the heading.

    positions: where each landmark's two entries begin -> its mean (2,). Identity elsewhere.
    """
    change = np.eye(n)
    for index, position in positions.items():
        change[index : index + 2, 2] -= quarter_turn(position - centre)
    return change
