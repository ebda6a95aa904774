"""Reflective poles in laser scans."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.perception import Detector, ReflectorDetector
from kalmap.records import EventError, Scan

BEARINGS = np.deg2rad(np.arange(20.0)) - 0.1


def scan(ranges, bits):
    filled = np.full((2, 20), [[np.inf], [0.0]])
    filled[0, : len(ranges)], filled[1, : len(bits)] = ranges, bits
    return Scan(3.0, filled[0], BEARINGS, filled[1], 5)


def test_neighbours_make_one_pole():
    detector: Detector = ReflectorDetector()
    seen = detector(scan([5, 5.1, 9, 5.2, 7, 7, 7, 7, 7, 8], [8192, 16384, 0, 8192, 0, 0, 0, 0, 0, 8192]))
    assert (seen.time, seen.record, seen.ids) == (3.0, 5, None)
    assert np.allclose(seen.values[:, 0], [5.1, 8.0])
    assert np.allclose(seen.values[:, 1], [BEARINGS[[0, 1, 3]].mean(), BEARINGS[9]])
    assert seen.attributes["reflectivity"].tolist() == [16384, 8192]
    assert seen.attributes["beams"].tolist() == [3, 1]


def test_a_step_in_range_parts_two_poles():
    both = scan([5, 5, 9, 9], [1, 1, 1, 1])
    assert ReflectorDetector()(both).values[:, 0].tolist() == [5.0, 9.0]
    assert len(ReflectorDetector(max_step=10.0)(both).values) == 1


@pytest.mark.parametrize("dead", [np.nan, np.inf, -np.inf, 0.0, -1.0, 81.91])
def test_beams_without_return_are_no_poles(dead):
    seen = ReflectorDetector()(scan([dead, 5.0], [1, 1]))
    assert seen.values[:, 0].tolist() == [5.0] and seen.attributes["beams"].tolist() == [1]


def test_intensities_that_are_no_number_are_no_reflectors():
    assert len(ReflectorDetector()(scan([5.0, 6.0], [np.nan, 0.0])).values) == 0


def test_parameters():
    one = scan([5, 5, 7, 7, 7, 7, 6], [1, 1, 0, 0, 0, 0, 3])
    assert len(ReflectorDetector(min_beams=2)(one).values) == 1
    assert ReflectorDetector(threshold=2)(one).values[:, 0].tolist() == [6.0]
    assert ReflectorDetector(radius=0.1)(one).values[0, 0] == pytest.approx(5.1)


@pytest.mark.parametrize("size", [0, 20])
def test_nothing_found(size):
    empty = Scan(1.0, np.full(size, np.inf), BEARINGS[:size], np.zeros(size))
    seen = ReflectorDetector()(empty)
    assert seen.values.shape == (0, 2) and len(seen.attributes["beams"]) == 0


def test_a_scan_without_proper_intensities_is_refused():
    with pytest.raises(EventError, match="field intensities"):
        ReflectorDetector()(Scan(1.0, np.ones(20), BEARINGS))
    with pytest.raises(EventError, match="expected as many"):
        ReflectorDetector()(Scan(1.0, np.ones(20), BEARINGS, np.ones(19)))
