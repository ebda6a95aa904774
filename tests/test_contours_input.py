"""What a scan may hold and still be cut: bad ranges, any order of the beams, one beam and thousands."""

from __future__ import annotations

import numpy as np
import pytest

from contour_scans import FULL, LASER, room, scan_of
from kalmap.perception import CutConfig, cut_scan, share_on_contours
from kalmap.records import ConfigError, EventError, Scan
from kalmap.simulate import simulate, with_bad_ranges, world_by_name
from kalmap.view import contour_warnings


def finite(pieces):
    return all(np.isfinite(getattr(pieces, name)).all() for name in pieces.__struct_fields__)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -3.0, 80.0, 1e300])
def test_what_is_no_range_is_passed_over(value):
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(0))
    bad = np.random.default_rng(1).choice(361, 15, replace=False)
    ranges = scan.ranges.copy()
    ranges[bad] = value
    pieces = cut_scan(Scan(0.0, ranges, scan.bearings), LASER)
    assert len(pieces) == 3 and finite(pieces)
    assert not np.isin(pieces.beam, bad).any() and len(pieces.beam) == 361 - 15


def test_no_range_at_all_is_no_piece():
    for ranges in ([], [np.nan], [1.0], [1.0, 1.0], [np.inf] * 5, [1.0, 1.0, 1.0]):
        pieces = cut_scan(Scan(0.0, np.array(ranges), 0.01 * np.arange(len(ranges))), LASER)
        assert len(pieces) == 0 and pieces.coef.shape == (0, 10) and pieces.ends.shape == (0, 2, 2)


def test_the_order_of_the_beams_does_not_matter():
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(2))
    order = np.random.default_rng(3).permutation(361)
    plain, mixed = (cut_scan(s, LASER) for s in (scan, Scan(0.0, scan.ranges[order], scan.bearings[order])))
    np.testing.assert_array_equal(mixed.coef, plain.coef)
    np.testing.assert_array_equal(mixed.points, plain.points)
    np.testing.assert_array_equal(order[mixed.first], plain.first)
    np.testing.assert_array_equal(order[mixed.beam], plain.beam)


def test_doubled_beams_count_once():
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(4))
    twice = Scan(0.0, np.repeat(scan.ranges, 2), np.repeat(scan.bearings, 2))
    plain, doubled = cut_scan(scan, LASER), cut_scan(twice, LASER)
    np.testing.assert_array_equal(doubled.coef, plain.coef)
    np.testing.assert_array_equal(doubled.first, 2 * plain.first)


def test_a_bearing_that_is_no_number_takes_its_beam_away():
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(5))
    bearings = scan.bearings.copy()
    bearings[[3, 100]] = np.nan, np.inf
    pieces = cut_scan(Scan(0.0, scan.ranges, bearings), LASER)
    assert len(pieces) == 3 and len(pieces.beam) == 359 and finite(pieces)


def test_where_a_full_circle_starts_does_not_matter():
    """The same beams from 0 to 360 and from -180 to 180 degrees."""
    world = room(-3, -2, 4, 3)
    one = scan_of(walls=world, bearings=FULL, rng=np.random.default_rng(6))
    other = Scan(0.0, np.roll(one.ranges, -360), np.roll(one.bearings, -360) % (2.0 * np.pi))
    first, second = cut_scan(one, LASER), cut_scan(other, LASER)
    order = [np.argmin(np.linalg.norm(second.origin - origin, axis=1)) for origin in first.origin]
    np.testing.assert_allclose(second.ends[order], first.ends, atol=1e-9)
    assert sorted(order) == [0, 1, 2, 3]


def test_five_thousand_beams_make_the_same_room():
    bearings = np.linspace(-np.pi, np.pi, 5_000, endpoint=False)
    pieces = cut_scan(
        scan_of(walls=room(-3, -2, 4, 3), bearings=bearings, rng=np.random.default_rng(7)), LASER
    )
    assert len(pieces) == 4 and (pieces.order == 1).all() and finite(pieces)


@pytest.mark.parametrize("seed", range(30))
def test_noise_of_any_kind_gives_finite_pieces(seed):
    """Scans that no world makes: uniform ranges, steps, tiny ones, spikes; whatever comes out is finite and sound."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 400))
    bearings = np.sort(rng.uniform(-np.pi, np.pi, count)) if seed % 2 else np.linspace(-2.0, 2.0, count)
    made = [
        rng.uniform(0.0, 10.0, count),
        np.repeat(rng.uniform(0.1, 5.0, count), 7)[:count],
        np.full(count, 1e-9),
    ]
    ranges = made[seed % 3].copy()
    ranges[rng.random(count) < 0.1] = rng.choice([np.nan, np.inf, 0.0, 1e12])
    pieces = cut_scan(Scan(0.0, ranges, bearings), LASER)
    assert finite(pieces)
    for k in range(len(pieces)):
        cov = pieces.cov[k]
        assert np.linalg.eigvalsh(cov).min() > -1e-9 * np.trace(cov)
        assert pieces.lengths[k] >= 0.05 and (pieces.piece == k).sum() >= 4


def test_what_does_not_fit_is_refused():
    with pytest.raises(EventError, match="as long"):
        cut_scan(Scan(0.0, np.ones(3), np.zeros(4)), LASER)
    for wrong in ({"split_cost": 0.0}, {"roughness": -1.0}, {"min_points": 2}, {"max_order": 4}):
        with pytest.raises(ConfigError):
            CutConfig(**wrong)


def test_the_share_of_ranges_on_contours():
    """Oracle: how many beams end on a wall, the others anywhere between 1 and 9 m behind a half circle of wall."""
    rng = np.random.default_rng(8)
    angles = np.deg2rad(np.arange(-90.0, 90.0))
    scans = []
    for walls in rng.permutation(np.repeat([180, 150, 90], 4)).tolist():
        ranges = np.where(np.arange(180) < walls, 5.0, rng.uniform(1.0, 9.0, 180))
        scans.append(Scan(0.0, ranges, angles))
    assert share_on_contours(scans, LASER) == pytest.approx((180 + 150 + 90) / 540, abs=0.02)
    assert share_on_contours(scans[:1] * 1000, LASER, most=5) == share_on_contours(scans[:1], LASER)
    assert (
        share_on_contours([], LASER) is share_on_contours([Scan(0.0, angles * np.nan, angles)], LASER) is None
    )


@pytest.mark.parametrize("name", ["floor-115", "office", "crowd", "hall"])
def test_scans_with_most_ranges_bad_are_told_and_good_ones_are_not(name):
    """Twenty scans all over the drive, as they are, with every third range bad, and with three of five."""
    log = simulate(world_by_name(name), 3)
    for bad, told in ((0.0, 0), (0.3, 0), (0.6, 1)):
        scans = [event for event in with_bad_ranges(log, bad, 5) if isinstance(event, Scan)]
        share = share_on_contours(scans, log.defaults.sensor, most=20)
        warnings = contour_warnings({"ranges_on_contours_share": share})
        assert len(warnings) == told and all("on no contour" in each for each in warnings)


@pytest.mark.parametrize(
    ("latency", "sigma", "said"),
    [(0.15, 0.01, "150 ms later"), (-0.05, 0.01, "50 ms earlier"), (0.02, 0.001, None), (0.05, 0.02, None)],
)
def test_late_stamps_are_told(latency, sigma, said):
    """Not what is too little to matter, nor what may be chance."""
    warnings = contour_warnings({"latency_s": latency, "latency_sigma_s": sigma})
    assert [said in each for each in warnings] == ([True] if said else [])
