"""The finite-set filter as a whole: what it does with odd frames, and what its particles keep."""

import numpy as np
import pytest

from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import FiniteSetConfig, Odometry, Sightings
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.particles import Particles, _chosen
from kalmap.slam.set_map import features
from kalmap.slam.set_rules import RINGS, rates_from_config

METHODS = ("rb-phd", "srckf-phd", "pmb", "mh-fastslam")
PLACES = np.array([[8.0, 4.0], [12.0, -5.0], [15.0, 3.0]])


def frame(time, values):
    return Sightings(time=time, values=np.asarray(values, dtype=float).reshape(-1, 2))


def sightings_of(places):
    return np.column_stack([np.hypot(*places.T), np.arctan2(places[:, 1], places[:, 0])])


def make(method, seed=1, **settings):
    config = FiniteSetConfig(method=method, **{"particles": 4, "threads": 1, **settings})
    slam = FiniteSetSlam(VelocitySteering(), RangeBearing(max_range=30.0), config, seed=seed)
    slam.step(Odometry(time=-1.0, values=np.zeros((1, 2)), durations=np.array([0.1])))
    return slam


def finite(slam):
    estimate = slam.estimate()
    parts = (slam.pose, slam.pose_covariance, estimate.landmarks.positions, estimate.landmarks.covariances)
    return all(np.isfinite(part).all() for part in parts) and np.isclose(slam._particles.weights.sum(), 1.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("particles", [1, 5])
@pytest.mark.parametrize("settings", [{}, {"detection": 0.0}, {"detection": 1.0}, {"clutter": 0.0}])
def test_no_frame_breaks_it(method, particles, settings):
    rng = np.random.default_rng(3)
    slam = make(method, particles=particles, estimate=False, **settings)
    for k in range(30):
        real = sightings_of(PLACES + 0.05 * rng.normal(size=PLACES.shape))
        false = np.column_stack([rng.uniform(0, 30, 12), rng.uniform(-1.5, 1.5, 12)])
        slam.step(frame(float(k), [real, np.zeros((0, 2)), false][k % 3]))
    assert finite(slam)


@pytest.mark.parametrize("method", METHODS)
def test_a_thousand_sightings_in_a_frame(method):
    rng = np.random.default_rng(4)
    slam = make(method, particles=2)
    for k in range(2):
        slam.step(frame(float(k), np.column_stack([rng.uniform(0, 30, 1000), rng.uniform(-1.5, 1.5, 1000)])))
    assert finite(slam)


@pytest.mark.parametrize("method", METHODS)
def test_features_that_stand_still_are_found(method):
    rng = np.random.default_rng(5)
    slam = make(method)
    for k in range(20):
        slam.step(frame(float(k), sightings_of(PLACES) + [0.1, 0.01] * rng.normal(size=(3, 2))))
    found = slam.estimate().landmarks.positions
    assert len(found) == 3
    for place in PLACES:
        assert np.hypot(*(found - place).T).min() < 0.3


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_the_answer(method):
    poses = []
    for threads in (1, 2):
        slam, rng = make(method, particles=9, threads=threads), np.random.default_rng(6)
        for k in range(10):
            slam.step(Odometry(time=k + 0.5, values=np.array([[1.0, 0.1]]), durations=np.array([0.1])))
            slam.step(frame(k + 1.0, sightings_of(PLACES) + [0.1, 0.01] * rng.normal(size=(3, 2))))
        poses.append(slam._particles.poses)
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize("method", METHODS)
def test_lost_weights_are_recovered_and_counted(method, monkeypatch):
    slam = make(method)
    slam.step(frame(0.0, sightings_of(PLACES)))
    slam._particles.log_weights[:] = -np.inf
    slam.step(frame(1.0, sightings_of(PLACES)))
    assert slam.recovered == 1
    assert finite(slam)


def test_a_known_feature_of_a_density_outlives_one_miss():
    rows = np.zeros((4, 8))
    rows[:, 0], rows[:, 7] = [0.9, 0.05, 0.05, 0.004], [1.0, 5.0, 1.0, 5.0]
    rows[:, 6] = np.arange(4)
    np.testing.assert_array_equal(features(rows, 0.6, 0.006), [0, 1])
    np.testing.assert_array_equal(features(rows, 0.6, 0.6), [0])


def test_detection_falls_straight_with_range():
    rates = rates_from_config(FiniteSetConfig(detection=0.8, detection_far=0.0))
    np.testing.assert_allclose(rates.profile, 0.8 * (1.0 - (np.arange(RINGS) + 0.5) / RINGS))


def test_choice_of_children_keeps_the_heavy_and_every_expected_weight():
    weights = np.array([0.5, 0.3, 0.1, 0.06, 0.04])
    total, draws = np.zeros(5), 2000
    for k in range(draws):
        chosen, kept = _chosen(weights, 3, (k + 0.5) / draws)
        assert len(chosen) == 3 and len(set(chosen.tolist())) == 3
        assert {0, 1} <= set(chosen.tolist())
        total[chosen] += kept
    np.testing.assert_allclose(total / draws, weights, atol=1e-3)


def test_children_take_the_place_of_their_parents():
    particles = Particles(np.arange(6.0).reshape(2, 3), np.zeros((2, 0)), 100)
    rows, counts = particles.room_for_children(2, 5)
    rows[3, 0, 0], counts[3] = 0.7, 1
    parents = particles.survive(np.array([0, 2, 3]), np.log([0.1, 1e-9, 0.9]), 2, 0.5)
    assert sorted(parents.tolist()) == [0, 1]
    best = int(np.argmax(particles.log_weights))
    np.testing.assert_array_equal(particles.poses[best], [3.0, 4.0, 5.0])
    assert particles.map_of(best)[0, 0] == 0.7


def test_the_best_particle_is_the_heaviest_also_after_resampling():
    """Oracle: the weights before: whichever child comes first, it has the heaviest one's pose and map."""
    slam = make("pmb")
    for number in range(3):
        slam.step(frame(float(number), sightings_of(PLACES)))
    particles = slam._particles
    weights = np.linspace(0.1, 0.2, len(particles))
    weights[-1] = 3.0
    particles.log_weights = np.log(weights / weights.sum())
    slam._say()
    pose, rows = particles.poses[slam.best].copy(), slam.map()
    assert slam.best == len(particles) - 1
    parents = particles.resample(0.5)
    slam._best = int(np.flatnonzero(parents == slam._best)[0])
    np.testing.assert_array_equal(particles.poses[slam.best], pose)
    np.testing.assert_array_equal(slam.map(), rows)
