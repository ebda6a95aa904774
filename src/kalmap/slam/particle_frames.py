"""A frame through all particles of a finite-set filter: carried, weighed, resampled, and what it tells of the rates."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from kalmap.kernels import particles as kernel
from kalmap.kernels.hypotheses import step_hypotheses
from kalmap.kernels.regression import square_root
from kalmap.models import RangeBearing
from kalmap.records import FiniteSetConfig, Sightings
from kalmap.slam.engines import CompiledEngine
from kalmap.slam.particles import Particles
from kalmap.slam.set_rules import RINGS, rates_from_config, rules_from_config, set_rates

_NO_BEAMS = np.zeros((0, 2))
_DRAWN = 0.6  # share of a proposal's standard deviation that is drawn; the rest stays with the particle
_PARALLEL = 8  # particles from which a second thread is worth its start


class ParticleFrames:
    """The particles, the rules of their maps and the rates that are learnt. Arguments as `FiniteSetSlam`.

    recovered: how often all particles had lost all weight; they then go on with equal ones. resampled: how often only
    some of them went on.
    """

    def __init__(
        self,
        engine: CompiledEngine,
        sensor: RangeBearing,
        config: FiniteSetConfig,
        particles: Particles,
        extent: float,
        rng: np.random.Generator,
    ) -> None:
        self.sensor, self.config, self.extent, self.rng = sensor, config, extent, rng
        self._engine, self._particles = engine, particles
        self.rates = rates_from_config(config)
        self._rules = rules_from_config(config, sensor)
        self._left = np.zeros((len(particles), 3, 3))
        self._spread_by = _DRAWN if config.proposal == "sightings" else 1.0
        self._kept = float(np.sqrt(1.0 - self._spread_by**2))
        self._foreseen = particles.poses
        self._best = 0
        self.frames_taken = self.resampled = self.recovered = 0
        self._pool: ThreadPoolExecutor | None = None

    def _carry(self, frame: Sightings, root: np.ndarray, delta: np.ndarray) -> tuple[np.ndarray, ...]:
        """Every particle through the frame, weighed. root, delta: of the way since the last one. Returns explained
        (N, M), tallies (N, 2, RINGS) and ways (N, 3, 3)."""
        particles, config, z = self._particles, self.config, np.ascontiguousarray(frame.values)
        number = len(particles)
        set_rates(self._rules, self.rates, config.new_rate, self.sensor)
        tallies, ways = np.zeros((number, 2, RINGS)), np.empty((number, 3, 3))
        normals = self.rng.standard_normal((number, 3))
        by_motion = config.proposal == "motion"
        begin = (
            self._engine.setup,
            self._rules,
            self.rates.profile,
            _beams(frame),
            _noise(frame, self.extent),
        )
        way = (root, delta, z, self.frames_taken)
        how = (
            kernel.BY_MOTION if by_motion else kernel.BY_SIGHTINGS,
            not (by_motion and config.method == "srckf-phd"),
            self._spread_by,
            normals,
        )
        if config.method == "mh-fastslam":
            return self._branch(begin, way, how, tallies, ways)
        particles.own(len(z))
        maps = (particles.blocks, particles.counts, particles.slots, particles.poses)
        kind = kernel.BERNOULLI if config.method == "pmb" else kernel.PHD
        log_factors, explained = np.zeros(number), np.zeros((number, len(z)))
        out = (self._left, ways, log_factors, explained, tallies)

        def part(first: int, last: int) -> None:
            kernel.step_particles(*begin, *maps, *way, kind, *how, first, last, *out)

        self._in_threads(part, number)
        if not particles.weigh(log_factors):
            self.recovered += 1
        return explained, tallies, ways

    def _branch(
        self,
        begin: tuple[np.ndarray, ...],
        way: tuple[np.ndarray, np.ndarray, np.ndarray, int],
        how: tuple[int, bool, float, np.ndarray],
        tallies: np.ndarray,
        ways: np.ndarray,
    ) -> tuple[np.ndarray, ...]:
        """The frame by hypotheses: every particle becomes several, of which as many as there were go on."""
        particles, branches, z = self._particles, self.config.branches, way[2]
        number = len(particles)
        rows, counts = particles.room_for_children(branches, len(z))
        maps = (particles.blocks, particles.counts, particles.slots, particles.poses)
        logs, made = np.full(number * branches, -np.inf), np.zeros(number, dtype=np.int64)
        explained = np.zeros((number * branches, len(z)))
        out = (self._left, ways, rows, counts, logs, made, explained, tallies)

        def part(first: int, last: int) -> None:
            step_hypotheses(*begin, *maps, *way, *how, first, last, *out)

        self._in_threads(part, number)
        children = np.flatnonzero(np.arange(branches) < made[:, None])
        weights = particles.log_weights[children // branches] + logs[children]
        weights = np.where(np.isnan(weights), -np.inf, weights)
        if not np.isfinite(weights.max(initial=-np.inf)):
            self.recovered += 1
            children, weights = np.arange(number) * branches, np.zeros(number)
        parents = particles.survive(children, weights, branches, float(self.rng.random()))
        self._left, self._foreseen = self._left[parents], self._foreseen[parents]
        return explained[particles.slots], tallies[parents], ways[parents]

    def _in_threads(self, part: Callable[[int, int], None], number: int) -> None:
        threads = min(self.config.threads or os.cpu_count() or 1, max(number // (_PARALLEL // 2), 1))
        if threads == 1:
            part(0, number)
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(threads)
        edges = np.linspace(0, number, threads + 1).astype(int)
        list(self._pool.map(part, edges[:-1].tolist(), edges[1:].tolist()))

    def _learn_rates(self, explained: np.ndarray, tallies: np.ndarray) -> None:
        if self.config.estimate:
            weights = self._particles.weights
            could, were = np.einsum("n,nkr->kr", weights, tallies)
            self.rates.take(could, were, float(weights @ (1.0 - explained).sum(axis=1)))

    def _resample(self) -> None:
        """Let the heavy particles go on alone, if too few count."""
        particles = self._particles
        if particles.effective < self.config.resample * len(particles):
            parents = particles.resample(float(self.rng.random()))
            self._left = self._left[parents]
            self._best = int(np.flatnonzero(parents == self._best)[0])  # the heaviest has a child at least
            self.resampled += 1


def _beams(frame: Sightings) -> np.ndarray:
    """(B, 2) bearing and range of the sweep that the frame was found in; a beam without return is far."""
    if frame.scan is None:
        return _NO_BEAMS
    return np.ascontiguousarray(np.stack([frame.scan.bearings, frame.scan.ranges], axis=1))


def _noise(frame: Sightings, extent: float) -> np.ndarray:
    """(4,) root of the mean noise that the frame states, -1 where it states none; and the landmarks' extent."""
    if frame.covariance is None or not len(frame.covariance):
        return np.array([-1.0, -1.0, -1.0, extent])
    root = np.zeros((2, 2))
    square_root(frame.covariance.mean(axis=0), 2, root)
    return np.array([root[0, 0], root[1, 0], root[1, 1], extent])
