"""The invariant transport against a direct right-invariant EKF, and consistency (NEES) over fixed seeds."""

from __future__ import annotations

import os

import msgspec
import numpy as np
import pytest

from kalmap.evaluation import mean_nees, pose_nees
from kalmap.gaussian import Jacobian
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import FilterConfig, Odometry, RunConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, run, slam_from_config
from slam_problems import circle_events

J = np.array([[0.0, -1.0], [1.0, 0.0]])


def rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def turn_integral(angle: float) -> np.ndarray:
    """V(angle), the position part of the exponential, by its power series (no special case at zero)."""
    total, term = np.zeros((2, 2)), np.eye(2)
    for k in range(1, 30):
        total += term
        term = term @ (angle * J) / (k + 1)
    return total


class DirectInvariantEkf:
    """Right-invariant EKF SLAM on SE_K(2), Barrau & Bonnabel's way, written down directly.

    x = (heading; position and landmarks), x_true = exp(xi) x with the twist about the map's origin, P the
    covariance of xi = (theta, robot, landmark 1, ...). Propagation is the identity plus noise through
    the adjoint.
    """

    def __init__(self, wheelbase, control_noise, sight_noise, pose, covariance):
        self.base, self.q, self.r = wheelbase, control_noise, sight_noise
        self.theta, self.points, self.ids = pose[2], pose[None, :2].copy(), []
        change = np.eye(3)[[2, 0, 1]]
        self.p = change @ covariance @ change.T
        turn = np.eye(3)
        turn[1:, 0] = -J @ pose[:2]
        self.p = turn @ self.p @ turn.T

    def predict(self, event):
        for (v, g), dt in zip(event.values, event.durations, strict=True):
            r = rotation(self.theta)
            step = dt * v * np.array([np.cos(g), np.sin(g)])
            jac = dt * np.array([[np.cos(g), -v * np.sin(g)], [np.sin(g), v * np.cos(g)]])
            turn = dt / self.base * np.array([np.sin(g), v * np.cos(g)])
            self.points[0] += r @ step
            self.theta += dt * v * np.sin(g) / self.base
            noise = np.zeros((len(self.p), 2))  # the adjoint of the robot's state carries the body noise out
            noise[0] = turn
            for k, point in enumerate(self.points):
                noise[1 + 2 * k : 3 + 2 * k] = -np.outer(J @ point, turn)
            noise[1:3] += r @ jac
            self.p = self.p + noise @ self.q @ noise.T

    def observe(self, event):
        old = [m for m, i in enumerate(event.ids.tolist()) if i in self.ids]
        new = [m for m, i in enumerate(event.ids.tolist()) if i not in self.ids]
        if old:
            self.update(event.values[old], [1 + self.ids.index(i) for i in event.ids[old].tolist()])
        for m in new:
            self.append(event.values[m], int(event.ids[m]))

    def update(self, z, which):
        n, r = len(self.p), rotation(self.theta)
        h, nu = np.zeros((2 * len(z), n)), np.zeros(2 * len(z))
        for m, k in enumerate(which):
            body = r.T @ (self.points[k] - self.points[0])
            rho = np.hypot(*body)
            gradient = np.array([body / rho, [-body[1] / rho**2, body[0] / rho**2]])
            h[2 * m : 2 * m + 2, 1:3] = -gradient @ r.T  # no heading column: H does not depend on xi_theta
            h[2 * m : 2 * m + 2, 1 + 2 * k : 3 + 2 * k] = gradient @ r.T
            bearing = z[m, 1] - np.arctan2(body[1], body[0])
            nu[2 * m : 2 * m + 2] = z[m, 0] - rho, (bearing + np.pi) % (2 * np.pi) - np.pi
        gain = self.p @ h.T @ np.linalg.inv(h @ self.p @ h.T + np.kron(np.eye(len(z)), self.r))
        xi = gain @ nu
        self.points = self.points @ rotation(xi[0]).T + xi[1:].reshape(-1, 2) @ turn_integral(xi[0]).T
        self.theta += xi[0]
        left = np.eye(n) - gain @ h
        self.p = left @ self.p @ left.T + gain @ np.kron(np.eye(len(z)), self.r) @ gain.T

    def append(self, z, number):
        n, angle = len(self.p), self.theta + z[1]
        ray = np.array([np.cos(angle), np.sin(angle)])
        grow = np.vstack([np.eye(n), np.eye(2, n, 1)])  # the new landmark inherits the robot's xi_p
        jac = np.column_stack([ray, z[0] * J @ ray])
        self.p = grow @ self.p @ grow.T
        self.p[n:, n:] += jac @ self.r @ jac.T
        self.points = np.vstack([self.points, self.points[0] + z[0] * ray])
        self.ids.append(number)

    def additive(self):
        """Mean and covariance in kalmap's order (x, y, heading, landmarks) and additive coordinates:
        M P M'."""
        n = len(self.p)
        m = np.zeros((n, n))
        rows = [0, 1, *range(3, n)]
        m[2, 0] = 1.0
        m[rows, 0] = (self.points @ J.T).ravel()
        m[rows, np.arange(1, n)] = 1.0
        theta = (self.theta + np.pi) % (2 * np.pi) - np.pi
        return np.concatenate([self.points[0], [theta], self.points[1:].ravel()]), m @ self.p @ m.T


@pytest.mark.parametrize("known_start", [True, False])
def test_transport_equals_a_direct_right_invariant_ekf(known_start):
    """Oracle: the class above, over 300 events (600 control samples), at the end and on the way, to 1e-8."""
    cov = (
        np.zeros((3, 3)) if known_start else np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.01], [0.0, 0.01, 0.02]])
    )
    start, motion, sensor = np.array([2.0, -1.0, 0.4]), VelocitySteering(), RangeBearing()
    q = np.diag([motion.sigma_speed**2, motion.sigma_steering**2])
    r = np.diag([sensor.sigma_range**2, sensor.sigma_bearing**2])
    direct = DirectInvariantEkf(motion.wheelbase, q, r, start, cov)
    slam = LandmarkSlam(
        motion, sensor, Jacobian(), coordinates="invariant", start=start, start_covariance=cov
    )
    for number, event in enumerate(circle_events(seed=3, frames=150)):
        slam.step(event)
        (direct.predict if isinstance(event, Odometry) else direct.observe)(event)
        if number % 50 == 49:
            mean, covariance = slam.estimate().joint()
            expected_mean, expected = direct.additive()
            np.testing.assert_allclose(mean, expected_mean, atol=1e-8)
            np.testing.assert_allclose(covariance, expected, atol=1e-8)
    assert slam.landmark_count == 12 and number == 299


def nees_of(name: str, coordinates: str, seeds: range, laps: int, **changes: float) -> float:
    """Mean pose NEES at the frames, over the seeds, in the filter's own coordinates."""
    world, values = msgspec.structs.replace(world_by_name("course-35"), laps=laps, **changes), []
    for seed in seeds:
        log = simulate(world, seed)
        chosen = FilterConfig(name=name, coordinates=coordinates)
        config = RunConfig(motion=log.defaults.motion, sensor=log.defaults.sensor, filter=chosen)
        outcome = run(slam_from_config(config, log), log, reckon=False)
        assert outcome.error is None
        truth, trace = log.references[0], outcome.trace
        rows = np.rint(trace.times / world.dt).astype(int)
        true = np.column_stack([truth.positions[rows], truth.headings[rows]])
        values.append(mean_nees(pose_nees(true, trace.poses, trace.covariances, coordinates)))
    return float(np.mean(values))


@pytest.mark.parametrize("name", ["ekf", "cr-ukf", "cr-cdkf", "cr-ckf"])
def test_invariant_nees_is_in_its_band(name):
    """Oracle: chi-square theory: 3 is right. Ten fixed seeds, one lap: errors within a run are strongly
    correlated, so the band for the mean over frames and seeds is wide: 2 to 4."""
    assert 2.0 < nees_of(name, "invariant", range(1, 11), 1) < 4.0


def test_additive_ekf_is_the_overconfident_one():
    """Oracle: Huang, Mourikis & Roumeliotis 2010: the standard EKF gains false heading information.
    Twice the noise."""
    hard = {"sigma_speed": 0.6, "sigma_steering_deg": 6.0}
    additive, invariant = (nees_of("ekf", c, range(1, 7), 2, **hard) for c in ("additive", "invariant"))
    assert additive > 1.5 * invariant


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "cr-ukf", "cr-cdkf", "cr-ckf"])
def test_invariant_nees_over_many_seeds(name):
    """Oracle: as above, two laps, KALMAP_SLOW_SEEDS seeds (default 20)."""
    seeds = int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))
    assert 1.8 < nees_of(name, "invariant", range(1, seeds + 1), 2) < 4.5
