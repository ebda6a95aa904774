"""Frames and settings that nobody would wish for: a clear error or a sane answer from every associator."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import (
    Attribute,
    Counter,
    Djnn,
    Existence,
    Jcbb,
    Keep,
    KnownIds,
    Likelihood,
    Merging,
    Nearest,
    Trial,
)
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import NEW, SPURIOUS, ConfigError, EventError, KalmapError, Odometry, Sightings
from kalmap.slam import LandmarkSlam, run
from slam_problems import circle_events, feed, log_of, state_of

METHODS = {
    "nearest": Nearest, "hungarian": lambda **k: Nearest(one_to_one=True, **k), "likelihood": Likelihood,
    "jcbb": Jcbb, "djnn": Djnn,
}  # fmt: skip
MANAGEMENTS = {"keep": Keep(), "trial": Trial(2, 3), "counter": Counter(), "existence": Existence()}
METHOD = pytest.mark.parametrize("method", METHODS)
MANAGEMENT = pytest.mark.parametrize("management", MANAGEMENTS)


def filter_with(method: str, management: str = "keep", **settings) -> LandmarkSlam:
    """A filter by place, unsure of its start, so that its covariance has full rank from the first step."""
    association = METHODS[method](management=MANAGEMENTS[management], **settings)
    return LandmarkSlam(
        VelocitySteering(sigma_speed=0.05),
        RangeBearing(),
        association=association,
        start_covariance=0.01 * np.eye(3),
    )


def move(slam: LandmarkSlam) -> LandmarkSlam:
    time = 0.0 if slam.time < 0 else slam.time + 1.0
    slam.step(Odometry(time, np.array([[0.0, 0.02]]), np.array([0.5])))
    return slam


def see(slam: LandmarkSlam, z, **more) -> list[int]:
    """One more frame, after a little odometry; checked for sanity. Returns what the sightings were given."""
    move(slam)
    slam.step(Sightings(slam.time, np.array(z, float).reshape(-1, 2), **more))
    return assert_sane(slam)


def assert_sane(slam: LandmarkSlam) -> list[int]:
    """A finite, positive definite state, lists that fit, and one-to-one where that is promised."""
    belief, association = slam._belief, slam.frame_association
    assert np.isfinite(belief.mean[: belief.n]).all()
    covariance = belief.covariance()
    scale = np.sqrt(np.diag(covariance))
    np.linalg.cholesky(covariance / np.outer(scale, scale))
    memory = slam._memory
    assert slam.association.fits(memory, len(slam._ids)) and memory["serial"] == slam._ids
    matched = association.matched.tolist()
    assert len(matched) == len(slam.frame_sightings.values) == len(slam.frame_labels)
    taken = [index for index in matched if index >= 0]
    if not (isinstance(slam.association, Nearest) and not slam.association.one_to_one):
        assert len(set(taken)) == len(taken)
    assert all(index >= SPURIOUS for index in matched)
    return matched


RNG = np.random.default_rng(0)
ONE, FEW = [[10.0, 0.3]], [[10.0, 0.3], [12.0, -0.4], [20.0, 0.0]]
MANY = np.c_[RNG.uniform(1, 29, 200), RNG.uniform(-1.5, 1.5, 200)]
STORIES = {
    "nothing at all": [[], [], []],
    "nothing, then something": [[], ONE, [], ONE],
    "one": [ONE, ONE, ONE],
    "a map of one and many sightings": [ONE, FEW, MANY[:30], ONE],
    "two hundred": [MANY, MANY + 0.01, MANY],
    "the same sighting twice": [FEW, FEW * 2, ONE * 2, FEW * 3],
    "the same sighting twice at first": [ONE * 2, ONE, ONE * 2, ONE * 3],
    "all in one place": [ONE * 30, ONE * 30, ONE * 31],
    "all in one place but for a hair": [
        np.tile(ONE, (12, 1)) + 1e-9 * np.arange(12)[:, None], np.tile(ONE, (12, 1)), ONE
    ],
    "behind and beyond the sensor": [[[10.0, 3.1], [500.0, 0.0]], [[10.0, 3.1], [500.0, 0.0]]],
    "around the seam": [[[10.0, 3.14159], [10.0, -3.14159]], [[10.0, -3.14159], [10.0, 3.14159]]],
}  # fmt: skip


@MANAGEMENT
@METHOD
@pytest.mark.parametrize("story", STORIES)
def test_strange_frames_get_sane_answers(story, method, management):
    """Oracle: `assert_sane` after every frame: finite, positive definite, aligned, one-to-one where promised; the
    first sightings of an empty map found landmarks."""
    slam = filter_with(method, management, merging=Merging())
    for number, z in enumerate(STORIES[story]):
        before = slam._founded
        matched = see(slam, z)
        if before == 0:
            assert matched == [NEW] * len(z), number
    assert slam._founded <= sum(len(z) for z in STORIES[story])


@MANAGEMENT
@METHOD
@pytest.mark.parametrize("gates", [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.5, 1.0), (0.0, 0.5)])
def test_gates_of_nothing_and_of_everything(gates, method, management):
    """Oracle: probability 0 lets only a distance of 0 in, probability 1 everything: by hand what that means for
    founding, and a sane state in any case."""
    gate, new_gate = gates
    slam = filter_with(method, management, gate=gate, new_gate=new_gate)
    for number, event in enumerate(circle_events(3, frames=8)):
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        matched = assert_sane(slam)
        if number > 1 and gates == (0.0, 0.0):
            assert matched == [NEW] * len(matched)
        if number > 1 and new_gate == 1.0 and slam._ids and management == "keep":
            assert NEW not in matched
        if number > 1 and gate == 1.0 and management == "keep":
            assert sum(index >= 0 for index in matched) >= min(len(matched), 1)
    if gates == (0.0, 0.0) and management == "keep":
        assert slam.landmark_count == sum(len(e.values) for e in circle_events(3, frames=8)[1::2])


@MANAGEMENT
@METHOD
def test_two_hundred_in_one_place_with_an_open_gate(method, management):
    """Oracle: everything fits everything, twice: it ends, the state stays sane, and what the first sighting founded
    is the only landmark there ever is."""
    slam = filter_with(method, management, gate=1.0, new_gate=1.0)
    for count in (1, 200, 200):
        assert len(see(slam, ONE * count)) == count
    assert slam._founded == len(slam._ids) == 1


@METHOD
def test_a_map_of_one_landmark(method):
    """Oracle: by hand: near is it, far is another, in between is nothing, but for djnn's widened gate."""
    slam = filter_with(method)
    assert see(slam, ONE) == [NEW]
    assert see(slam, ONE) == [0]
    assert see(slam, [[25.0, -0.9]]) == [NEW]
    assert see(slam, [[10.55, 0.3]]) == [0 if method == "djnn" else SPURIOUS]
    assert slam.landmark_count == 2


@METHOD
def test_the_same_sighting_twice_by_hand(method):
    """Oracle: by hand: two that are new found two landmarks; of two that are known one has it and the other is left,
    but for nearest neighbour, which gives the landmark to both."""
    slam = filter_with(method)
    see(slam, FEW)
    matched = see(slam, [FEW[1], FEW[1]])
    assert sorted(matched) == ([1, 1] if method == "nearest" else [SPURIOUS, 1])
    assert see(slam, [[25.0, -1.2]] * 2) == [NEW, NEW]


# --- identities, covariances, attributes --------------------------------------------------------------

EVENTS = circle_events(6, frames=16)


def changed(events: list, change) -> list:
    """The drive with `change(number, frame)` in place of every frame."""
    return [change(k, e) if isinstance(e, Sightings) else e for k, e in enumerate(events)]


@METHOD
def test_ids_mean_nothing_to_those_who_go_by_place(method):
    """Oracle: the drive without identities: bit for bit, whether they stay, change half-way, or stop."""
    plain = feed(filter_with(method), changed(EVENTS, lambda k, e: Sightings(e.time, e.values)))
    for change in (
        lambda k, e: e,
        lambda k, e: Sightings(e.time, e.values, e.ids + 100 * (k > 15)),
        lambda k, e: Sightings(e.time, e.values, e.ids if k < 15 else None),
        lambda k, e: Sightings(e.time, e.values, np.full(len(e.ids), -5)),
    ):
        assert state_of(feed(filter_with(method), changed(EVENTS, change))) == state_of(plain)


def test_a_new_id_is_a_new_landmark_to_those_who_go_by_ids():
    """Oracle: by hand: every landmark seen after the change is founded again, beside the old one."""
    slam = LandmarkSlam(association=KnownIds())
    feed(slam, changed(EVENTS, lambda k, e: Sightings(e.time, e.values, e.ids + 100 * (k > 15))))
    before = {i for e in EVENTS[1:16:2] for i in e.ids.tolist()}
    after = {100 + i for e in EVENTS[17::2] for i in e.ids.tolist()}
    assert set(slam.estimate().landmarks.ids.tolist()) == before | after
    assert len(slam.estimate().landmarks) == len(before) + len(after)
    with pytest.raises(EventError) as caught:
        slam.step(Sightings(99.0, np.array(ONE)))
    assert caught.value.field == "ids"


@METHOD
def test_covariances_in_the_frame(method):
    """Oracle: the sensor's own noise handed over in the frame: bit for bit the same; ten times as much of it: the
    same landmarks, less sure."""
    sensor, plain = RangeBearing(), feed(filter_with(method), EVENTS)
    same = changed(EVENTS, lambda k, e: Sightings(e.time, e.values, e.ids, sensor.covariance(e.values)))
    assert state_of(feed(filter_with(method), same)) == state_of(plain)
    wide = changed(EVENTS, lambda k, e: Sightings(e.time, e.values, e.ids, 100 * sensor.covariance(e.values)))
    unsure = feed(filter_with(method), wide)
    assert_sane(unsure)
    apart = []
    for slam in (plain, unsure):
        p, line = slam._belief.covariance(), np.diff(slam.estimate().landmarks.positions[:2], axis=0)[0]
        line /= np.hypot(*line)  # the distance of two landmarks, which no turn of the map touches
        apart.append(line @ (p[3:5, 3:5] + p[5:7, 5:7] - p[3:5, 5:7] - p[5:7, 3:5]) @ line)
    assert apart[1] > 10 * apart[0]


@METHOD
@pytest.mark.parametrize("kind", ["nan", "negative", "indefinite", "inf"])
def test_covariances_that_are_none(method, kind):
    """Oracle: an error of kalmap's and the filter as it was, whether the sighting is near a landmark or far of all."""
    bad = {
        "nan": np.full((2, 2), np.nan),
        "negative": -np.eye(2),
        "indefinite": np.array([[1.0, 2.0], [2.0, 1.0]]),
        "inf": np.full((2, 2), np.inf),
    }[kind]
    slam = feed(filter_with(method), EVENTS[:8])
    before, good = state_of(slam), np.diag([0.01, 1e-4])
    for z in (EVENTS[7].values[:2], np.array([EVENTS[7].values[0], [28.0, 1.5]])):
        with pytest.raises(KalmapError):
            slam.step(Sightings(slam.time, z, None, np.stack([good, bad])))
        assert state_of(slam) == before


@MANAGEMENT
@METHOD
def test_attributes_that_go_missing_half_way(method, management):
    """Oracle: a tolerant run skips these frames and is the run over the log without them; an intolerant one ends
    with an error naming the attribute. NaN is no missing attribute."""

    def told(k, e):
        measured = 0.1 * e.ids + 0.1
        measured[k % 3 :: 3] = np.nan
        return Sightings(e.time, e.values, e.ids, attributes={"diameter": measured} if k < 17 else None)

    events = changed(EVENTS, told)
    attributes = (Attribute(name="diameter"),)
    tolerant = filter_with(method, management, attributes=attributes)
    outcome = run(tolerant, log_of(events), tolerant=True)
    assert outcome.error is None and outcome.skipped_total == 8
    assert {skipped.field for skipped in outcome.skipped} == {"diameter"}
    twin = filter_with(method, management, attributes=attributes)
    feed(twin, [e for k, e in enumerate(events) if k < 17 or isinstance(e, Odometry)])
    assert state_of(tolerant) == state_of(twin)
    assert_sane(tolerant)
    outcome = run(filter_with(method, management, attributes=attributes), log_of(events))
    assert outcome.error.field == "diameter" and outcome.frames == 8


@METHOD
@pytest.mark.parametrize("extent", [0.5, 1e3, 1e6])
def test_landmarks_as_wide_as_the_world(method, extent):
    """Oracle: a sane state; what is as wide as everything is the only landmark that there ever is."""
    slam = filter_with(method, extent=extent)
    for event in EVENTS[:12]:
        slam.step(event)
        if isinstance(event, Sightings):
            assert_sane(slam)
    assert extent < 1e3 or slam._founded == len(EVENTS[1].values)


@METHOD
@pytest.mark.parametrize(
    ("name", "value"),
    [("gate", -0.1), ("gate", 1.1), ("gate", np.nan), ("new_gate", 2.0), ("extent", -1.0), ("extent", np.nan),
     ("extent", np.inf), ("extent", 1e200)],
)  # fmt: skip
def test_impossible_settings_are_refused(method, name, value):
    """Oracle: ConfigError naming the setting."""
    with pytest.raises(ConfigError, match=name):
        METHODS[method](**{name: value})


@METHOD
def test_sightings_at_the_sensor_itself(method):
    """Oracle: a landmark founded at range 0 is as sure as the sensor's place across its ray: a covariance that is
    semi-definite, nothing below zero but rounding, and numbers that stay finite."""
    slam = filter_with(method)
    for z in ([[0.0, 0.0]], [[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0]], [[0.05, 2.0]]):
        slam.step(Odometry(0.0, np.array([[0.0, 0.02]]), np.array([0.5])))
        slam.step(Sightings(0.0, np.array(z)))
        covariance = slam._belief.covariance()
        values = np.linalg.eigvalsh(covariance)
        assert values[0] > -1e-12 * values[-1]
        assert np.isfinite(slam._belief.mean[: slam._belief.n]).all()
