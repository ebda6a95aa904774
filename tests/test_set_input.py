"""Odd and bad input for methods of random finite sets and for association by probabilities: refused, or borne."""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest

from kalmap.records import (
    ConfigError,
    EventError,
    KalmapError,
    LogError,
    Odometry,
    RunConfig,
    Scan,
    Sightings,
)
from kalmap.records.config import AssociationConfig, FiniteSetConfig, SensorConfig
from kalmap.slam import LandmarkSlam, run
from kalmap.slam import particle_frames as module
from kalmap.slam.build import slam_from_config
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.mixture import MixtureSlam
from kalmap.slam.particles import Particles
from slam_problems import circle_events, feed, log_of, state_of
from test_mixture_slam import whole_state
from test_set_checkpoint import set_state_of

SETS = ("rb-phd", "srckf-phd", "mh-fastslam", "pmb")
METHODS = (*SETS, "pmbm", "associated")
REACH = 30.0
SENSOR = SensorConfig(max_range=REACH)


def make(method: str, events=(), sensor: SensorConfig = SENSOR, **settings):
    """The estimator by its settings; "associated" is the filter alone, with the association pmb."""
    config = RunConfig(
        sensor=sensor,
        finite_set=FiniteSetConfig(
            method=None if method == "associated" else method, **{"particles": 3, "threads": 1, **settings}
        ),
        association=AssociationConfig(method="pmb"),
    )
    return slam_from_config(config, log_of(list(events)))


def still(time: float) -> Odometry:
    return Odometry(time, np.array([[1.0, 0.02]]), np.array([0.1]))


def driven(frames: list) -> list:
    """Odometry before each frame."""
    events = []
    for k, z in enumerate(frames):
        events += [still(k + 1.0), Sightings(k + 1.0, np.asarray(z, dtype=float).reshape(-1, 2))]
    return events


def uniform(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.c_[rng.uniform(0.0, REACH, count), rng.uniform(-1.5, 1.5, count)]


def finite(outcome) -> bool:
    """Whether every number of an outcome is one: estimate, joint covariance and trace."""
    estimate, trace = outcome.estimate, outcome.trace
    marks = estimate.landmarks
    parts = [estimate.pose, estimate.covariance, marks.positions, marks.covariances, marks.existence]
    return all(
        np.isfinite(part).all() for part in (*parts, *estimate.joint(), trace.poses, trace.covariances)
    )


def psd(covariance: np.ndarray) -> bool:
    return bool(np.linalg.eigvalsh(covariance)[0] >= -1e-9 * max(np.trace(covariance), 1e-12))


def ran(method: str, events: list, **settings):
    """The outcome of a run over the events, which is whole and without an error."""
    slam = make(method, events, **settings)
    outcome = run(slam, log_of(events), reckon=False)
    assert outcome.error is None, outcome.error
    assert finite(outcome) and psd(outcome.estimate.covariance) and outcome.frames > 0
    return outcome


@pytest.mark.parametrize("method", METHODS)
def test_a_thousand_frames_without_a_sighting(method):
    """Oracle: dead reckoning: nothing was seen, so that the pose is odometry's, and there is no landmark."""
    events = driven([[]] * 1000)
    outcome = ran(method, events)
    reckoned = LandmarkSlam(make(method).motion)
    for event in events:
        if isinstance(event, Odometry):
            reckoned.step(event)
    off = outcome.estimate.pose[:2] - reckoned.pose[:2]
    assert len(outcome.estimate.landmarks) == 0
    assert off @ np.linalg.solve(reckoned.pose_covariance[:2, :2], off) < 25.0


@pytest.mark.parametrize("method", METHODS)
def test_landmarks_are_kept_through_many_empty_frames(method):
    """Oracle: finite numbers, and existence that falls: what is no longer seen where it should be is believed less."""
    places = np.array([[8.0, 0.4], [12.0, -0.5], [15.0, 0.2]])
    stand = [Odometry(float(k), np.zeros((1, 2)), np.array([0.1])) for k in range(320)]
    frames = [Sightings(float(k), places if k < 20 else places[:0]) for k in range(320)]
    events = [event for pair in zip(stand, frames) for event in pair]
    before, after = ran(method, events[:40]).estimate, ran(method, events).estimate
    assert len(before.landmarks) == 3
    assert after.landmarks.existence.sum() < before.landmarks.existence.sum()


@pytest.mark.parametrize("method", METHODS)
def test_clutter_alone_is_no_map(method):
    """Oracle: by hand: of 400 false sightings in 100 frames hardly any is a landmark."""
    rng = np.random.default_rng(8)
    outcome = ran(method, driven([uniform(rng, int(rng.poisson(4.0))) for _ in range(100)]), clutter=4.0)
    assert len(outcome.estimate.landmarks) <= 4


@pytest.mark.parametrize("method", METHODS)
def test_a_thousand_sightings_in_a_frame(method):
    """Oracle: finite numbers; three times, so that the map of the first is looked for in the others."""
    rng = np.random.default_rng(9)
    outcome = ran(method, driven([uniform(rng, 1000) for _ in range(3)]), particles=2)
    assert finite(outcome) and psd(outcome.estimate.covariance)
    assert (outcome.frames, outcome.sightings) == (3, 3000)


@pytest.mark.parametrize("estimate", [True, False])
@pytest.mark.parametrize(
    "settings",
    [
        {"detection": 0.0},
        {"detection": 1.0},
        {"clutter": 0.0},
        {"detection": 1.0, "clutter": 0.0},
        {"detection": 0.0, "clutter": 1000.0},
        {"particles": 1},
        {"new_rate": 1e-9},
        {"new_rate": 1e6},
        {"cap": 16},
        {"gate": 1e-9},
        {"gate": 1.0 - 1e-12},
        {"feature": 1e-9, "prune": 1e-300},
    ],
    ids=str,
)
@pytest.mark.parametrize("method", METHODS)
def test_settings_at_their_ends(method, settings, estimate):
    """Oracle: finite numbers and semi-definite covariances over frames of landmarks with misses, of clutter and of
    nothing, which these settings call impossible."""
    rng, frames = np.random.default_rng(3), []
    for event in circle_events(5, frames=24):
        if isinstance(event, Sightings):
            kept = event.values[rng.random(len(event.values)) < 0.8]
            frames.append([kept, np.vstack([kept, uniform(rng, 6)]), kept[:0]][len(frames) % 3])
    events = [
        msgspec.structs.replace(event, values=frames.pop(0), ids=None)
        if isinstance(event, Sightings)
        else event
        for event in circle_events(5, frames=24)
    ]
    outcome = ran(method, events, **settings, estimate=estimate)
    assert finite(outcome) and psd(outcome.estimate.covariance)
    assert outcome.frames == 24 and outcome.recovered == (0 if method in SETS else None)


@pytest.mark.parametrize(
    "settings",
    [
        {"particles": 0},
        {"detection": 1.5},
        {"detection": np.nan},
        {"clutter": -1.0},
        {"clutter": np.nan},
        {"clutter": np.inf},
        {"new_rate": 0.0},
        {"gate": 1.0},
        {"cap": 2},
        {"resample": 2.0},
        {"branches": 0},
        {"method": "pmbm"},
        {"method": None},
        {"method": "phd"},
        {"proposal": "guess"},
    ],
    ids=str,
)
def test_settings_without_a_meaning_are_refused(settings):
    """Oracle: ConfigError that names the setting, also where they come from a program and not from a file."""
    with pytest.raises(ConfigError, match=next(iter(settings))):
        FiniteSetSlam(config=FiniteSetConfig(**{"method": "pmb", **settings}))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "z", [[0.0, 0.0], [1e-9, 1.0], [REACH, 0.0], [1e6, 0.1], [5.0, 3.14159], [5.0, 40.0]], ids=str
)
def test_sightings_at_the_edges(method, z):
    """Oracle: finite numbers: at the sensor itself, at and far beyond its reach, beside and behind it."""
    outcome = ran(method, driven([[z], [z, [7.0, 0.2]], [z], [[7.0, 0.2]]] * 3))
    assert finite(outcome) and psd(outcome.estimate.covariance)
    assert (outcome.frames, outcome.sightings) == (12, 15)


@pytest.mark.parametrize("method", METHODS)
def test_a_sensor_that_sees_all_around(method):
    """Oracle: finite numbers, with a field of view of 360 degrees."""
    rng = np.random.default_rng(2)
    sensor = SensorConfig(max_range=REACH, field_of_view_deg=360.0)
    outcome = ran(method, driven([uniform(rng, 5) * [1.0, 2.0] for _ in range(12)]), sensor=sensor)
    assert finite(outcome) and psd(outcome.estimate.covariance)
    assert (outcome.frames, outcome.sightings) == (12, 60)


@pytest.mark.parametrize("method", SETS)
def test_weights_that_are_lost_are_recovered_counted_and_told(method):
    """Oracle: by hand: all weights zero in one frame: equal or those that the frame gives afterwards, finite, one
    recovery in the filter and in the outcome."""
    events = circle_events(5, frames=12)
    slam = make(method, events)

    def disturbed(skip):
        for number, event in enumerate(events):
            if number == 13:
                slam._particles.log_weights[:] = -np.inf
            yield event

    outcome = run(slam, msgspec.structs.replace(log_of(events), open=disturbed), reckon=False)
    assert outcome.error is None and finite(outcome)
    assert slam.recovered == outcome.recovered == 1
    assert abs(slam._particles.weights.sum() - 1.0) < 1e-12
    assert run(make(method, events), log_of(events), reckon=False).recovered == 0


@pytest.mark.parametrize("lost", [-np.inf, np.nan])
@pytest.mark.parametrize("method", SETS)
def test_a_frame_that_no_particle_explains_is_recovered_from(method, lost, monkeypatch):
    """Oracle: by hand: every particle's likelihood of one frame taken for zero, or for none: counted once, weights
    equal, and the run goes on."""
    events, frames = circle_events(5, frames=12), []

    def spoilt(plain, place):
        def step(*given):
            plain(*given)
            frames.append(1)
            if len(frames) == 6:
                given[place][:] = lost

        return step

    monkeypatch.setattr(module.kernel, "step_particles", spoilt(module.kernel.step_particles, -3))
    monkeypatch.setattr(module, "step_hypotheses", spoilt(module.step_hypotheses, -4))
    slam = make(method)
    for event in events:
        slam.step(event)
        if len(frames) == 6 and isinstance(event, Sightings):
            np.testing.assert_allclose(slam._particles.weights, 1.0 / 3.0)
    assert slam.recovered == 1 and np.isfinite(slam.pose).all() and psd(slam.pose_covariance)


def test_a_particle_without_a_weight_takes_nothing_from_the_others():
    """Oracle: by hand: NaN is no weight; where all are that, they become equal and it is said."""
    particles = Particles(np.zeros((3, 3)), np.zeros((3, 0)), 16)
    assert particles.weigh(np.array([np.nan, 0.0, np.log(3.0)]))
    np.testing.assert_allclose(particles.weights, [0.0, 0.25, 0.75])
    assert not particles.weigh(np.array([0.0, np.nan, -np.inf]))
    np.testing.assert_allclose(particles.weights, 1.0 / 3.0)


BAD = {
    "late odometry": Odometry(-5.0, np.array([[1.0, 0.0]]), np.array([0.1])),
    "odometry that is none": Odometry(1e3, np.array([[np.nan, 0.0]]), np.array([0.1])),
    "endless odometry": Odometry(1e3, np.array([[np.inf, 0.0]]), np.array([0.1])),
    "odometry of no duration": Odometry(1e3, np.array([[1.0, 0.0]]), np.array([np.nan])),
    "odometry backwards in time": Odometry(1e3, np.array([[1.0, 0.0]]), np.array([-0.1])),
    "half bad odometry": Odometry(1e3, np.array([[1.0, 0.1], [np.nan, 0.0]]), np.array([0.1, 0.1])),
    "odometry in another shape": Odometry(1e3, np.array([[1.0, 0.0, 0.0]]), np.array([0.1])),
    "late frame": Sightings(-5.0, np.array([[5.0, 0.1]])),
    "frame at no time": Sightings(np.nan, np.array([[5.0, 0.1]])),
    "frame at the end of time": Sightings(np.inf, np.array([[5.0, 0.1]])),
    "range that is none": Sightings(1e3, np.array([[5.0, 0.1], [np.nan, 0.0]])),
    "endless range": Sightings(1e3, np.array([[np.inf, 0.1]])),
    "range below zero": Sightings(1e3, np.array([[-1.0, 0.1]])),
    "bearing that is none": Sightings(1e3, np.array([[5.0, np.nan]])),
    "endless bearing": Sightings(1e3, np.array([[5.0, -np.inf]])),
    "three numbers a sighting": Sightings(1e3, np.zeros((2, 3))),
    "a flat frame": Sightings(1e3, np.array([5.0, 0.1])),
    "identities that do not fit": Sightings(1e3, np.array([[5.0, 0.1]]), np.array([1, 2])),
    "covariances that do not fit": Sightings(1e3, np.array([[5.0, 0.1]]), covariance=np.eye(2)),
    "a scan without a detector": Scan(1e3, np.ones(3), np.zeros(3)),
}


def comparable(slam) -> tuple:
    if isinstance(slam, FiniteSetSlam):
        return set_state_of(slam)
    return whole_state(slam) if isinstance(slam, MixtureSlam) else copy.deepcopy(state_of(slam))


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("method", METHODS)
def test_bad_events_are_refused_and_change_nothing(method, name):
    """Oracle: EventError, and the state bit for bit as before; the drive goes on as if it had not been there."""
    events = circle_events(5, frames=12)
    slam, other = (feed(make(method), events[:12]) for _ in range(2))
    if name == "a scan without a detector":
        slam.detector = None
        if isinstance(slam, MixtureSlam):
            slam._first.slam.detector = None
    before = comparable(slam)
    with pytest.raises(EventError):
        slam.step(BAD[name])
    assert comparable(slam) == before
    assert comparable(feed(slam, events[12:])) == comparable(feed(other, events[12:]))


@pytest.mark.parametrize("method", METHODS)
def test_a_frame_before_odometry_is_refused(method):
    """Oracle: EventError, and the filter is as fresh as before."""
    slam = make(method)
    before = comparable(slam)
    with pytest.raises(EventError, match="before any odometry"):
        slam.step(Sightings(0.0, np.array([[5.0, 0.1]])))
    assert comparable(slam) == before


@pytest.mark.parametrize("method", METHODS)
def test_a_covariance_that_is_none_ends_the_run_in_the_houses_words(method):
    """Oracle: an error of kalmap's own, with the result up to there."""
    events = circle_events(5, frames=8)
    values = np.array([[5.0, 0.1]])
    bad = Sightings(1e3, values, covariance=np.array([[[1.0, 2.0], [2.0, 1.0]]]))
    outcome = run(make(method), log_of([*events, bad]), reckon=False)
    assert isinstance(outcome.error, KalmapError) and finite(outcome) and outcome.frames == 8


@pytest.mark.parametrize("tolerant", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_a_log_with_bad_records_or_cut_short(method, tolerant):
    """Oracle: the run up to the first bad record with an error that names it, or over all others when tolerant; a log
    that breaks off leaves what there was."""
    events = circle_events(5, frames=8)
    spoilt = [*events[:10], *[BAD[name] for name in ("range below zero", "late odometry")], *events[10:]]
    outcome = run(make(method), log_of(spoilt), tolerant=tolerant, reckon=False)
    assert finite(outcome) and outcome.frames == (8 if tolerant else 5)
    assert outcome.skipped_total == (2 if tolerant else 0)
    assert tolerant or isinstance(outcome.error, LogError)

    def cut(skip):
        yield from events[:10]
        raise LogError("ends in the middle of a record", file="drive.csv", record=11)

    broken = msgspec.structs.replace(log_of(events), open=cut)
    outcome = run(make(method), broken, tolerant=tolerant, reckon=False)
    assert isinstance(outcome.error, LogError) and finite(outcome) and outcome.frames == 5
    nothing = run(make(method), log_of([]), reckon=False)
    assert nothing.error is None and nothing.frames == 0 and len(nothing.estimate.landmarks) == 0
