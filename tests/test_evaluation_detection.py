"""Precision and recall of detections."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from kalmap.evaluation.detection import detection_score, pair_detections
from kalmap.records import ConfigError


def plane(detections):
    return np.column_stack(
        [
            detections[:, 0] * np.cos(detections[:, 1]),
            detections[:, 0] * np.sin(detections[:, 1]),
        ]
    )


def least_total(a, b, cutoff):
    """The least sum of distances, capped at the cutoff, over all one-to-one assignments."""
    if len(a) > len(b):
        a, b = b, a
    distance = np.minimum(np.linalg.norm(plane(a)[:, None] - plane(b)[None], axis=2), cutoff)
    return min(
        sum(distance[i, j] for i, j in enumerate(order)) for order in permutations(range(len(b)), len(a))
    )


@pytest.mark.parametrize("seed", range(5))
def test_pairs_are_the_cheapest_one_to_one(seed):
    """Oracle: all permutations."""
    rng = np.random.default_rng(seed)
    found = [
        np.column_stack([rng.uniform(4, 6, n), rng.uniform(-0.2, 0.2, n)]) for n in rng.integers(0, 6, 8)
    ]
    given = [
        np.column_stack([rng.uniform(4, 6, n), rng.uniform(-0.2, 0.2, n)]) for n in rng.integers(0, 6, 8)
    ]
    rows, columns = pair_detections(found, given, 0.5)
    assert len(rows) and len(set(rows.tolist())) == len(rows) == len(set(columns.tolist()))
    mine, theirs = np.concatenate(found), np.concatenate(given)
    apart = np.linalg.norm(plane(mine[rows]) - plane(theirs[columns]), axis=1)
    assert (apart < 0.5).all()
    scan_of = [np.repeat(np.arange(8), [len(frame) for frame in frames]) for frames in (found, given)]
    assert np.array_equal(scan_of[0][rows], scan_of[1][columns])
    for k in range(8):
        here = scan_of[0][rows] == k
        unpaired = min(len(found[k]), len(given[k])) - here.sum()
        assert apart[here].sum() + 0.5 * unpaired == pytest.approx(least_total(found[k], given[k], 0.5))


def test_figures_of_a_known_case():
    given = [np.array([[10.0, 0.0], [20.0, 0.5]]), np.array([[30.0, 0.0]]), np.zeros((0, 2))]
    found = [np.array([[10.1, 0.01], [40.0, 0.0]]), np.zeros((0, 2)), np.array([[5.0, 0.0]])]
    (score,) = detection_score(found, given)
    assert (score.found, score.given, score.right, score.hit) == (3, 3, 1, 1)
    assert score.precision == score.recall == pytest.approx(1 / 3)
    assert score.range_bias == pytest.approx(0.1) and score.range_scatter == 0
    assert score.bearing_bias == pytest.approx(0.01) and score.bearing_scatter == 0


def test_stretches_of_range():
    """A partner just beyond an edge is still a partner; each list is counted by its own range."""
    given = [np.array([[9.9, 0.0], [15.0, 0.0], [15.0, 1.0]])]
    found = [np.array([[10.1, 0.0], [15.2, 0.0]])]
    near, far, nothing = detection_score(found, given, edges=(0, 10, 20, 30))
    assert (near.found, near.given, near.hit, near.precision, near.recall) == (0, 1, 1, None, 1.0)
    assert (far.found, far.given, far.precision, far.recall) == (2, 2, 1.0, 0.5)
    assert near.range_bias == pytest.approx(0.2)
    assert (nothing.precision, nothing.recall, nothing.range_bias, nothing.bearing_scatter) == (None,) * 4


def test_two_found_on_one_given_are_one_right():
    (score,) = detection_score([np.array([[10.0, 0.0], [10.1, 0.0]])], [np.array([[10.0, 0.0]])])
    assert score.precision == 0.5 and score.recall == 1.0


def test_bearings_are_compared_round_the_circle():
    """Oracle: 0.02 rad across the seam at pi."""
    (score,) = detection_score([np.array([[5.0, -3.1315926]])], [np.array([[5.0, 3.1315926]])])
    assert score.hit == 1 and score.bearing_bias == pytest.approx(2 * (np.pi - 3.1315926))


def test_no_scans_and_unequal_ones():
    (score,) = detection_score([], [])
    assert (score.found, score.given, score.precision, score.recall) == (0, 0, None, None)
    with pytest.raises(ConfigError, match="1 scans against those of 2"):
        detection_score([np.zeros((0, 2))], [np.zeros((0, 2))] * 2)
