"""What is believed of a place, and why not. By hand: one place changed in one thing at a time."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.slam.contours.belief import (
    FLOOR,
    GATE,
    contradicted,
    enough,
    is_elsewhere,
    judged,
    may_be_tried,
    squared_off,
)
from kalmap.slam.contours.matching import Overlay

SURE = np.diag([0.03**2, 0.04**2, 0.01**2])


def place(pose=(1.0, 2.0, 3.1), matched=20.0, agreement=0.9):
    return Overlay(np.array(pose), 1e-4 * np.eye(3), np.zeros((3, 3)), matched, agreement, 70.0, 70)


@pytest.mark.parametrize(
    ("places", "guess", "why"),
    [
        ([place()], [1.0, 2.0, 3.1], None),
        ([place()], [1.0, 2.0, 3.1 - 2.0 * np.pi], None),  # the same heading
        ([place(agreement=0.74)], [1.0, 2.0, 3.1], "only 74% of what lies side by side agrees"),
        ([place(), place((1.4, 2.0, 3.1), 17.0)], [1.0, 2.0, 3.1], "another place is nearly as good"),
        ([place(), place((1.0, 2.0, -3.0), 17.0)], [1.0, 2.0, 3.1], "another place is nearly as good"),
        ([place(), place((1.4, 2.0, 3.1), 15.0)], [1.0, 2.0, 3.1], None),  # not as good
        ([place(), place((1.2, 2.0, -3.1), 19.0)], [1.0, 2.0, 3.1], None),  # the same place
        ([place()], [0.8, 2.0, 3.1], "the place contradicts the drive: squared distance 18"),
    ],
)
def test_a_place_is_judged_by_itself_and_by_the_drive(places, guess, why):
    """The last one is 0.2 m off, with a variance of 18 + 2 (1 + 1) cm^2: 400 / 22 = 18."""
    covariance = SURE + np.diag([9e-4, 0.0, 0.0])
    verdict = judged(places, np.array(guess), covariance, 2.0)
    assert verdict.found is places[0] and verdict.why == why
    assert verdict.is_doubted == (why is not None and "drive" in why)
    followed = judged(places, np.array(guess), covariance, 2.0, following=True)
    assert followed.why == (
        None if verdict.is_doubted else why
    )  # half a metre is no doubt from one map to the next


def test_a_little_contour_is_no_place():
    assert judged([], np.zeros(3), SURE, 1.0) is None
    assert judged([place(matched=7.9)], np.array([1.0, 2.0, 3.1]), SURE, 1.0) is None


def test_how_far_off_a_place_is():
    """By hand, in units of the deviations."""
    found = place((1.0 + 0.03, 2.0 - 0.08, -3.1))
    spread = SURE - found.covariance - FLOOR
    turned = (2.0 * np.pi - 6.2) / 0.01
    assert squared_off(found, np.array([1.0, 2.0, 3.1]), spread) == pytest.approx(1.0 + 4.0 + turned**2)


def test_what_speaks_for_a_place_against_the_drive():
    assert may_be_tried(place(), 5.0 * GATE)
    assert not may_be_tried(place(agreement=0.84), 5.0 * GATE) and not may_be_tried(place(), 11.0 * GATE)
    assert enough([12.0, 9.0], 2, 20.0)
    assert not enough([12.0, 7.0], 2, 20.0) and not enough([30.0], 2, 20.0)


@pytest.mark.parametrize(
    ("overlays", "against"),
    [
        ([], False),
        ([place(), place(agreement=0.95)], False),
        ([place(), place(agreement=0.7)], True),  # one that disagrees
        ([place(), place(matched=5.0, agreement=0.7)], False),  # but of 7 m that lie side by side
        ([place(agreement=0.8), place(agreement=0.82)], True),  # none disagrees, all together do
    ],
)
def test_what_contradicts_a_belief(overlays, against):
    assert contradicted(iter(overlays)) == against


def test_places_are_two_by_way_or_by_turn():
    one = np.array([0.0, 0.0, 3.1])
    assert not is_elsewhere(one, np.array([0.2, 0.2, -3.1])) and is_elsewhere(one, np.array([0.3, 0.2, 3.1]))
    assert is_elsewhere(one, np.array([0.0, 0.0, -3.0])) and not is_elsewhere(
        one, one + [0.9, 0.0, 0.2], 1.0, 0.3
    )
