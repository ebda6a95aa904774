"""Association by place in whole drives: clutter retired, labels true, the region without consequence."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Counter, Djnn, Jcbb, KnownIds, Likelihood, Nearest, Region, Trial
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import Odometry, Sightings
from kalmap.slam import LandmarkSlam
from slam_problems import circle_events, feed, state_of

BLIND = {
    "nearest": Nearest, "hungarian": lambda **k: Nearest(one_to_one=True, **k), "likelihood": Likelihood,
    "djnn": Djnn, "jcbb": Jcbb,
}  # fmt: skip


def clutter_story(seed: int) -> list:
    """The circle drive with a false sighting in every second frame, somewhere within view."""
    rng, events = np.random.default_rng(seed), []
    for number, event in enumerate(circle_events(seed, frames=60)):
        if isinstance(event, Sightings) and number % 4 == 1:
            false = np.array([[rng.uniform(3, 25), rng.uniform(-1.2, 1.2)]])
            event = Sightings(event.time, np.vstack([false, event.values]), np.append(-1, event.ids))
        events.append(event)
    return events


@pytest.mark.parametrize("name", BLIND)
@pytest.mark.parametrize("management", [Trial(confirm=3, window=6), Counter()])
def test_clutter_is_retired_and_bookkeeping_stays_aligned(name, management):
    """Oracle: the simulated identities: one landmark per true one at the end,
    each label always the same truth."""
    slam = LandmarkSlam(VelocitySteering(), RangeBearing(), association=BLIND[name](management=management))
    retired, seen = 0, {}
    for event in clutter_story(5):
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        retired += len(slam.frame_association.retired)
        memory = slam._memory
        assert len(memory["score"]) == len(slam._ids) == len(slam._counts) == (slam._belief.n - 3) // 2
        assert memory["serial"] == slam._ids and sum(memory["confirmed"]) == slam.landmark_count
        for truth, label in zip(event.ids.tolist(), slam.frame_labels.tolist(), strict=True):
            if truth >= 0 and label >= 0:
                seen.setdefault(label, []).append(truth)
    landmarks = slam.estimate().landmarks
    assert retired >= 15
    assert len(set(landmarks.ids.tolist())) == len(landmarks)
    numbers = landmarks.ids.tolist()
    assert sorted(max(set(seen[n]), key=seen[n].count) for n in numbers) == list(range(12))
    assert all(len(set(seen[n])) == 1 for n in numbers)


def test_landmarks_on_trial_are_left_out_of_the_estimate():
    """Oracle: the filter's own joint Gaussian, with the rows of unconfirmed landmarks deleted by numpy."""
    slam = LandmarkSlam(association=Likelihood(management=Trial(confirm=4, window=40)))
    feed(slam, clutter_story(5)[:24])
    on_trial = [i for i, confirmed in enumerate(slam._memory["confirmed"]) if not confirmed]
    assert 0 < len(on_trial) < len(slam._ids)
    gone = np.concatenate([[3 + 2 * i, 4 + 2 * i] for i in on_trial])
    mean, covariance = slam.estimate().joint()
    np.testing.assert_array_equal(mean, np.delete(slam._belief.mean[: slam._belief.n], gone))
    full = slam._belief.covariance()
    np.testing.assert_array_equal(covariance, np.delete(np.delete(full, gone, 0), gone, 1))
    landmarks = slam.estimate().landmarks
    assert landmarks.ids.tolist() == np.delete(slam._ids, on_trial).tolist()
    np.testing.assert_array_equal(landmarks.positions.ravel(), mean[3:])
    assert len(landmarks) == slam.landmark_count == len(slam._ids) - len(on_trial)


@pytest.mark.parametrize("name", BLIND)
def test_place_finds_the_truth_of_an_easy_drive(name):
    """Oracle: the filter that is given the identities, on the same drive without clutter."""
    events = circle_events(8, frames=50)
    blind = feed(LandmarkSlam(association=BLIND[name]()), events).estimate()
    told = feed(LandmarkSlam(association=KnownIds()), events).estimate()
    assert len(blind.landmarks) == len(told.landmarks)
    np.testing.assert_allclose(blind.pose, told.pose, atol=0.05)


@pytest.mark.parametrize("name", BLIND)
def test_the_local_region_changes_nothing_but_the_work(name):
    """Oracle: the same drive with every landmark taking part: the same decisions and the same numbers."""
    events = clutter_story(3)
    local, whole = (
        feed(LandmarkSlam(association=BLIND[name](region=Region(local=here))), events)
        for here in (True, False)
    )
    assert state_of(local)[:6] == state_of(whole)[:6]
