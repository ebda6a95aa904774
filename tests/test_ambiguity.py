"""Sightings that could be either of two landmarks: against the joint likelihoods of the whole frame."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Djnn, Expected, Likelihood, Nearest
from kalmap.association.ambiguity import ambiguous
from kalmap.association.gated import Table
from kalmap.geometry.angles import wrap
from kalmap.geometry.ellipses import chi_square_2
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import SPURIOUS, Odometry, Reason, Sightings
from kalmap.slam import LandmarkSlam
from slam_problems import circle_events, feed, random_covariance, state_of

GATE = chi_square_2(0.99)


class Problem:
    """A frame whose expected sightings hang together by a common error of the robot's."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.m, self.c = int(rng.integers(1, 6)), int(rng.integers(1, 7))
        expected = np.c_[rng.uniform(9, 11, self.c), rng.uniform(-0.1, 0.1, self.c)]
        scale = np.tile([1.0, 0.1], self.c)
        common = np.kron(np.ones((self.c, self.c)), random_covariance(rng, 2, 0.4))
        self.p = (common + random_covariance(rng, 2 * self.c, 0.2)) * np.outer(scale, scale)
        self.noises = np.tile(np.diag([0.01, 1e-4]), (self.m, 1, 1))
        self.z = expected[rng.integers(0, self.c, self.m)] + rng.normal(0, [0.2, 0.02], (self.m, 2))
        blocks = self.p.reshape(self.c, 2, self.c, 2).swapaxes(1, 2)
        spreads = blocks[np.arange(self.c), np.arange(self.c)]
        self.expected = Expected(np.arange(self.c), expected, np.zeros((self.c, 2, 5)), spreads)
        self.extra = rng.exponential(0.5, (self.m, self.c)) * (rng.random() < 0.5)
        squared, normalised = np.empty((self.m, self.c)), np.empty((self.m, self.c))
        for m, c in np.ndindex(self.m, self.c):
            squared[m, c], total = self.cost([m], [c])
            normalised[m, c] = total
        trial = rng.random(self.c) < 0.2
        self.table = Table(
            Sightings(0.0, self.z), self.expected, trial, squared + self.extra, normalised + self.extra,
            self.extra, self.noises, GATE, GATE, np.ones(self.c, bool),
        )  # fmt: skip
        self.columns = np.full(self.m, -1)
        free = [c for c in rng.permutation(self.c).tolist() if not trial[c]]
        for m, c in zip(rng.permutation(self.m).tolist(), free, strict=False):
            self.columns[m] = c if rng.random() < 0.8 else -1

    def cross(self, expected):
        blocks = self.p.reshape(self.c, 2, self.c, 2).swapaxes(1, 2)
        return blocks[np.ix_(expected.indices, expected.indices)].copy()

    def cost(self, rows, columns) -> tuple[float, float]:
        """(squared, squared + ln det) of these pairs together, by one dense matrix."""
        entries = np.concatenate([[2 * c, 2 * c + 1] for c in columns]).astype(int)
        s = self.p[np.ix_(entries, entries)].copy()
        for k, m in enumerate(rows):
            s[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self.noises[m]
        nu = self.z[rows] - self.expected.z[columns]
        nu[:, 1] = wrap(nu[:, 1])
        squared = float(nu.ravel() @ np.linalg.solve(s, nu.ravel()))
        return squared, squared + float(np.linalg.slogdet(s)[1])


def test_doubt_is_a_ratio_of_joint_likelihoods():
    """Oracle: twice the log of the joint likelihood of the whole frame, the one match exchanged for every free
    landmark inside the gate, on 300 random frames: both answers occur often."""
    told = []
    for seed in range(300):
        problem = Problem(seed)
        margin = 3.0
        got = ambiguous(problem, problem.table, problem.columns, margin)
        matched = np.flatnonzero(problem.columns >= 0).tolist()
        for m in range(problem.m):
            taken = set(problem.columns[matched].tolist()) | set(np.flatnonzero(problem.table.trial).tolist())
            rivals = [c for c in range(problem.c) if problem.table.squared[m, c] <= GATE and c not in taken]
            if m not in matched or not rivals:
                assert not got[m]
                continue
            own = problem.cost(matched, problem.columns[matched].tolist())[1]
            own += problem.extra[m, problem.columns[m]]
            gaps = []
            for rival in rivals:
                columns = [rival if k == m else problem.columns[k] for k in matched]
                gaps.append(problem.cost(matched, columns)[1] + problem.extra[m, rival] - own)
            assert abs(min(gaps) - margin) > 1e-9 and got[m] == (min(gaps) < margin)
            told.append(bool(got[m]))
    assert 40 < sum(told) < len(told) - 40


def test_no_sighting_and_no_landmark():
    """Oracle: by hand: nothing is in doubt."""
    problem = Problem(0)
    nothing = np.full(problem.m, -1)
    assert not ambiguous(problem, problem.table, nothing, 1e9).any()


@pytest.mark.parametrize("method", [Nearest, Likelihood, Djnn])
def test_a_sighting_between_two_landmarks_is_left_unused(method):
    """Oracle: by hand: half-way between two it is used without the margin, and unused with it, with the reason; near
    one of them it is used; a second sighting that shows the frame's common error decides."""
    for margin, expected in ((0.0, [0]), (4.6, [SPURIOUS])):
        slam = LandmarkSlam(
            VelocitySteering(sigma_speed=0.1),
            RangeBearing(sigma_range=0.3),
            association=method(ambiguity=margin, management=Likelihood().management),
        )
        slam.explain = True
        slam.step(Odometry(0.0, np.array([[0.0, 0.0]]), np.array([0.1])))
        slam.step(Sightings(0.0, np.array([[10.0, 0.0], [11.0, 0.0]])))
        slam.step(Sightings(0.0, np.array([[10.45, 0.0]])))
        assert slam.frame_association.matched.tolist() == expected
        reason = slam.frame_decision.why.reasons[0]
        assert (reason == Reason.AMBIGUOUS) == (margin > 0.0)
        slam.step(Sightings(0.0, np.array([[9.8, 0.0]])))
        assert slam.frame_association.matched.tolist() == [0]


def test_an_easy_drive_has_no_doubts():
    """Oracle: the same drive without the margin: landmarks far apart, the same filter bit for bit."""
    events = circle_events(8, frames=30)
    plain, careful = (feed(LandmarkSlam(association=Likelihood(ambiguity=a)), events) for a in (0.0, 4.6))
    assert state_of(plain)[:6] == state_of(careful)[:6]
