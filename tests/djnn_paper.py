"""Dynamic joint nearest neighbour as the paper tells it, in plain Python: the slow twin of the kernels.

Written from Zhou, Zhao & Zhang 2010, section 3, with dicts and sets, not from the kernels.
"""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from slam_problems import random_covariance

FREE = -1


class Problem:
    """A frame against its candidates, with random noises, and the distances by solving linear equations."""

    def __init__(self, z, expected, noises=None, spreads=None, extra=None, usable=None, inside=None) -> None:
        self.z, self.expected = np.array(z, float).reshape(-1, 2), np.array(expected, float).reshape(-1, 2)
        m, c = self.shape = len(self.z), len(self.expected)
        half = 0.5 * np.eye(2)  # noise and spread together the unit matrix, unless they are given
        self.noises = np.tile(half, (m, 1, 1)) if noises is None else noises
        self.spreads = np.tile(half, (c, 1, 1)) if spreads is None else spreads
        self.extra = np.zeros(self.shape) if extra is None else extra
        self.usable = np.ones(c, bool) if usable is None else usable
        self.inside = self.usable if inside is None else inside

    def distance(self, m: int, c: int, offset=(0.0, 0.0)) -> tuple[float, float]:
        """(squared, normalised) of one pair once an offset is taken off the sighting."""
        nu, s = self.innovation(m, c) - offset, self.noises[m] + self.spreads[c]
        nu[1] = (nu[1] + math.pi) % (2 * math.pi) - math.pi
        squared = float(nu @ np.linalg.solve(s, nu)) + self.extra[m, c]
        return squared, squared + float(np.log(np.linalg.det(s)))

    def innovation(self, m: int, c: int) -> np.ndarray:
        nu = self.z[m] - self.expected[c]
        return np.array([nu[0], (nu[1] + math.pi) % (2 * math.pi) - math.pi])

    def tables(self, offset=(0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
        pairs = [[self.distance(m, c, offset) for c in range(self.shape[1])] for m in range(self.shape[0])]
        both = np.array(pairs, float).reshape(*self.shape, 2)
        return both[..., 0].copy(), both[..., 1].copy()


def random_problem(rng: np.random.Generator) -> Problem:
    """Close quarters, so that sightings contest; the whole frame is displaced now and then."""
    m, c = int(rng.integers(0, 8)), int(rng.integers(0, 8))
    expected = np.c_[rng.uniform(8, 12, c), rng.uniform(-0.4, 0.4, c) + rng.choice([0.0, math.pi])]
    z = np.c_[rng.uniform(8, 12, m), rng.uniform(-0.4, 0.4, m)]
    if c and m and rng.random() < 0.6:
        z = expected[rng.integers(0, c, m)] + rng.normal(0, [0.4, 0.04], (m, 2))
    z += rng.choice([0.0, 0.5, 2.5, 6.0]) * np.array([1.0, 0.05])
    scale = np.diag([1.0, 0.1])
    usable = rng.random(c) < 0.85
    return Problem(
        z,
        expected,
        np.array([scale @ (random_covariance(rng, 2, 0.5) + 0.05 * np.eye(2)) @ scale for _ in range(m)])
        .reshape(-1, 2, 2),
        np.array([scale @ (random_covariance(rng, 2, 0.5) + 0.05 * np.eye(2)) @ scale for _ in range(c)])
        .reshape(-1, 2, 2),
        rng.exponential(1.0, (m, c)) * (rng.random() < 0.3),
        usable,
        usable & (rng.random(c) < 0.8),
    )  # fmt: skip


class Paper:
    """DJNN within a frame as the paper tells it. `taken_off[m]` is what was taken off a sighting so far."""

    def __init__(self, problem: Problem, gate: float) -> None:
        self.p, self.gate = problem, gate
        self.taken_off = {m: np.zeros(2) for m in range(problem.shape[0])}
        self.h: dict[int, int] = {}
        self.case = 1

    def distance(self, m: int, c: int) -> tuple[float, float]:
        return self.p.distance(m, c, self.taken_off[m])

    def nn(self, sightings, features) -> None:
        for m in sightings:
            self.h.pop(m, None)
            inside = [(self.distance(m, c)[1], c) for c in features if self.distance(m, c)[0] <= self.gate]
            if inside:
                self.h[m] = min(inside)[1]

    def features(self) -> set[int]:
        return set(np.flatnonzero(self.p.usable).tolist())

    def claims(self) -> dict[int, list[int]]:
        found = defaultdict(list)
        for m, c in self.h.items():
            found[c].append(m)
        return found

    def nearest_of(self, c: int, sightings) -> int:
        return min(sightings, key=lambda m: self.distance(m, c)[1])

    def until_clean(self) -> None:
        while contested := {c: ms for c, ms in self.claims().items() if len(ms) > 1}:
            losers = [m for c, ms in contested.items() for m in ms if m != self.nearest_of(c, ms)]
            self.nn(losers, self.features() - set(self.h.values()))

    def offset(self, sightings) -> np.ndarray:
        moved = [self.p.innovation(m, self.h[m]) - self.taken_off[m] for m in sightings]
        return np.mean(moved, axis=0)

    def cases_1_to_3(self) -> np.ndarray:
        claims = self.claims()
        good = [ms[0] for ms in claims.values() if len(ms) == 1]
        bad = [m for ms in claims.values() if len(ms) > 1 for m in ms]
        if not bad:
            return np.zeros(2)
        self.case = 2 if good else 3
        chosen = good or [self.nearest_of(c, ms) for c, ms in claims.items()]
        offset = self.offset(chosen)
        for m in bad if good else self.taken_off:
            self.taken_off[m] = self.taken_off[m] + offset
        if not good:
            self.nn(self.taken_off, self.features())
        self.until_clean()
        return offset

    def decide(self, widen: float, clear: bool = True) -> np.ndarray:
        self.nn(self.taken_off, self.features())
        if self.h:
            return self.cases_1_to_3() if clear else np.zeros(2)
        self.case = 4
        pairs = [
            (self.distance(m, c)[0], m, c) for m in self.taken_off for c in np.flatnonzero(self.p.inside)
        ]
        if not pairs or widen == 0.0 or min(pairs)[0] > widen * self.gate:
            return np.zeros(2)
        _, m, c = min(pairs)
        offset = self.p.innovation(m, c)
        for each in self.taken_off:
            self.taken_off[each] = offset.copy()
        self.nn(self.taken_off, self.features())
        further = self.cases_1_to_3() if clear else np.zeros(2)
        self.case = 4
        return offset + further

    def answer(self) -> list[int]:
        return [self.h.get(m, FREE) for m in range(self.p.shape[0])]
