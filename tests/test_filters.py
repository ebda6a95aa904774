"""One contract over all filters: a linear problem against textbook solutions,
and covariances that stay covariances."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalmap.models import Ackermann, Bias, Increments, RangeBearing, Unicycle
from kalmap.records import ConfigError, FilterConfig, Odometry, RunConfig, Sightings
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import FILTERS, LandmarkSlam, resolve_filter, slam_from_config
from slam_problems import LINEARISERS, XYSensor

HEADING = 0.3
NOISE = np.array([[0.010, 0.004], [0.004, 0.020]])
START = np.diag([0.05, 0.03, 0.0])
WORLD = np.array([[3.0, 1.0], [4.0, -1.5], [5.0, 0.5], [3.5, 2.5]])
DRIVE = msgspec.structs.replace(world_by_name("course-35"), laps=1)
KINDS = list(itertools.product(FILTERS, ["additive", "invariant"], ["joint", "sequential"]))


def rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def linear_log(seed: int = 0, frames: int = 8) -> list:
    """Odometry (2 samples) and frames; the heading is known, so that everything is linear."""
    rng, events, r = np.random.default_rng(seed), [], rotation(HEADING)
    p = np.zeros(2) + rng.multivariate_normal(np.zeros(2), START[:2, :2])
    for k in range(frames):
        u = rng.normal([0.1, 0.02], 0.02, (2, 2))
        q = np.array([[0.004, 0.001], [0.001, 0.002]]) * (1 + k % 3)
        p = p + r @ (u + rng.multivariate_normal(np.zeros(2), q, 2)).sum(axis=0)
        noise = np.zeros((2, 3, 3))
        noise[:, :2, :2] = q
        events.append(Odometry(k + 1.0, np.c_[u, np.zeros(2)], np.full(2, 0.5), noise))
        ids = np.array([i for i in range(4) if i <= k and (k + i) % 3], dtype=np.int64)
        z = (WORLD @ r.T - p)[ids] @ r + rng.multivariate_normal(np.zeros(2), NOISE, len(ids))
        events.append(Sightings(k + 1.0, z, ids))
    return events


def textbook(events: list) -> tuple[np.ndarray, np.ndarray]:
    """A dense Kalman filter on (position, landmarks in the order of founding), as in any textbook."""
    x, p, order, r = np.zeros(2), START[:2, :2].copy(), [], rotation(HEADING)
    for event in events:
        if isinstance(event, Odometry):
            for u, q in zip(event.values, event.covariance, strict=True):
                x[:2] += r @ u[:2]
                p[:2, :2] += r @ q[:2, :2] @ r.T
            continue
        for z, number in zip(event.values, event.ids.tolist(), strict=True):
            if number in order:
                i = 2 + 2 * order.index(number)
                h = np.zeros((2, len(x)))
                h[:, :2], h[:, i : i + 2] = -r.T, r.T
                gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + NOISE)
                x, p = x + gain @ (z - h @ x), (np.eye(len(x)) - gain @ h) @ p
        for z, number in zip(event.values, event.ids.tolist(), strict=True):
            if number not in order:
                f = np.vstack([np.eye(len(x)), np.eye(2, len(x))])
                x, p = np.append(x, x[:2] + r @ z), f @ p @ f.T
                p[-2:, -2:] += r @ NOISE @ r.T
                order.append(number)
    return x, p


def batch(events: list) -> tuple[np.ndarray, np.ndarray]:
    """Least squares over all positions and landmarks at once (information form),
    marginal of the last state."""
    steps = sum(len(e.values) for e in events if isinstance(e, Odometry))
    order = list(dict.fromkeys(i for e in events if isinstance(e, Sightings) for i in e.ids.tolist()))
    n, r = 2 * (steps + 1 + len(order)), rotation(HEADING)
    information, vector = np.zeros((n, n)), np.zeros(n)

    def add(blocks, value, covariance):
        h = np.zeros((2, n))
        for column, block in blocks:
            h[:, column : column + 2] = block
        weight = np.linalg.inv(covariance)
        information[:] += h.T @ weight @ h
        vector[:] += h.T @ weight @ value

    add([(0, np.eye(2))], np.zeros(2), START[:2, :2])
    t = 0
    for event in events:
        if isinstance(event, Odometry):
            for u, q in zip(event.values, event.covariance, strict=True):
                add([(2 * t, -np.eye(2)), (2 * t + 2, np.eye(2))], r @ u[:2], r @ q[:2, :2] @ r.T)
                t += 1
        else:
            for z, number in zip(event.values, event.ids.tolist(), strict=True):
                add([(2 * t, -r.T), (2 * (steps + 1 + order.index(number)), r.T)], z, NOISE)
    last = np.arange(2 * steps, n)
    covariance = np.linalg.inv(information)
    return (covariance @ vector)[last], covariance[np.ix_(last, last)]


@pytest.mark.parametrize(("name", "coordinates", "use"), KINDS)
def test_linear_gaussian_problem(name, coordinates, use):
    """Oracles: a textbook Kalman filter and the batch least-squares solution, to 1e-8.

    The sensor is a user's own (numeric Jacobian: the EKF's promise ends at 1e-6).
    """
    lineariser, scope = FILTERS[name]
    slam = LandmarkSlam(
        Increments(ratio_distance=0.0, sigma_rotation=0.0, ratio_rotation=0.0),
        XYSensor(NOISE),
        lineariser,
        scope=scope,
        coordinates=coordinates,
        use=use,
        start=(0.0, 0.0, HEADING),
        start_covariance=START,
    )
    events = linear_log()
    for event in events:
        slam.step(event)
    mean, covariance = slam.estimate().joint()
    keep = np.delete(np.arange(len(mean)), 2)
    tolerance = 1e-6 if name == "ekf" else 1e-8
    for expected_mean, expected_covariance in (textbook(events), batch(events)):
        np.testing.assert_allclose(mean[keep], expected_mean, atol=tolerance)
        np.testing.assert_allclose(covariance[np.ix_(keep, keep)], expected_covariance, atol=tolerance)
    assert mean[2] == HEADING
    np.testing.assert_allclose(covariance[2], 0.0, atol=1e-15)


def test_the_two_oracles_agree():
    """Oracle of the oracles: filtering and batch solution of a linear problem have the same final
    marginal."""
    events = linear_log(3)
    np.testing.assert_allclose(textbook(events)[0], batch(events)[0], atol=1e-10)
    np.testing.assert_allclose(textbook(events)[1], batch(events)[1], atol=1e-10)


blocks = st.tuples(
    st.just("move"), st.lists(st.tuples(st.floats(-2, 4), st.floats(-1, 1)), min_size=1, max_size=4)
)
seen = st.tuples(
    st.just("see"), st.lists(st.tuples(st.integers(0, 5), st.floats(0.3, 20), st.floats(-3, 3)), max_size=5)
)


@pytest.mark.parametrize("name", ["ekf", "cr-ukf", "cr-cdkf", "cr-ckf", "cdkf"])
@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
@given(story=st.lists(st.one_of(blocks, seen), min_size=2, max_size=14), start=st.booleans())
@settings(max_examples=12, deadline=None, derandomize=True)
def test_covariances_stay_covariances_whatever_comes(name, coordinates, story, start):
    """Oracle: numpy's eigenvalues after random blocks, frames, duplicates, repeats and empty frames."""
    lineariser, scope = FILTERS[name]
    slam = LandmarkSlam(
        Unicycle(sigma_turn_rate=0.3),
        RangeBearing(sigma_range=0.3, sigma_bearing=0.05),
        lineariser,
        scope=scope,
        coordinates=coordinates,
        start_covariance=np.diag([0.5, 0.2, 0.1]) if start else None,
    )
    slam.step(Odometry(0.0, np.array([[1.0, 0.1]]), np.array([0.1])))
    for time, (kind, rows) in enumerate(story):
        if kind == "move":
            slam.step(Odometry(float(time), np.array(rows), np.full(len(rows), 0.1)))
        else:
            ids = np.array([row[0] for row in rows], dtype=np.int64)
            slam.step(Sightings(float(time), np.array([row[1:] for row in rows]).reshape(-1, 2), ids))
        mean, covariance = slam.estimate().joint()
        assert np.isfinite(mean).all() and np.isfinite(covariance).all()
        assert -np.pi <= mean[2] < np.pi
        np.testing.assert_array_equal(covariance, covariance.T)
        values = np.linalg.eigvalsh(covariance)
        assert values[0] >= -1e-9 * values[-1]


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_every_named_filter_tracks_a_simulated_drive(name, coordinates):
    """Oracle: the simulator's truth: after 25 frames (10 if O(n^3)) the pose and every landmark are
    where they should be."""
    log = simulate(DRIVE, 2)
    config = RunConfig(
        motion=log.defaults.motion,
        sensor=log.defaults.sensor,
        filter=FilterConfig(name=name, coordinates=coordinates),
    )
    slam = slam_from_config(config, log)
    events = 20 if slam.scope == "full" else 50
    for event in itertools.islice(log, events):
        slam.step(event)
    truth, last = log.references[0], events // 2 * DRIVE.observe_every
    true = np.append(truth.positions[last], truth.headings[last])
    error = slam.pose - true
    assert truth.times[last] == pytest.approx(slam.time)
    assert np.hypot(*error[:2]) < 1.5 and abs(error[2]) < 0.06
    landmarks = slam.estimate().landmarks
    assert len(landmarks) >= 2
    off = np.linalg.norm(landmarks.positions - truth.landmarks[landmarks.ids], axis=1)
    assert off.max() < 4.0


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (FilterConfig(name="ekf", scope="full"), "draws no points"),
        (FilterConfig(name="cr-cdkf", scope="full"), "by name the reduced filter"),
        (FilterConfig(name="cr-ckf", scope="full"), "'ckf'"),
        (FilterConfig(name="cr-ukf", scope="full"), "'ukf'"),
        (FilterConfig(name="kf"), "kf"),
    ],
)
def test_refused_combinations_say_why(config, reason):
    """Oracle: ConfigError with the reason in words, also for a name that msgspec never checked."""
    with pytest.raises(ConfigError, match=reason):
        resolve_filter(config)


def test_named_filters_resolve():
    """Oracle: the names' own meaning."""
    assert resolve_filter(FilterConfig(name="cdkf", scope="reduced"))[1] == "reduced"
    for name in FILTERS:
        lineariser, scope = resolve_filter(FilterConfig(name=name))
        assert scope == ("reduced" if name == "ekf" or name.startswith("cr-") else "full")
        assert lineariser == FILTERS[name][0]


@pytest.mark.parametrize("name", LINEARISERS)
def test_a_known_start_at_any_heading(name):
    """Oracle: the same drive from heading 0, turned by the start's heading; a car with biases, known start, no jitter.

    At such a start the covariance has rank two and grows into six dimensions through tiny pivots. Sigma points lie
    along the axes, so that turning the drive is the same only up to the fourth order: a thousandth here.
    """
    rng = np.random.default_rng(7)
    biases = (Bias("steering_offset", 0.017), Bias("steering_scale", 0.05), Bias("speed_scale", 0.05))
    car = Ackermann(biases=biases, sigma_speed=0.3, sigma_steering=0.035, sample_time=0.025)
    controls = np.stack([rng.uniform(0, 3, (40, 60)), rng.uniform(-0.3, 0.3, (40, 60))], axis=2)
    for heading, drive in zip(rng.uniform(-3, 3, 40), controls, strict=True):
        turned, plain = (
            LandmarkSlam(car, RangeBearing(), LINEARISERS[name], start=(0.0, 0.0, at))
            for at in (heading, 0.0)
        )
        for t, control in enumerate(drive):
            for slam in (turned, plain):
                slam.step(Odometry(0.025 * (t + 1), control[None], np.full(1, 0.025)))
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        np.testing.assert_allclose(turned.pose[:2], turn[:2, :2] @ plain.pose[:2], atol=1e-3)
        expected = turn @ plain.pose_covariance @ turn.T
        np.testing.assert_allclose(turned.pose_covariance, expected, atol=1e-3 * np.abs(expected).max())
