"""SLAM by random finite sets: particles whose maps are mixtures that need no association."""

from __future__ import annotations

import os

import numpy as np

from kalmap.gaussian import Cubature, Jacobian, NotPositiveError
from kalmap.gaussian.linearisers import BuiltIn
from kalmap.geometry.se2 import compose, exponential, inverse, logarithm, quarter_turn, rotate
from kalmap.kernels import set_layout
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.models.motion import BuiltInMotion
from kalmap.perception import Detector
from kalmap.records import (
    ConfigError,
    Estimate,
    EstimationError,
    Event,
    EventError,
    FiniteSetConfig,
    Fix,
    Frame,
    Odometry,
    Sightings,
)
from kalmap.slam.ahead import Ahead
from kalmap.slam.checks import (
    check_frame,
    check_odometry,
    check_sightings,
    check_time,
    checked_start,
    sighted,
)
from kalmap.slam.engines import BadSampleError, CompiledEngine
from kalmap.slam.particle_frames import ParticleFrames
from kalmap.slam.particles import Particles
from kalmap.slam.set_checkpoint import load_set_filter, save_set_filter
from kalmap.slam.set_map import features, joint_of, landmarks_of, mean_pose, pose_spread, rotated
from kalmap.slam.set_rules import (
    INTENSITIES,
    checked_config,
)
from kalmap.slam.window import Revisions


class FiniteSetSlam(ParticleFrames):
    """RB-PHD, SRCKF-PHD or Poisson multi-Bernoulli SLAM over particles, after the settings.

    motion, sensor: built-in models. config: see `FiniteSetConfig`. start, start_covariance: (3,) pose and its (3, 3),
    from which the particles are drawn. seed: of everything that is drawn; the same seed gives the same answer however
    many threads there are. extent: m, how far apart the sightings of one landmark from different sides are, as in
    `AssociationConfig`. detector: turns scans into sightings, if scans come.

    An event that cannot be used raises EventError and leaves the state as it was.
    """

    numbers_per_sighting = 2  # range and bearing

    def __init__(
        self,
        motion: BuiltInMotion | None = None,
        sensor: RangeBearing | None = None,
        config: FiniteSetConfig | None = None,
        *,
        start: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
        start_covariance: np.ndarray | None = None,
        seed: int = 1,
        extent: float = 0.0,
        detector: Detector | None = None,
    ) -> None:
        self.motion = VelocitySteering() if motion is None else motion
        sensor = RangeBearing() if sensor is None else sensor
        config = checked_config(FiniteSetConfig(method="pmb") if config is None else config)
        self.detector = detector
        if not (getattr(self.motion, "compiled", False) and getattr(sensor, "compiled", False)):
            raise ConfigError("finite_set: takes the built-in models of motion and sensor only")
        self.lineariser: BuiltIn = Cubature() if config.method == "srckf-phd" else Jacobian()
        engine = CompiledEngine(self.motion, sensor, self.lineariser, True, False)
        rng = np.random.default_rng(seed)
        pose, covariance = checked_start(start, start_covariance)
        biases = self.motion.biases
        means = np.array([bias.mean for bias in biases])
        self._ahead = Ahead(engine, means, np.diag([bias.sigma**2 for bias in biases]))
        poses = np.tile(pose, (config.particles, 1))
        if covariance.any():
            poses = rng.multivariate_normal(pose, covariance, config.particles, method="eigh")
        particles = Particles(poses, np.tile(means, (config.particles, 1)), config.cap)
        super().__init__(engine, sensor, config, particles, extent, rng)
        self._pose, self._spread = pose, covariance
        self._numbers: dict[int, int] = {}
        self._count = 0
        self._time = float("-inf")
        self._moved = False
        self._changes = 0
        self.step_number = 0
        self.frame_used = 0
        self.frame_sightings: Sightings | None = None
        self.labels, self.explain = False, False
        self.frame_nis, self.association_seconds = float("nan"), 0.0
        self.frame_labels = np.zeros(0, dtype=np.int64)
        self.frame_decision: Frame | None = None
        self.frame_revisions: Revisions = {}

    # --- the filter -------------------------------------------------------------------------------------------

    def step(self, event: Event) -> None:
        """Take one event: odometry moves the particles, a frame weighs them and updates their maps."""
        check_time(event, self._time)
        try:
            if isinstance(event, Odometry):
                self._predict(event)
            elif not isinstance(event, Fix):
                self._observe(sighted(event, self.detector))
        except NotPositiveError as problem:
            raise EstimationError(f"step {self.step_number}, t = {event.time:.6g} s: {problem}") from problem
        self._time = event.time
        self._changes += 1

    def _predict(self, event: Odometry) -> None:
        check_odometry(event, self.motion)
        try:
            self._ahead.predict(event)
        except BadSampleError as problem:
            raise EventError(str(problem), time=event.time, field="values") from problem
        self.step_number += len(event.values)
        self._moved = True

    def _observe(self, frame: Sightings) -> None:
        check_frame(frame, self._moved)
        check_sightings(frame, self._engine.noises(frame.values)[1])
        particles = self._particles
        root, gain, cross = self._ahead.parts()
        delta, reference = self._ahead.delta.copy(), self._ahead.reference
        particles.poses = compose(particles.poses, delta)
        if len(reference):
            off = exponential((particles.biases - reference) @ gain.T)
            particles.poses = compose(particles.poses, off)
        self._foreseen = particles.poses.copy()
        explained, tallies, ways = self._carry(frame, root, delta)
        if len(reference):
            off = logarithm(compose(inverse(self._foreseen), particles.poses))
            left = self._kept * rotated(self._left, -particles.poses[:, 2])
            particles.biases = particles.biases + self._ahead.learn(cross, ways, left, off, particles.weights)
        self.frame_used = round(float(particles.weights @ explained.sum(axis=1)))
        self.frame_sightings = frame
        self._say()
        self._learn_rates(explained, tallies)
        self._resample()
        weights = particles.weights
        self._ahead.start(weights @ particles.biases)
        self.frames_taken += 1

    def _say(self) -> None:
        """What is asked for at every instant, once a frame."""
        particles = self._particles
        self._best = int(np.argmax(particles.log_weights))
        self._pose = mean_pose(particles)
        self._spread = pose_spread(particles, self._pose, self._left)
        rows = particles.map_of(self.best)
        self._count = len(self._features(rows))

    def _features(self, rows: np.ndarray) -> np.ndarray:
        """Which components of a map (C, COLUMNS) are landmarks of the result, oldest first: (K,) indices."""
        least = self.config.feature
        if self.config.method in INTENSITIES:
            least *= (1.0 - float(self.rates.profile.max())) ** self.config.forgive
        return features(rows, self.config.feature, least)

    # --- saving -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that the filter knows, so that `load` goes on bit for bit."""
        save_set_filter(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, detector: Detector | None = None) -> FiniteSetSlam:
        """The filter that `save` wrote. Raises LogError if the file is not one of these or is damaged."""
        return load_set_filter(cls, path, detector)

    # --- what it says -----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the last event, s; -inf before the first."""
        return self._time

    @property
    def best(self) -> int:
        """The particle that was heaviest at the last frame, or the first of its children."""
        return self._best

    @property
    def pose(self) -> np.ndarray:
        """(3,) x m, y m, heading rad: the particles' mean, carried on by odometry."""
        return compose(self._pose, self._ahead.delta)

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3): between the particles, what the last frame left of each, and the way since."""
        turn, way = np.eye(3), self._ahead.covariance_of_way()
        step = rotate(self._pose[2], self._ahead.delta[:2])
        turn[:2, 2] = quarter_turn(step)
        cosine, sine = np.cos(self._pose[2]), np.sin(self._pose[2])
        axes = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(turn @ self._spread @ turn.T + axes @ way @ axes.T)

    @property
    def landmark_count(self) -> int:
        """How many landmarks the best particle's map holds."""
        return self._count

    @property
    def attribute_names(self) -> tuple[str, ...]:
        """None: the maps hold places alone."""
        return ()

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """The labels as they are: nothing is merged away under another number."""
        return labels

    def twin(self) -> FiniteSetSlam:
        """A fresh filter with the same settings, at the origin."""
        return FiniteSetSlam(
            self.motion, self.sensor, self.config, detector=self.detector, extent=self.extent
        )

    def landmark_places(self) -> np.ndarray:
        """(K, 2) m: the landmarks of the best particle's map, oldest first."""
        rows = self._particles.map_of(self.best)
        return rows[self._features(rows)][:, [set_layout.X, set_layout.Y]]

    def map(self, particle: int | None = None) -> np.ndarray:
        """(C, COLUMNS) the whole mixture of a particle, the best by default; a copy."""
        return self._particles.map_of(self.best if particle is None else particle).copy()

    def estimate(self) -> Estimate:
        """A snapshot: the mean pose, the best particle's map, and what the particles differ by in the covariances."""
        particles = self._particles
        rows = particles.map_of(self.best)
        best = rows[self._features(rows)]
        numbers = np.array(
            [self._numbers.setdefault(int(i), len(self._numbers)) for i in best[:, set_layout.ID]],
            dtype=np.int64,
        )
        landmarks, off = landmarks_of(particles, best, numbers)
        pose, covariance, stamp = self.pose, self.pose_covariance, self._changes
        bias_covariance = self._ahead.covariance

        def joint() -> tuple[np.ndarray, np.ndarray]:
            if stamp != self._changes:
                raise EstimationError("the filter has moved on: ask the joint covariance of a fresh estimate")
            return joint_of(particles, pose, covariance, bias_covariance, landmarks, off)

        return Estimate(
            time=self._time,
            pose=pose,
            covariance=covariance,
            landmarks=landmarks,
            biases=self._biases(),
            joint=joint,
            coordinates="additive",
        )

    def _biases(self) -> dict[str, tuple[float, float]]:
        weights, means = self._particles.weights, self._particles.biases
        mean = weights @ means
        spread = weights @ np.square(means - mean) + np.diag(self._ahead.covariance)
        return {
            bias.name: (float(mean[i]), float(np.sqrt(spread[i])))
            for i, bias in enumerate(self.motion.biases)
        }
