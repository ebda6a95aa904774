"""What LandmarkSlam refuses, and that a refusal leaves the filter as it was,
memory of the associator included."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Djnn, Jcbb, Likelihood, Nearest, Trial
from kalmap.models import Increments, VelocitySteering
from kalmap.records import EstimationError, EventError, Fix, Odometry, Scan, Sightings
from kalmap.slam import LandmarkSlam
from slam_problems import LINEARISERS, XYSensor, circle_events, feed, state_of

EVENTS = circle_events(2, frames=12)


def move(time=9.0, values=((1.0, 0.1),), durations=(0.1,), covariance=None):
    return Odometry(time, np.array(values, dtype=float), np.array(durations), covariance)


def sight(time=9.0, z=((5.0, 0.1),), ids=(0,), covariance=None):
    return Sightings(time, np.array(z, dtype=float), np.array(ids), covariance)


NAN, INF = float("nan"), float("inf")
REFUSED = {
    "late odometry": (move(time=1.0), "time"),
    "late frame": (sight(time=1.0), "time"),
    "time nan": (move(time=NAN), "time"),
    "time inf": (sight(time=INF), "time"),
    "odometry nan": (move(values=((NAN, 0.1),)), "values"),
    "odometry inf": (move(values=((INF, 0.1),)), "values"),
    "odometry both infinities": (move(values=((INF, 0.1), (-INF, 0.1)), durations=(0.1, 0.1)), "values"),
    "duration negative": (move(durations=(-0.1,)), "values"),
    "duration nan": (move(durations=(NAN,)), "values"),
    "odometry too narrow": (move(values=((1.0,),)), "values"),
    "odometry too wide": (move(values=((1.0, 0.1, 0.2),)), "values"),
    "odometry too short": (move(durations=(0.1, 0.1)), "values"),
    "odometry covariance of another length": (
        move(values=((1.0, 0.1),) * 2, durations=(0.1, 0.1), covariance=np.eye(2)[None]),
        "covariance",
    ),
    "range negative": (sight(z=((-1.0, 0.0),)), "range"),
    "range nan": (sight(z=((NAN, 0.0),)), "range"),
    "range inf": (sight(z=((INF, 0.0),)), "range"),
    "bearing nan": (sight(z=((5.0, NAN),)), "bearing"),
    "second of two bad": (sight(z=((5.0, 0.0), (5.0, INF)), ids=(0, 1)), "bearing"),
    "sighting too wide": (sight(z=((5.0, 0.0, 1.0),)), "values"),
    "sighting covariance of another length": (
        sight(z=((5.0, 0.0),) * 2, ids=(0, 1), covariance=np.eye(2)[None]),
        "covariance",
    ),
    "id below -1": (sight(ids=(-2,)), "ids"),
    "scan without detector": (Scan(9.0, np.ones(3), np.zeros(3)), None),
    "no event": (type("Tick", (), {"time": 9.0})(), None),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_events_are_refused_and_leave_the_state(case):
    """Oracle: EventError with time and field; the state before, bit for bit,
    and the future of a twin without it."""
    event, field = REFUSED[case]
    slam, twin = (feed(LandmarkSlam(), EVENTS[:8]) for _ in range(2))
    before = state_of(slam)
    with pytest.raises(EventError) as caught:
        slam.step(event)
    if field is not None:
        assert caught.value.field == field
    assert state_of(slam) == before
    assert state_of(feed(slam, EVENTS[8:])) == state_of(feed(twin, EVENTS[8:]))


def test_a_sighting_before_any_odometry_is_refused():
    """Oracle: EventError; the same filter runs on as if nothing had come."""
    slam = LandmarkSlam()
    with pytest.raises(EventError, match="before any odometry"):
        slam.step(sight(time=0.1))
    assert state_of(feed(slam, EVENTS)) == state_of(feed(LandmarkSlam(), EVENTS))


NO_COVARIANCE = {
    "negative": -np.eye(2),
    "indefinite": np.array([[1.0, 2.0], [2.0, 1.0]]),
    "nan": np.full((2, 2), np.nan),
}


@pytest.mark.parametrize("name", ["jacobian", "central"])
@pytest.mark.parametrize("kind", NO_COVARIANCE)
@pytest.mark.parametrize("what", ["odometry", "seen", "new", "seen and new", "good and new"])
@pytest.mark.parametrize("use", ["joint", "sequential"])
def test_noise_that_is_no_covariance(name, kind, what, use):
    """Oracle: an error with a name (EventError or EstimationError), the state as before,
    and a twin's future."""
    slam, twin = (feed(LandmarkSlam(lineariser=LINEARISERS[name], use=use), EVENTS[:8]) for _ in range(2))
    before, noise, known = state_of(slam), 1e4 * NO_COVARIANCE[kind][None], EVENTS[7].ids
    z = np.array([[5.0, 0.3]])
    event = {
        "odometry": move(time=slam.time, covariance=noise),
        "seen": Sightings(slam.time, EVENTS[7].values[:1], known[:1], noise),
        "new": Sightings(slam.time, z, np.array([99]), noise),
        "seen and new": Sightings(
            slam.time,
            np.vstack([EVENTS[7].values[:2], z]),
            np.append(known[:2], 99),
            np.vstack([[np.eye(2)], noise, noise]),
        ),
        "good and new": Sightings(
            slam.time,
            np.vstack([EVENTS[7].values[:1], z]),
            np.append(known[:1], 99),
            np.vstack([[np.eye(2)], noise]),
        ),
    }[what]
    with pytest.raises((EventError, EstimationError)):
        slam.step(event)
    assert state_of(slam) == before
    assert state_of(feed(slam, EVENTS[8:])) == state_of(feed(twin, EVENTS[8:]))


def test_a_failed_first_frame_leaves_the_associators_memory():
    """Oracle: a twin that never got the frame, whose very first landmark had an impossible noise."""
    slam, twin = (
        feed(LandmarkSlam(association=Likelihood(management=Trial(2))), EVENTS[:1]) for _ in range(2)
    )
    with pytest.raises((EventError, EstimationError)):
        slam.step(Sightings(slam.time, np.array([[5.0, 0.3]]), None, np.full((1, 2, 2), np.nan)))
    assert state_of(slam) == state_of(twin)
    assert state_of(feed(slam, EVENTS[1:])) == state_of(feed(twin, EVENTS[1:]))


@pytest.mark.parametrize("association", [None, Likelihood(management=Trial(2)), Nearest(), Djnn(), Jcbb()])
def test_a_broken_belief_is_an_estimation_error(association):
    """Oracle: EstimationError naming the step, when the covariance itself is no longer one."""
    slam = feed(LandmarkSlam(association=association), EVENTS[:8])
    slam._belief.packed[0] = -1.0
    with pytest.raises(EstimationError, match="step 16"):
        feed(slam, EVENTS[8:10])


@pytest.mark.parametrize("name", ["jacobian", "central"])
def test_a_model_of_ones_own_that_gives_nan_is_an_estimation_error(name):
    """Oracle: EstimationError and the state as before: a number that is not finite is never carried on."""

    class Broken(VelocitySteering, frozen=True):
        compiled = False

        def increment(self, control, biases, dt):
            return super().increment(control, biases, dt) * (np.nan if np.any(control[..., 0] > 50) else 1.0)

    slam = feed(LandmarkSlam(Broken(), None, LINEARISERS[name]), EVENTS[:8])
    before = state_of(slam)
    with pytest.raises(EstimationError):
        slam.step(move(values=((99.0, 0.0),)))
    assert state_of(slam) == before


def test_fixes_and_empty_events_are_no_news():
    """Oracle: the same filter without them; only the clock moves."""
    slam = feed(LandmarkSlam(Increments(), XYSensor(np.eye(2))), [move(0.0, ((1.0, 0.0, 0.1),))])
    mean, covariance = slam.estimate().joint()
    slam.step(Fix(1.0, 5.0, 5.0))
    slam.step(Sightings(2.0, np.zeros((0, 2)), np.zeros(0, dtype=np.int64)))
    slam.step(Odometry(3.0, np.zeros((0, 3)), np.zeros(0)))
    assert slam.time == 3.0 and np.isnan(slam.frame_nis) and slam.frame_used == 0
    np.testing.assert_array_equal(slam.estimate().joint()[0], mean)
    np.testing.assert_array_equal(slam.estimate().joint()[1], covariance)
