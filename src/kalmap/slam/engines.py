"""The two ways to carry out a filter's steps on a belief.

`CompiledEngine` serves the built-in models, linearisers and the reduced scope. `GeneralEngine` serves any model
and the full scope: it linearises in numpy and shares the update of the covariance with the other. The tests hold
the two to the same answers.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from kalmap.gaussian import Belief, Function, Lineariser, Regression
from kalmap.gaussian.roots import NotPositiveError, semidefinite_root
from kalmap.geometry.angles import wrap
from kalmap.kernels import candidates, layout, motion, sensing, update
from kalmap.models.charts import NewLandmark, NextPose, SeenLandmark, twist_matrix
from kalmap.models.motion import BuiltInMotion, MotionModel
from kalmap.models.sensor import RangeBearing, SensorModel, outlier_distance
from kalmap.records import Odometry

_NO_COVARIANCE = {c: np.zeros((0, c, c)) for c in (2, 3)}


class Engine(Protocol):
    """What a filter does to a belief. Every method raises NotPositiveError and leaves the belief as it was."""

    def noises(self, z: np.ndarray) -> tuple[np.ndarray, int]:
        """(M, 2, 2) sensor noise of a frame, and the index of its first impossible sighting or -1."""
        ...

    def predict(self, belief: Belief, event: Odometry) -> None: ...

    def update(self, belief: Belief, z: np.ndarray, indices: np.ndarray, noises: np.ndarray) -> float:
        """Apply matched sightings; `indices` are where their landmarks begin in the state. Returns the NIS."""
        ...

    def append(self, belief: Belief, z: np.ndarray, noises: np.ndarray) -> None:
        """Found a landmark for every sighting."""
        ...

    def expect(self, belief: Belief, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How landmarks should look now; `indices` (C,) are where they begin in the state.

        Returns (C, 2) range and bearing, their regression matrices (C, 2, 5) on (pose, landmark), and their
        covariances (C, 2, 2) without the sensor's noise.
        """
        ...

    def merge(self, belief: Belief, first: int, second: int, extent: float = 0.0) -> None:
        """Make two landmarks one by the constraint that they are the same; `first`, `second`: where they begin.

        extent: m, how far apart the same thing seems from different sides; 0: a constraint without noise.
        """
        ...


_PROBLEMS = {
    layout.NOT_POSITIVE: "the covariance of the robot or of a landmark is not positive semi-definite",
    layout.INNOVATION_NOT_POSITIVE: "the innovation covariance is not positive definite",
    layout.NOT_FINITE: "a number of the state is no longer finite",
    layout.BAD_SAMPLE: "an odometry sample is not finite or has a negative duration",
}


class BadSampleError(ValueError):
    """An odometry sample that cannot be one; nothing has been changed."""


def _check(status: int) -> None:
    if status == layout.BAD_SAMPLE:
        raise BadSampleError(_PROBLEMS[status])
    if status != layout.OK:
        raise NotPositiveError(_PROBLEMS[status])


def _check_noises(noises: np.ndarray) -> None:
    if sensing.first_bad_noise(noises) >= 0:
        _check(layout.INNOVATION_NOT_POSITIVE)


class CompiledEngine:
    """Built-in models, reduced scope: everything in compiled kernels."""

    def __init__(
        self,
        motion_model: BuiltInMotion,
        sensor: RangeBearing,
        lineariser: Lineariser,
        invariant: bool,
        sequential: bool,
    ) -> None:
        self.setup = np.zeros(layout.SETUP_LENGTH)
        self.setup[layout.RULE] = lineariser.code  # type: ignore[attr-defined]
        self.setup[layout.RULE_A : layout.RULE_C + 1] = lineariser.rule()  # type: ignore[attr-defined]
        self.setup[layout.INVARIANT] = invariant
        self.setup[layout.SEQUENTIAL] = sequential
        motion_model.fill(self.setup)
        sensor.fill(self.setup)
        self._default = _NO_COVARIANCE[motion_model.control_size]

    def noises(self, z: np.ndarray) -> tuple[np.ndarray, int]:
        out = np.empty((len(z), 2, 2))
        return out, sensing.fill_noises(self.setup, z, out)

    def predict(self, belief: Belief, event: Odometry) -> None:
        given = self._default if event.covariance is None else event.covariance
        status = motion.propagate(
            self.setup, belief.mean, belief.packed, belief.phi, event.values, event.durations, given
        )
        if status:
            _check(status)
        belief.pending = True

    def update(self, belief: Belief, z: np.ndarray, indices: np.ndarray, noises: np.ndarray) -> float:
        left, right = belief.work(2 * len(indices))
        belief.pending = False
        status, nis = update.flush_and_update(
            self.setup, belief.mean, belief.packed, belief.n, belief.phi, z, indices, noises, left, right
        )
        if status:
            _check(status)
        return nis

    def append(self, belief: Belief, z: np.ndarray, noises: np.ndarray) -> None:
        belief.flush()
        belief.reserve(belief.n + 2 * len(z))
        status, n = update.append_frame(self.setup, belief.mean, belief.packed, belief.n, z, noises)
        _check(status)
        belief.n = n

    def expect(self, belief: Belief, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count = len(indices)
        expected, matrices, spreads = np.empty((count, 2)), np.empty((count, 2, 5)), np.empty((count, 2, 2))
        status = candidates.regress_candidates(
            self.setup, belief.mean, belief.packed, belief.phi, indices, expected, matrices, spreads
        )
        if status:
            _check(status)
        return expected, matrices, spreads

    def merge(self, belief: Belief, first: int, second: int, extent: float = 0.0) -> None:
        _merge(self.setup, belief, first, second, extent)


def _merge(setup: np.ndarray, belief: Belief, first: int, second: int, extent: float) -> None:
    belief.flush()
    left, right = belief.work(4)
    status, _ = update.constrain_equal(
        setup, belief.mean, belief.packed, belief.n, first, second, extent, left, right
    )
    _check(status)


class GeneralEngine:
    """Any model, any lineariser, both scopes. `full` hands the whole state to the lineariser, O(n^3).

    The block's root puts what the function reads first, so that central differences and the unscented
    transform with n + kappa = 3 give the same in both scopes.
    """

    def __init__(
        self,
        motion_model: MotionModel,
        sensor: SensorModel,
        lineariser: Lineariser,
        invariant: bool,
        sequential: bool,
        full: bool,
    ) -> None:
        self.motion, self.sensor, self.lineariser = motion_model, sensor, lineariser
        self.invariant, self.sequential, self.full = invariant, sequential, full
        self._setup = np.zeros(layout.SETUP_LENGTH)  # the part that applying a regressed frame reads
        self._setup[layout.INVARIANT] = invariant
        self._setup[layout.BIAS_COUNT] = len(motion_model.biases)
        self._gate = outlier_distance(sensor)

    def noises(self, z: np.ndarray) -> tuple[np.ndarray, int]:
        return self.sensor.covariance(z), sensing.first_bad_sighting(z)

    def _regress(self, belief: Belief, f: Function, read: np.ndarray, extra: np.ndarray) -> Regression:
        """Regress f on the state's entries `read` and further noise; the matrix keeps the columns that f reads.

        read: (r,) state indices, robot first. extra: (k, k) covariance of the inputs that follow them.
        """
        r, k = len(read), len(extra)
        rest = np.setdiff1d(np.arange(belief.n), read) if self.full else np.zeros(0, dtype=int)
        order = np.concatenate([read, rest])
        block = belief.block(order)
        if self.invariant:
            landmarks = {
                p: belief.mean[i : i + 2] for p, i in enumerate(order) if _starts_landmark(i, belief.robot)
            }
            change = twist_matrix(len(order), belief.mean[:2], landmarks)
            block = change @ block @ change.T
        whole = np.zeros((len(order) + k, len(order) + k))
        inputs = np.concatenate([np.arange(r), r + k + np.arange(len(rest))])
        whole[np.ix_(inputs, inputs)] = 0.5 * (block + block.T)
        whole[r : r + k, r : r + k] = extra
        regression = self.lineariser(f, np.zeros(len(whole)), whole)
        matrix = regression.matrix[:, : r + k].copy()
        if self.invariant:
            matrix[:, :r] = matrix[:, :r] @ change[:r, :r]
        return Regression(regression.mean, regression.covariance, matrix, regression.residual)

    def predict(self, belief: Belief, event: Odometry) -> None:
        if not (np.isfinite(event.values).all() and np.isfinite(event.durations).all()) or (
            event.durations.min(initial=0.0) < 0.0
        ):
            raise BadSampleError(_PROBLEMS[layout.BAD_SAMPLE])
        d = belief.robot
        head = d * (d + 1) // 2
        before = belief.mean[:d].copy(), belief.packed[:head].copy(), belief.phi.copy(), belief.pending
        if self.full:  # the whole state's root needs a current cross-covariance at every sample
            belief.flush()
            head = belief.n * (belief.n + 1) // 2
            before = before[0], belief.packed[:head].copy(), belief.phi.copy(), False
        try:
            for q in () if event.covariance is None else event.covariance:
                semidefinite_root(q)
            for t in range(len(event.durations)):
                self._predict_sample(belief, event, t)
        except NotPositiveError:
            belief.mean[:d], belief.packed[:head], belief.phi[:], belief.pending = before
            raise

    def _predict_sample(self, belief: Belief, event: Odometry, t: int) -> None:
        if self.full:
            belief.flush()
        d, control, dt = belief.robot, event.values[t], float(event.durations[t])
        q = self.motion.control_covariance(control, dt) if event.covariance is None else event.covariance[t]
        f = NextPose(self.motion, belief.mean[:3], belief.mean[3:d], control, dt, self.invariant)
        regression = self._regress(belief, f, np.arange(d), q)
        matrix, residual = regression.matrix, regression.residual
        pose = f.next_pose(regression.mean)
        if self.invariant:
            moved = np.eye(3)
            moved[0, 2], moved[1, 2] = -(pose[1] - f.next_position[1]), pose[0] - f.next_position[0]
            matrix, residual = moved @ matrix, moved @ residual @ moved.T
        step = np.eye(d)
        step[:3] = matrix[:, :d]
        block = step @ belief.robot_covariance() @ step.T
        block[:3, :3] += matrix[:, d:] @ q @ matrix[:, d:].T + residual
        if not (np.isfinite(pose).all() and np.isfinite(block).all()):
            raise NotPositiveError(_PROBLEMS[layout.NOT_FINITE])
        lower = np.tril_indices(d)
        belief.mean[:3], belief.packed[: len(lower[0])] = pose, block[lower]
        belief.phi[:], belief.pending = step @ belief.phi, True

    def update(self, belief: Belief, z: np.ndarray, indices: np.ndarray, noises: np.ndarray) -> float:
        belief.flush()
        _check_noises(noises)
        nis, group = 0.0, 1 if self.sequential else len(indices)
        left, right = belief.work(2 * group)
        for first in range(0, len(indices), group):
            part = slice(first, first + group)
            seen = [self._regress_seen(belief, int(i)) for i in indices[part]]
            innovation = z[part] - np.array([expected for expected, _ in seen])
            innovation[:, 1] = wrap(innovation[:, 1])
            matrices = np.array([regression.matrix for _, regression in seen])
            total = noises[part] + np.array([regression.residual for _, regression in seen])
            if self._gate > 0.0:
                nis += update.inflate_outliers(
                    self._gate, belief.packed, indices[part], matrices, innovation.ravel(), total
                )
            status, value = update.apply_frame(
                self._setup, belief.mean, belief.packed, belief.n, indices[part], matrices,
                innovation.ravel(), total, left, right,
            )  # fmt: skip
            _check(status)
            nis += value
        return nis

    def _regress_seen(self, belief: Belief, index: int) -> tuple[np.ndarray, Regression]:
        """The predicted (range, bearing) of the landmark that begins at `index`, and its regression."""
        f = SeenLandmark(
            self.sensor, belief.mean[:3].copy(), belief.mean[index : index + 2].copy(), self.invariant
        )
        regression = self._regress(belief, f, np.array([0, 1, 2, index, index + 1]), np.zeros((0, 0)))
        return f.expected + regression.mean, regression

    def append(self, belief: Belief, z: np.ndarray, noises: np.ndarray) -> None:
        belief.flush()
        _check_noises(noises)
        n = belief.n
        try:
            self._append(belief, z, noises)
        except NotPositiveError:
            belief.n = n
            raise

    def _append(self, belief: Belief, z: np.ndarray, noises: np.ndarray) -> None:
        for sighting, noise in zip(z, noises, strict=True):
            f = NewLandmark(self.sensor, belief.mean[:3].copy(), sighting, self.invariant)
            regression = self._regress(belief, f, np.arange(3), noise)
            matrix = regression.matrix.copy()
            if self.invariant:
                dx, dy = f.landmark - belief.mean[:2]
                matrix[:, 2] += (-dy, dx)
            if not (np.isfinite(f.landmark).all() and np.isfinite(matrix).all()):
                raise NotPositiveError(_PROBLEMS[layout.NOT_FINITE])
            belief.reserve(belief.n + 2)
            belief.n = update.append_landmark(
                belief.mean,
                belief.packed,
                belief.n,
                f.landmark + regression.mean,
                matrix,
                noise,
                regression.residual,
            )

    def expect(self, belief: Belief, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        belief.flush()
        seen = [self._regress_seen(belief, int(index)) for index in indices]
        if not seen:
            return np.zeros((0, 2)), np.zeros((0, 2, 5)), np.zeros((0, 2, 2))
        return (
            np.array([expected for expected, _ in seen]),
            np.array([regression.matrix for _, regression in seen]),
            np.array([regression.covariance for _, regression in seen]),
        )

    def merge(self, belief: Belief, first: int, second: int, extent: float = 0.0) -> None:
        _merge(self._setup, belief, first, second, extent)


def _starts_landmark(index: int, robot: int) -> bool:
    return index >= robot and (index - robot) % 2 == 0
