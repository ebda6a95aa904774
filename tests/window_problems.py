"""Drives and stories for filters that decide over several frames, and filters that are told the end of them."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Attribute, Mda
from kalmap.models import VelocitySteering
from kalmap.records import Odometry, Sightings
from kalmap.slam import LandmarkSlam, run
from slam_problems import circle_events, log_of, state_of

DIAMETER = Attribute(name="diameter", sigma=0.1)


def rough_drive(seed: int, frames: int = 30) -> list:
    """The circle drive with clutter, misses, empty frames, frames at one time, and odometry in pieces."""
    rng, events = np.random.default_rng(seed), []
    for event in circle_events(seed, frames=frames):
        if isinstance(event, Odometry):
            cut = int(rng.integers(0, 4))
            for part in (slice(0, cut), slice(cut, None)):
                if len(event.durations[part]):
                    middle = event.time - event.durations[part.stop :].sum() if part.stop else event.time
                    events.append(Odometry(middle, event.values[part], event.durations[part]))
            continue
        for _ in range(2 if rng.random() < 0.3 else 1):
            seen = rng.random(len(event.ids)) < (0.0 if rng.random() < 0.1 else 0.9)
            z = event.values[seen] + rng.normal(0.0, [0.05, 0.005], (seen.sum(), 2))
            false = np.c_[rng.uniform(3, 25, 2), rng.uniform(-1.2, 1.2, 2)][: rng.integers(0, 3)]
            ids = np.append(event.ids[seen], np.full(len(false), -1))
            sizes = 0.1 + 0.05 * (ids % 9) + rng.normal(0, 0.03, len(ids))
            events.append(Sightings(event.time, np.vstack([z, false]), ids, attributes={"diameter": sizes}))
    return events


class Watch:
    """Writes down what is said about each frame; the last word is the decision."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.said: dict[int, tuple[list[int], bool]] = {}
        self.times = 0
        plain = Mda.conclude

        def conclude(method, memory, sightings, predicted, wanted, newest, notes=()):
            self.said[id(sightings)] = list(wanted), newest
            self.times += 1
            return plain(method, memory, sightings, predicted, wanted, newest, notes)

        monkeypatch.setattr(Mda, "conclude", conclude)

    def told(self, events: list, **settings) -> LandmarkSlam:
        """A filter that is told the last word on every frame when the frame comes."""
        last = dict(self.said)
        return told([last.get(id(event)) for event in events], events, **settings)


def told(decisions: list, events: list, **settings) -> LandmarkSlam:
    """A filter that never goes back: `decisions` holds (wanted, newest) for each frame among the events."""
    twin = LandmarkSlam(**settings)
    for event, decision in zip(events, decisions, strict=True):
        if isinstance(event, Odometry):
            twin.step(event)
            continue
        noises = twin._engine.noises(event.values)[0]
        predicted = twin.predicted(event, noises)
        association = twin.association.conclude(twin._memory, event, predicted, *decision)
        twin.take_decided(event, noises, association)
    return twin


def assert_same_state(slam: LandmarkSlam, twin: LandmarkSlam) -> None:
    """Belief, numbers, counts, memory, mergers and what was rejected, to the last bit."""
    assert state_of(slam)[1:] == state_of(twin)[1:]


def standing(frames: list) -> list:
    """A vehicle that stands still and sees things straight ahead at these ranges; sigma 0.1 m."""
    events = []
    for k, ranges in enumerate(frames):
        events.append(Odometry(float(k), np.array([[0.0, 0.0]]), np.array([0.1])))
        z = np.c_[ranges, np.zeros(len(ranges))].reshape(-1, 2)
        events.append(Sightings(float(k), z, np.full(len(ranges), -1)))
    return events


# two sightings of a landmark at 10 m, then two that could be it, and only then it becomes clear which of them is
OVERTURNED = standing([[10.0], [10.0], [10.1414, 9.7172], [10.0, 10.4243]])


def still(**settings) -> dict:
    return {
        "motion": VelocitySteering(sigma_speed=1e-3, sigma_steering=1e-3),
        "association": Mda(**settings),
    }


def labels_of(events: list, **settings) -> list[list[int]]:
    """The labels frame by frame as a run has them in the end."""
    outcome = run(LandmarkSlam(**settings), log_of(events))
    assert outcome.error is None
    cuts = np.cumsum([len(e.values) for e in events[1::2]])[:-1]
    return [part.tolist() for part in np.split(outcome.labels, cuts)]
