"""Landmarks on trial are held: they stand in the state and correct nothing until they are believed in."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Counter, Djnn, Existence, Jcbb, Likelihood, Nearest, Trial
from kalmap.models import VelocitySteering
from kalmap.records import SPURIOUS, Odometry, Sightings
from kalmap.slam import LandmarkSlam, run
from slam_problems import LINEARISERS, STEERING_BIASES, circle_events, copy_belief, feed, log_of

METHODS = {
    "nearest": Nearest, "hungarian": lambda **k: Nearest(one_to_one=True, **k), "likelihood": Likelihood,
    "djnn": Djnn, "jcbb": Jcbb,
}  # fmt: skip
MANAGEMENTS = {
    "trial": Trial(confirm=3, window=5), "counter": Counter(admit=3), "existence": Existence(admit=0.99),
}  # fmt: skip


def with_clutter(events: list, seed: int) -> list:
    """Two false things at a time, seen in two frames and then no more, each 4 m and more from everything else.

    In its second frame a thing has moved by 0.25 m: to believe it would turn robot and map.
    """
    rng, told = np.random.default_rng(seed), []
    taken = [*feed(LandmarkSlam(), events).estimate().landmarks.positions]
    guide = LandmarkSlam()  # told the identities, so that it knows where the vehicle is
    false: list[np.ndarray] = []
    for number, event in enumerate(events):
        guide.step(event)
        if isinstance(event, Sightings) and number % 8 == 1:
            false = []
            while len(false) < 2:
                spot = guide.sensor.locate(guide.pose, np.array([rng.uniform(5, 25), rng.uniform(-1.2, 1.2)]))
                if all(np.hypot(*(spot - other)) > 4.0 for other in [*taken, *false]):
                    false.append(spot)
            taken += false
        if isinstance(event, Sightings) and number % 8 in (1, 3):
            z = guide.sensor.predict(guide.pose, np.array(false) + (0.25 if number % 8 == 3 else 0.0))
            event = Sightings(event.time, np.vstack([z[0], event.values, z[1]]), np.r_[-1, event.ids, -1])
        told.append(event)
    return told


CLEAN = circle_events(7, frames=30)


@pytest.fixture(name="cluttered", scope="module")
def cluttered_events() -> list:
    """CLEAN among clutter."""
    return with_clutter(CLEAN, 1)


def assert_same_gaussian(got: LandmarkSlam, wanted: LandmarkSlam) -> None:
    (mean, covariance), (other, expected) = got.estimate().joint(), wanted.estimate().joint()
    np.testing.assert_allclose(mean, other, rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=1e-8)


@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
@pytest.mark.parametrize("management", MANAGEMENTS)
@pytest.mark.parametrize("method", METHODS)
def test_clutter_that_is_never_believed_leaves_no_trace(method, management, coordinates, cluttered):
    """Oracle: the same filter on the same log without the clutter: mean and covariance of pose and map, to rounding,
    after every frame."""
    settings = {
        "association": METHODS[method](management=MANAGEMENTS[management]),
        "coordinates": coordinates,
    }
    dirty, clean = LandmarkSlam(**settings), LandmarkSlam(**settings)
    again = 0
    for number, (false, true) in enumerate(zip(cluttered, CLEAN, strict=True)):
        dirty.step(false)
        clean.step(true)
        if isinstance(false, Sightings):
            again += int((dirty.frame_association.matched[false.ids == -1] >= 0).sum())
        np.testing.assert_allclose(dirty.pose, clean.pose, rtol=1e-9, atol=1e-9)
        if number % 10 == 9:
            assert_same_gaussian(dirty, clean)
    assert_same_gaussian(dirty, clean)
    assert dirty.landmark_count == clean.landmark_count >= 8
    assert dirty._founded - clean._founded == 16 and len(dirty.rejected) >= 8
    assert again >= 10  # so many sightings went to landmarks that were rejected later


@pytest.mark.parametrize("rule", LINEARISERS)
@pytest.mark.parametrize("use", ["joint", "sequential"])
def test_the_same_with_every_lineariser_and_biases(rule, use, cluttered):
    """Oracle: as above."""
    settings = {
        "motion": VelocitySteering(biases=STEERING_BIASES[:2]),
        "lineariser": LINEARISERS[rule],
        "association": Djnn(management=Counter(admit=3)),
        "use": use,
        "start_covariance": np.diag([0.1, 0.1, 0.01]),
    }
    assert_same_gaussian(feed(LandmarkSlam(**settings), cluttered), feed(LandmarkSlam(**settings), CLEAN))


@pytest.mark.parametrize("scope", ["reduced", "full"])
def test_the_same_in_the_general_engine(scope, cluttered):
    """Oracle: as above, with the engine in numpy; the full scope's points see the clutter, but central differences'
    choose what is read alone (Theorem 1 of Chen & Cheng 2012)."""

    class Own(VelocitySteering, frozen=True):
        compiled = False

    settings = {"motion": Own(), "association": Djnn(management=Counter(admit=3)), "scope": scope}
    assert_same_gaussian(
        feed(LandmarkSlam(**settings), cluttered[:30]), feed(LandmarkSlam(**settings), CLEAN[:30])
    )


def test_nothing_is_corrected_before_somebody_is_believed():
    """Oracle: a filter that saw nothing at all: the pose and its covariance, bit for bit, until the third sighting."""
    slam = LandmarkSlam(association=Nearest(management=Trial(confirm=3, window=40)))
    blind = LandmarkSlam()
    for number, event in enumerate(CLEAN[:6]):
        before = copy_belief(slam._belief)
        slam.step(event)
        if isinstance(event, Odometry):
            blind.step(event)
        elif number < 5:
            assert slam.landmark_count == 0 and slam.frame_used == 0 and np.isnan(slam.frame_nis)
            assert len(slam.estimate().landmarks) == 0
            assert number == 1 or (slam.frame_association.matched >= 0).sum() >= 4
            np.testing.assert_array_equal(slam.pose, blind.pose)
            np.testing.assert_array_equal(slam.pose_covariance, blind.pose_covariance)
    association = slam.frame_association
    believed = np.isin(association.matched, association.confirmed)
    assert believed.sum() >= 3 and slam.frame_used == believed.sum() == slam.landmark_count
    z = event.values[believed]  # the sighting that confirms is the first that counts
    indices = 3 + 2 * association.matched[believed]
    slam._engine.update(before, z, indices, slam.sensor.covariance(z))
    np.testing.assert_array_equal(before.mean[: slam._belief.n][:3], slam.pose)
    np.testing.assert_array_equal(before.robot_covariance(), slam.pose_covariance)
    assert slam.estimate().landmarks.sightings.tolist() == [3] * slam.landmark_count


def test_a_frame_of_held_and_believed_uses_the_believed_alone(cluttered):
    """Oracle: the belief before the frame, updated by the engine with the confirmed landmarks' sightings only."""
    slam = LandmarkSlam(association=Djnn(management=Counter(admit=4)))
    mixed = 0
    for event in cluttered:
        before, count = copy_belief(slam._belief), len(slam._ids)
        sure = [number not in slam._on_trial for number in slam._ids]
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        association = slam.frame_association
        for index in association.confirmed:
            sure[index] = True
        used = [m for m, i in enumerate(association.matched.tolist()) if 0 <= i < count and sure[i]]
        held = [m for m, i in enumerate(association.matched.tolist()) if 0 <= i < count and not sure[i]]
        assert slam.frame_used == len(used)
        if used and held:
            mixed += 1
            z = event.values[used]
            nis = slam._engine.update(before, z, 3 + 2 * association.matched[used], slam.sensor.covariance(z))
            assert nis == slam.frame_nis
            np.testing.assert_array_equal(before.mean[:3], slam.pose)
            np.testing.assert_array_equal(before.robot_covariance(), slam.pose_covariance)
    assert mixed >= 3


def test_what_was_never_believed_is_no_landmark_in_the_result(cluttered):
    """Oracle: the log's identities: after the run no false sighting has a label, and every true landmark one."""
    outcome = run(LandmarkSlam(association=Djnn(management=Counter(admit=3))), log_of(cluttered))
    known, counts = np.unique(outcome.truth_ids, return_counts=True)
    often = set(known[counts >= 3].tolist()) - {-1}
    given = outcome.labels >= 0
    pairs = set(zip(outcome.truth_ids[given].tolist(), outcome.labels[given].tolist(), strict=True))
    assert (outcome.labels[outcome.truth_ids == -1] == SPURIOUS).all()
    assert {truth for truth, _ in pairs} == often and len(pairs) == len(often)
    assert len(outcome.estimate.landmarks) == outcome.trace.landmarks[-1] == len(often)
