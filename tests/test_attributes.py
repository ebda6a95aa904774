"""What a sighting tells beside its place: the likelihood against scipy, and trees told apart by their diameter."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2, norm

from kalmap.association import Attribute, Djnn, Jcbb, Keep, Likelihood, Nearest, Trial
from kalmap.association.attributes import unknown
from kalmap.geometry.ellipses import chi_square
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import (
    NEW,
    AssociationConfig,
    AttributeConfig,
    ConfigError,
    EventError,
    Odometry,
    Sightings,
)
from kalmap.slam import LandmarkSlam, run
from kalmap.slam.build import associator_from_config
from slam_problems import circle_events, feed, log_of, state_of

DIAMETER = Attribute(name="diameter", sigma=0.05)
COLOUR = Attribute(name="colour", classes=True, sure=0.9)
METHODS = pytest.mark.parametrize("method", [Nearest, Likelihood, Djnn, Jcbb])


# --- the likelihood -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("sigma", "ratio"), [(0.05, 0.0), (0.0, 0.1), (0.03, 0.2)])
def test_cost_is_the_likelihood_ratio(sigma, ratio):
    """Oracle: scipy: -2 ln of N(value; mean, sigma^2 of one sighting and of the mean's n) over its own maximum."""
    rng = np.random.default_rng(0)
    known = [[int(rng.integers(1, 6)), float(rng.uniform(0.1, 1.0))] for _ in range(6)]
    values, indices = rng.uniform(0.0, 1.2, 5), np.array([4, 0, 2])
    got = Attribute(name="d", sigma=sigma, ratio=ratio).cost(known, indices, values)
    for m, value in enumerate(values):
        for c, (count, mean) in enumerate(known[i] for i in indices):
            one = sigma**2 + (ratio * mean) ** 2
            spread = math.sqrt(one + one / count)
            expected = -2.0 * (norm.logpdf(value, mean, spread) - norm.logpdf(mean, mean, spread))
            np.testing.assert_allclose(got[m, c], expected, rtol=1e-9, atol=1e-12)


def test_labels_cost_what_their_odds_say():
    """Oracle: -2 ln of the likelihood ratio: 0 where the labels agree, 2 ln(sure / (1 - sure)) where they do not."""
    got = COLOUR.cost([[3, 1.0], [1, 2.0]], np.array([0, 1]), np.array([1.0, 2.0, 7.0]))
    p = 2.0 * math.log(0.9 / 0.1)
    np.testing.assert_allclose(got, [[0, p], [p, 0], [p, p]])


@pytest.mark.parametrize("attribute", [DIAMETER, COLOUR])
def test_what_is_not_known_says_nothing(attribute):
    """Oracle: by hand: NaN, and landmarks without a value, cost nothing; no landmark and no sighting are empty."""
    known = [[0, 0.0], [2, 0.3]]
    got = attribute.cost(known, np.array([0, 1]), np.array([0.9, np.nan, np.inf]))
    assert (got[:, 0] == 0.0).all() and got[0, 1] > 1.0 and (got[1:, 1] == 0.0).all()
    assert attribute.cost([], np.zeros(0, int), np.array([0.9])).shape == (1, 0)
    assert attribute.cost(known, np.array([0, 1]), np.zeros(0)).shape == (0, 2)


def test_noise_that_vanishes_with_the_value():
    """Oracle: by hand: a landmark that measured exactly 0, with noise in proportion, is known exactly: 0 fits and
    1 never does."""
    got = Attribute(name="d", sigma=0.0, ratio=0.1).cost([[2, 0.0]], np.array([0]), np.array([0.0, 1.0]))
    assert got[0, 0] == 0.0 and got[1, 0] > 1e9 and np.isfinite(got).all()


def test_learning_is_the_running_mean():
    """Oracle: numpy's mean of the finite values; a label is the first one seen."""
    values, known = [0.3, 0.4, np.nan, 0.2, np.inf, 0.5], [[0, 0.0]]
    for value in values:
        DIAMETER.learn(known, 0, value)
    np.testing.assert_allclose(known, [[4, np.mean([0.3, 0.4, 0.2, 0.5])]])
    known = [[0, 0.0]]
    for label in (np.nan, 2.0, 3.0, 3.0):
        COLOUR.learn(known, 0, label)
    assert known == [[3, 2.0]]


@pytest.mark.parametrize(
    "settings", [{"sigma": 0.0}, {"sigma": -1.0}, {"sure": 0.5}, {"sure": 1.0}, {"ratio": -0.1}]
)
def test_impossible_settings_are_refused(settings):
    """Oracle: ConfigError naming the attribute, also from a configuration."""
    with pytest.raises(ConfigError, match="diameter"):
        Attribute(name="diameter", **settings)
    config = AssociationConfig(method="nearest", attributes=(AttributeConfig(name="diameter", **settings),))
    with pytest.raises(ConfigError, match="diameter"):
        associator_from_config(config)


@pytest.mark.parametrize("degrees", [1, 2, 3, 7])
@pytest.mark.parametrize("probability", [0.0, 1e-6, 0.5, 0.95, 0.999, 1.0])
def test_gates_have_a_degree_for_each_measurement(degrees, probability):
    """Oracle: scipy's quantile."""
    np.testing.assert_allclose(chi_square(probability, degrees), chi2.ppf(probability, degrees), rtol=1e-9)


# --- two trees in one gate ----------------------------------------------------------------------------


def orchard(frames: int, swap_from: int = 10**9) -> list:
    """A vehicle that stands and sees two trees 0.2 m apart, one thin and one thick, with much noise in place and
    little in diameter, in random order."""
    rng, events = np.random.default_rng(7), []
    for k in range(frames):
        events.append(Odometry(k + 0.5, np.zeros((1, 2)), np.array([0.1])))
        order = rng.permutation(2) if k else np.arange(2)
        z = np.array([[10.0, 0.0], [10.2, 0.0]])[order] + rng.normal(0, [0.25, 0.005], (2, 2)) * (k > 0)
        thick = np.array([0.2, 0.6])[order] + rng.normal(0, 0.03, 2)
        ids = order.astype(np.int64)
        events.append(
            Sightings(k + 0.5, z, ids, attributes={"diameter": thick, "colour": (thick > 0.4) + 0.0})
        )
    return events


def founded_apart(method, attributes) -> LandmarkSlam:
    """A filter that has founded both trees, however near they are to each other."""
    slam = LandmarkSlam(
        VelocitySteering(sigma_speed=1e-3, sigma_steering=1e-3),
        RangeBearing(sigma_range=0.25),
        association=method(attributes=attributes, management=Keep()),
    )
    feed(slam, orchard(1))
    assert slam.landmark_count == 2
    return slam


@METHODS
@pytest.mark.parametrize("attribute", [DIAMETER, Attribute(name="colour", classes=True, sure=0.999)])
def test_two_trees_in_one_gate_are_told_apart_by_diameter(method, attribute):
    """Oracle: the simulated identities over 40 frames: with the attribute never wrong, without it often."""
    events = orchard(40)
    wrong = {}
    for name, attributes in (("place", ()), ("with attribute", (attribute,))):
        slam, count = founded_apart(method, attributes), 0
        for event in events[2:]:
            slam.step(event)
            if isinstance(event, Sightings):
                given = slam.frame_labels
                count += int(((given >= 0) & (given != event.ids)).sum())
        wrong[name] = count
        assert slam.landmark_count == 2
    assert wrong["place"] >= 15 and wrong["with attribute"] == 0


LABELLED = Attribute(name="diameter", classes=True)  # labels add no degree of freedom to the gates


def test_without_its_value_a_sighting_goes_by_place():
    """Oracle: the same frames without the attribute: the same answers where every value is NaN."""
    events = [
        Sightings(e.time, e.values, e.ids, attributes={"diameter": np.full(2, np.nan)})
        if isinstance(e, Sightings)
        else e
        for e in orchard(12)
    ]
    with_nan = feed(LandmarkSlam(association=Likelihood(attributes=(LABELLED,))), events)
    without = feed(LandmarkSlam(association=Likelihood()), events)
    np.testing.assert_array_equal(with_nan.estimate().joint()[1], without.estimate().joint()[1])
    assert all(count == 0 for count, _ in with_nan._memory["known"][0])


@METHODS
def test_an_attribute_alone_can_open_a_new_landmark(method):
    """Oracle: by hand: a trunk ten times as thick in the same place is another tree: far outside the wider gate."""
    slam = founded_apart(method, (DIAMETER,))
    slam.step(Sightings(0.9, np.array([[10.0, 0.0]]), attributes={"diameter": np.array([5.0])}))
    assert slam.frame_association.matched.tolist() == [NEW]
    assert slam._memory["known"][0][2] == [1, 5.0]


def test_the_memory_keeps_mean_and_count_by_landmark():
    """Oracle: dictionaries kept beside the run by lasting numbers, with landmarks coming and going."""
    rng, true = np.random.default_rng(3), np.random.default_rng(1).uniform(0.1, 0.9, 12)
    slam = LandmarkSlam(association=Nearest(attributes=(DIAMETER,), management=Trial(3, 5)))
    values: dict[int, list[float]] = {}
    for number, event in enumerate(circle_events(5, 30)):
        if isinstance(event, Sightings):
            z, measured = event.values, true[event.ids] + rng.normal(0, 0.03, len(event.ids))
            if number % 4 == 1:
                z = np.vstack([z, [rng.uniform(3, 25), rng.uniform(-1.2, 1.2)]])
                measured = np.append(measured, np.nan)
            event = Sightings(event.time, z, attributes={"diameter": measured})
        slam.step(event)
        if isinstance(event, Sightings):
            for label, value in zip(slam.frame_labels.tolist(), measured.tolist(), strict=True):
                if label >= 0 and np.isfinite(value):
                    values.setdefault(label, []).append(value)
    assert len(slam.rejected) >= 3
    for number, (count, mean) in zip(slam._ids, slam._memory["known"][0], strict=True):
        assert count == len(values.get(number, []))
        np.testing.assert_allclose(mean, np.mean(values[number]) if count else 0.0)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(slam._memory)) == slam._memory


# --- attributes that are not there --------------------------------------------------------------------


@METHODS
@pytest.mark.parametrize(
    "attributes",
    [None, {}, {"height": np.ones(1)}, {"diameter": np.ones(3)}],
    ids=["none", "empty", "other", "length"],
)
def test_a_missing_attribute_is_named(method, attributes):
    """Oracle: EventError with the attribute's name as the field; the filter as it was."""
    slam = founded_apart(method, (DIAMETER,))
    before = state_of(slam)
    with pytest.raises(EventError) as caught:
        slam.step(Sightings(2.0, np.array([[10.0, 0.0]]), attributes=attributes))
    assert caught.value.field == "diameter" and caught.value.time == 2.0
    assert state_of(slam) == before


def test_a_run_with_attributes_warms_up_and_names_what_is_missing():
    """Oracle: by hand: the log with attributes runs through; the one that loses them half-way ends there, naming it."""
    slam = LandmarkSlam(association=Likelihood(attributes=(DIAMETER, COLOUR)))
    events = orchard(6)
    assert run(slam, log_of(events)).error is None
    torn = [*events[:7], Sightings(3.5, events[7].values)]
    outcome = run(LandmarkSlam(association=slam.association), log_of(torn))
    assert outcome.error.field == "diameter" and outcome.frames == 3


def test_what_is_known_of_two_is_pooled_when_they_merge():
    """Oracle: the mean of all values by numpy, whichever of the two they went to; a label stays the kept one's."""
    values, attribute = [0.3, 0.4, 0.2, 0.5, 0.6], Attribute(name="diameter")
    known = [unknown(), unknown(), unknown()]
    for index, value in zip([0, 1, 0, 1, 1], values, strict=True):
        attribute.learn(known, index, value)
    attribute.pool(known, 0, 1)
    assert known[0][0] == 5 and known[0][1] == pytest.approx(np.mean(values))
    attribute.pool(known, 0, 2)
    assert known[0][1] == pytest.approx(np.mean(values))
    labels = [[2, 7.0], [3, 4.0]]
    Attribute(name="colour", classes=True).pool(labels, 0, 1)
    assert labels[0] == [5, 7.0]
