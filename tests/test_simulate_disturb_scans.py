"""Logs of scans made worse: each change is there, and nothing else changes."""

import math
import pickle

import numpy as np
import pytest

from kalmap.records import ConfigError, Log, Odometry, RunConfig, Scan
from kalmap.simulate import (
    simulate,
    with_bad_ranges,
    with_beams,
    with_clock_jump,
    with_cover,
    without_odometry,
    without_scans,
    world_by_name,
)


@pytest.fixture(scope="module")
def log():
    return simulate(world_by_name("standstill"), 1)


def scans(log):
    return [event for event in log if isinstance(event, Scan)]


def test_bad_ranges_come_in_the_share_stated(log):
    """Oracle: the binomial distribution, each of the three kinds by itself, among beams that had a return."""
    bad = with_bad_ranges(log, 0.15, 4)
    before, after = (np.array([scan.ranges for scan in scans(each)]) for each in (log, bad))
    had = np.isfinite(before)
    spread = 4 * math.sqrt(0.05 * 0.95 / had.sum())
    for kind in (np.isnan(after), np.isinf(after), after == 0.0):
        assert kind[had].mean() == pytest.approx(0.05, abs=spread)
    good = np.isfinite(after) & (after > 0.0)
    np.testing.assert_array_equal(after[good], before[good])
    again = np.array([scan.ranges for scan in scans(with_bad_ranges(log, 0.15, 4))])
    np.testing.assert_array_equal(again, after)
    assert bad.settings["bad_ranges"] == {"share": 0.15, "seed": 4} and "world" in bad.settings
    assert len(list(pickle.loads(pickle.dumps(bad)))) == len(list(log))


@pytest.mark.parametrize("count", [1, 2, 100, 683, 5000])
def test_beams_are_spread_over_the_same_angle(log, count):
    before, after = scans(log)[3], scans(with_beams(log, count))[3]
    assert after.ranges.shape == after.bearings.shape == (count,)
    if count > 1:
        np.testing.assert_allclose(after.bearings[[0, -1]], before.bearings[[0, -1]], atol=1e-12)
    else:
        assert after.bearings[0] == pytest.approx(0.0, abs=1e-12)
    low = np.clip(np.searchsorted(before.bearings, after.bearings - 1e-9) - 1, 0, None)
    high = np.clip(np.searchsorted(before.bearings, after.bearings + 1e-9), None, len(before.bearings) - 1)
    for k in range(count):  # between the least and the greatest of the beams around it
        around = before.ranges[low[k] : high[k] + 1]
        assert around.min() - 1e-9 <= after.ranges[k] <= around.max() + 1e-9
    if count == 683:
        np.testing.assert_allclose(after.ranges, before.ranges, atol=1e-9)


def test_a_new_beam_ends_between_neighbours_of_one_surface_only():
    angles, ranges = np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 1.08, 3.0, np.inf])
    small = Log(
        name="s", source="s", defaults=RunConfig(), open=lambda skip: iter([Scan(0.0, ranges, angles)])
    )
    (scan,) = list(with_beams(small, 13))
    np.testing.assert_allclose(scan.ranges[:5], 1.0 + 0.08 * np.arange(5) / 4)
    np.testing.assert_array_equal(scan.ranges[5:9], [1.08, 3.0, 3.0, 3.0])
    np.testing.assert_array_equal(scan.ranges[9:], [3.0, np.inf, np.inf, np.inf])


def test_beams_of_scans_that_have_one_or_none():
    found = [Scan(0.0, np.zeros(0), np.zeros(0)), Scan(1.0, np.array([2.0]), np.array([0.3]))]
    small = Log(name="s", source="s", defaults=RunConfig(), open=lambda skip: iter(found))
    none, one = list(with_beams(small, 3))
    assert none.ranges.shape == (0,)
    np.testing.assert_array_equal(one.ranges, 2.0)


def test_what_is_left_out_is_out(log):
    assert {type(event) for event in without_odometry(log)} == {Scan}
    assert {type(event) for event in without_scans(log)} == {Odometry}
    assert len(list(without_odometry(log))) == len(scans(log))


@pytest.mark.parametrize("by", [100.0, -7.0])
def test_the_clock_jumps_once(log, by):
    before = np.array([event.time for event in log])
    after = np.array([event.time for event in with_clock_jump(log, 30.0, by)])
    np.testing.assert_allclose(after - before, np.where(before >= 30.0, by, 0.0), atol=1e-9)


def test_a_cover_hides_its_beams_and_no_others(log):
    """Oracle: the beams by their bearings; its noise by the standard deviation of thousands."""
    hidden = with_cover(log, 100.0, 110.0, 0.25, 6)
    before, after = (np.array([scan.ranges for scan in scans(each)]) for each in (log, hidden))
    angles = np.rad2deg(scans(log)[0].bearings)
    mask = (angles >= 100.0) & (angles <= 110.0)
    assert mask.sum() > 20
    np.testing.assert_array_equal(after[:, ~mask], before[:, ~mask])
    assert after[:, mask].mean() == pytest.approx(0.25, abs=5e-4)
    assert after[:, mask].std() == pytest.approx(0.005, rel=0.1)


def test_what_cannot_be_is_refused(log):
    for share in (-0.1, 1.1, math.nan):
        with pytest.raises(ConfigError, match="share"):
            with_bad_ranges(log, share, 1)
    for count in (0, 1_000_000):
        with pytest.raises(ConfigError, match="beams"):
            with_beams(log, count)
    for distance in (0.0, -1.0, math.nan):
        with pytest.raises(ConfigError, match="cover"):
            with_cover(log, 0.0, 10.0, distance, 1)
    with pytest.raises(ConfigError, match="clock"):
        with_clock_jump(log, math.inf, 1.0)
