"""Trunks in laser scans: ray-cast worlds with known trunks, and the fit."""

from __future__ import annotations

import numpy as np
import pytest

from cast_scans import HERE, NOISE, STEP, look, plane, polar, scattered, whole
from kalmap.evaluation.detection import detection_score
from kalmap.perception.poles import ReflectorDetector
from kalmap.perception.trees import TreeDetector
from kalmap.records import Scan
from kalmap.simulate.raycast import SICK, cast_hits, noisy

FIND = TreeDetector()


@pytest.mark.parametrize("seed", range(5))
def test_scattered_trunks_are_found_and_nothing_else(seed):
    """Oracle: the world's own trunks. All that are seen whole within 30 m are found, and every detection is
    a trunk."""
    rng = np.random.default_rng(seed)
    trunks = scattered(rng, 40, apart=4.5)
    (scan,) = look(trunks, rng=rng)
    seen = FIND(scan)
    (score,) = detection_score([seen.values], [polar(trunks[:, :2])], cutoff=0.3)
    assert score.precision == 1.0
    (must,) = detection_score([seen.values], [polar(trunks[whole(trunks, 30.0), :2])], cutoff=0.3)
    assert must.given > 12 and must.recall == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_groves_need_less_clearance(seed):
    """Oracle: the world's own trunks, 1.5 m apart or more. With a clearance of 0.5 m most of those that are
    seen whole are found; at the default few are; either way every detection is a trunk."""
    rng = np.random.default_rng(10 + seed)
    trunks = scattered(rng, 30, apart=1.5, diameters=(0.15, 0.5), reach=12.0)
    (scan,) = look(trunks, rng=rng)
    must = [polar(trunks[whole(trunks, 12.0), :2])]
    close = TreeDetector(clearance=0.5)(scan)
    assert detection_score([close.values], must, cutoff=0.2)[0].recall >= 0.9
    for seen in (close, FIND(scan)):
        assert detection_score([seen.values], [polar(trunks[:, :2])], cutoff=0.2)[0].right == len(seen.values)
    assert len(FIND(scan).values) < len(close.values)


def test_centre_and_diameter_are_true():
    """Oracle: the true circle. Lone trunks, two beams' spacing wide or more, 0.1 to 1 m thick, 3 to 40 m away: the
    mean error is below 1 cm in the centre's range and 2 cm in the diameter, the scatter below 4 and 7 cm."""
    rng = np.random.default_rng(3)
    error = []
    for _ in range(1500):
        diameter = rng.uniform(0.1, 1.0)
        at = np.array([[rng.uniform(3.0, min(40.0, diameter / (2 * STEP))), rng.uniform(-1.2, 1.2)]])
        seen = FIND(look([[*plane(at)[0], diameter / 2]], rng=rng)[0])
        assert len(seen.values) == 1
        error.append([*(seen.values[0] - at[0]), seen.attributes["diameter"][0] - diameter])
    mean, scatter = np.mean(error, axis=0), np.std(error, axis=0)
    assert (np.abs(mean) < [0.01, 2e-4, 0.02]).all()
    assert (scatter < [0.04, 0.1 * STEP * 3, 0.07]).all()


def test_one_beam_places_the_centre_on_average():
    """Oracle: a trunk as wide as the beams' spacing is met by one beam, anywhere across it, and its diameter is then
    exact; the mean error of the centre vanishes, within four standard errors."""
    rng = np.random.default_rng(9)
    at = np.column_stack([np.full(800, 30.0), rng.uniform(-1.2, 1.2, 800)])
    radius = 30.0 * np.sin(STEP / 2)
    seen = [FIND(look([[*place, radius]], rng=rng)[0]) for place in plane(at)]
    alone = [frame for frame in seen if frame.attributes["beams"].tolist() == [1.0]]
    error = np.array([frame.values[0, 0] - 30.0 for frame in alone])
    assert len(alone) > 750
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error)) < 0.01
    assert np.allclose([frame.attributes["diameter"] for frame in alone], 2 * radius, rtol=0.005)


@pytest.mark.parametrize("diameter", [0.1, 0.3, 0.6])
def test_far_trunks_of_one_or_two_beams_stay_sane(diameter):
    """Oracle: n beams allow widths between n - 1 and n + 1 spacings; the centre lies behind the return by no
    more than that radius."""
    rng = np.random.default_rng(4)
    few = 0
    for _ in range(300):
        at = np.array([[rng.uniform(20.0, 55.0), rng.uniform(-1.2, 1.2)]])
        scan = look([[*plane(at)[0], diameter / 2]], rng=rng)[0]
        seen = FIND(scan)
        for (centre, bearing), d, n in zip(
            seen.values, seen.attributes["diameter"], seen.attributes["beams"]
        ):
            few += n <= 2
            spacing = STEP * centre
            assert max(0.0, 0.9 * (n - 1) * spacing - 0.05) < d < (n + 1) * spacing + 0.05
            assert 0 < centre - scan.ranges[np.isfinite(scan.ranges)].mean() < (n + 1) * spacing / 2 + 0.05
            assert abs(bearing - at[0, 1]) < STEP
    assert few > 60


def test_the_fit_is_the_least_squares_one():
    """Oracle: `scipy.optimize.least_squares` on residuals written down anew, from five starts' worth of trunks."""
    from scipy.optimize import least_squares

    from kalmap.kernels.clusters import fit_circle

    rng = np.random.default_rng(5)
    for _ in range(5):
        circle = [rng.uniform(5, 12), rng.uniform(-1, 1), rng.uniform(0.15, 0.5)]
        (scan,) = look([[*plane(np.array([circle[:2]]))[0], circle[2]]], rng=rng)
        hits = np.flatnonzero(np.isfinite(scan.ranges))
        x, y = (
            scan.ranges[hits] * np.cos(SICK.bearings[hits]),
            scan.ranges[hits] * np.sin(SICK.bearings[hits]),
        )
        outer = SICK.bearings[hits[0]] - STEP / 2, SICK.bearings[hits[-1]] + STEP / 2

        def residuals(c, x=x, y=y, outer=outer):
            out = np.hypot(x - c[0] * np.cos(c[1]), y - c[0] * np.sin(c[1])) - c[2]
            tangents = c[1] + np.array([-1, 1]) * np.arcsin(c[2] / c[0]) - outer
            return np.concatenate([out / 0.03, tangents * np.sqrt(12) / STEP])

        best = least_squares(residuals, circle, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        mine = np.array(circle) * [1.01, 1.0, 1.1]
        misfit = fit_circle(scan.ranges, SICK.bearings, hits, 0, len(hits), 0.03, mine)
        assert np.allclose(mine, best.x, atol=1e-6)
        assert misfit == pytest.approx(2 * best.cost / (len(hits) - 1), rel=1e-5)


@pytest.mark.parametrize(
    ("ahead", "left", "diameter", "found"),
    [
        (2.5, 0, 0.02, 0),
        (2.5, 0, 0.08, 1),
        (55, 0, 0.3, 1),
        (60, 0, 0.3, 0),
        (60, 0.26, 0.9, 1),
        (15, 0, 1.6, 0),
    ],
)
def test_what_is_too_thin_too_thick_or_too_far(ahead, left, diameter, found):
    """Oracle: by hand. n beams at r leave a width of (n - 1) to (n + 1) times 0.0087 r: one at 2.5 m less than
    5 cm, one at 60 m up to 1.05 m and so anything, two at 60 m a trunk."""
    assert len(FIND(look([[ahead, left, diameter / 2]])[0]).values) == found


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.5, 4.0])
def test_a_wall_is_no_trunk_and_hides_none_in_front(slope):
    """Oracle: the world, a wall at any incidence, and a trunk 5 m before it."""
    wall = np.array([[12.0, -30.0, 12.0 + 60 * slope, 30.0]])
    rng = np.random.default_rng(6)
    assert len(FIND(look(np.zeros((0, 3)), segments=wall, rng=rng)[0]).values) == 0
    seen = FIND(look([[7.0, 0.0, 0.2]], segments=wall, rng=rng)[0])
    assert np.allclose(seen.values, [[7.0, 0.0]], atol=0.05)


def test_boards_and_corners_are_not_round():
    """A board 0.8 m wide and slanted, and a corner that points away, from 4 m."""
    slanted = np.array([[4.0, -0.25, 4.6, 0.25]])
    corner = np.array([[4.0, -0.4, 4.4, 0.0], [4.4, 0.0, 4.0, 0.4]])
    for walls in (slanted, corner):
        assert len(FIND(look(np.zeros((0, 3)), segments=walls)[0]).values) == 0


def test_a_person_passes_for_a_trunk():
    """A known limit: a circle of 0.5 m is one, whoever it is."""
    seen = FIND(look([[9.0, 2.0, 0.25]], rng=np.random.default_rng(7))[0])
    assert len(seen.values) == 1 and seen.attributes["diameter"][0] == pytest.approx(0.5, abs=0.06)


def test_a_trunk_hidden_in_part_is_not_reported_beside_its_place():
    """Oracle: the true centres, while a trunk 14 m away passes behind another at 8 m."""
    found = []
    for across in np.linspace(-2.5, 2.5, 101):
        circles = np.array([[8.0, 0.0, 0.3], [14.0, across, 0.3]])
        seen = FIND(look(circles, rng=np.random.default_rng(8))[0])
        apart = np.linalg.norm(plane(seen.values)[:, None] - circles[None, :, :2], axis=2)
        assert (apart.min(axis=1) < 0.12).all()
        found.append(len(seen.values))
    assert found[0] == found[-1] == 2 and found[50] == 1


@pytest.mark.parametrize("seed", range(3))
def test_reflective_poles_among_trunks(seed):
    """Oracle: the world's poles. Tape answers as far as 25 m; poles seen whole are found, and nothing else."""
    rng = np.random.default_rng(20 + seed)
    trunks = scattered(rng, 30, apart=3.0, diameters=(0.2, 0.3), reach=25.0)
    ranges, targets = cast_hits(HERE, trunks, SICK.bearings, SICK.max_range)
    taped = 12
    bits = np.where((targets >= 0) & (targets < taped), 16384.0, 0.0)
    seen = ReflectorDetector(radius=0.1)(Scan(0.0, noisy(ranges, NOISE, rng)[0], SICK.bearings, bits[0]))
    assert seen.scan.intensities is not None
    (score,) = detection_score([seen.values], [polar(trunks[:taped, :2])], cutoff=0.3)
    (must,) = detection_score(
        [seen.values], [polar(trunks[:taped][whole(trunks, 25.0)[:taped], :2])], cutoff=0.3
    )
    assert score.precision == 1.0 and must.given > 3 and must.recall == 1.0
