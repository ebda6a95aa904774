"""Looks of components: against an extended Kalman filter and sigma points in plain numpy, edges against scipy."""

from __future__ import annotations

import os

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import finite_sets as plain
from finite_sets import CENTRED, MOUNTED, NO_BEAMS, NO_NOISE, RULES, rules_of, setup_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.frame import corrected, likelihood
from kalmap.kernels.looks import detection, found, look, lower_root, sight

WIDE = np.array([-1.0, -1.0, -1.0, 0.4])  # the sensor's noise, and things 0.4 m wide
STATED = np.array([0.2, -0.015, 0.03, 0.0])  # root of a frame's own noise, with a cross term


def kernel_look(setup, pose, root, row, noise=NO_NOISE) -> np.ndarray:
    out = np.zeros(sets.LOOK)
    look(setup, pose, root, row, noise, np.empty((4, 12)), out)
    return out


def lower(row, first: int) -> np.ndarray:
    return np.array([[row[first], 0.0], [row[first + 1], row[first + 2]]])


def apart(row: np.ndarray, expected: plain.Look) -> float:
    """How far the kernel's row is from the plain look: the worst entry of innovation covariance, gain and covariance
    after, relative to itself and the largest entry together. Its roots are factors, and what it expects is the same.
    """
    innovation, after = lower(row, sets.W11), lower(row, sets.U11)
    assert (np.diag(innovation) > 0.0).all()
    assert (np.diag(after) > 0.0).all()
    np.testing.assert_allclose(row[sets.RANGE], expected.predicted[0], rtol=1e-12)
    assert abs(plain.wrap(row[sets.BEARING] - expected.predicted[1])) < 1e-12
    assert -np.pi <= row[sets.BEARING] < np.pi

    off = np.array([0.3, -0.02])
    squared = off @ np.linalg.solve(expected.innovation, off)
    density = multivariate_normal.pdf(off, np.zeros(2), expected.innovation)
    np.testing.assert_allclose(likelihood(row, squared), density, rtol=1e-7)
    pairs = (
        (innovation @ innovation.T, expected.innovation),
        (row[sets.K11 : sets.K22 + 1].reshape(2, 2), expected.gain),
        (after @ after.T, expected.after),
    )
    return float(
        np.max([np.abs(got - wanted) / (np.abs(wanted) + np.abs(wanted).max()) for got, wanted in pairs])
    )


@pytest.mark.parametrize("noise", [NO_NOISE, STATED, WIDE], ids=["sensor", "stated", "extent"])
@pytest.mark.parametrize("mount", [CENTRED, MOUNTED], ids=["centred", "mounted"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "uncertain"])
def test_jacobian_is_the_extended_kalman_filter(noise, mount, known):
    """Oracle: numeric derivatives, innovation covariance, gain and Joseph's form in dense numpy."""
    rng = np.random.default_rng(1)
    setup, worst = setup_of("jacobian", mount, ratio_range=0.01), []
    for _ in range(100):
        pose = np.array([*rng.uniform(-30, 30, 2), rng.uniform(-np.pi, np.pi)])
        spread = np.zeros((3, 3)) if known else plain.random_spread(rng, 3, 0.1)
        root = spread if known else np.linalg.cholesky(spread)
        row = plain.random_row(rng, pose, 4.0, 40.0, rng.choice([0.05, 0.5, 3.0]))
        expected = plain.look_by_jacobian(setup, mount, pose, spread, row, noise)
        worst.append(apart(kernel_look(setup, pose, root, row, noise), expected))
    assert len(worst) == 100
    assert np.max(worst) <= 1e-8


@pytest.mark.parametrize("noise", [NO_NOISE, STATED, WIDE], ids=["sensor", "stated", "extent"])
@pytest.mark.parametrize("mount", [CENTRED, MOUNTED], ids=["centred", "mounted"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "uncertain"])
@pytest.mark.parametrize("rule", ["cubature", "central", "central-2"])
def test_points_are_a_sigma_point_filter_over_pose_and_feature(rule, noise, mount, known):
    """Oracle: the rule's textbook points and weights over the five dimensions, P - K S K' in dense numpy."""
    rng = np.random.default_rng(2)
    setup, worst = setup_of(rule, mount, ratio_range=0.01), []
    for _ in range(100):
        pose = np.array([*rng.uniform(-30, 30, 2), rng.uniform(-np.pi, np.pi)])
        root = np.zeros((3, 3)) if known else np.linalg.cholesky(plain.random_spread(rng, 3, 0.1))
        row = plain.random_row(rng, pose, 4.0, 40.0, rng.choice([0.05, 0.5, 2.0]))
        expected = plain.look_by_points(setup, mount, pose, root, row, rule, noise)
        worst.append(apart(kernel_look(setup, pose, root, row, noise), expected))
    assert len(worst) == 100
    assert np.max(worst) <= 1e-8


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("side", [-1e-3, -1e-12, 0.0, 1e-12, 1e-3])
def test_right_behind_where_the_bearing_wraps(rule, side):
    """Oracle: the plain filters, and the same look with everything turned by a quarter."""
    rng = np.random.default_rng(3)
    setup, pose = setup_of(rule), np.array([1.0, 2.0, 0.0])
    root = np.linalg.cholesky(plain.random_spread(rng, 3, 0.1))
    row = plain.component(0.7, [-9.0, 2.0 + side], [[0.3, 0.1], [0.1, 0.4]])
    got = kernel_look(setup, pose, root, row)
    if rule == "jacobian":
        expected = plain.look_by_jacobian(setup, CENTRED, pose, root @ root.T, row)
    else:
        expected = plain.look_by_points(setup, CENTRED, pose, root, row, rule)
    assert apart(got, expected) <= 1e-8
    away = kernel_look(setup, pose + [0.0, 0.0, 0.5 * np.pi], root, row)
    np.testing.assert_allclose(np.delete(away, sets.BEARING), np.delete(got, sets.BEARING), atol=1e-12)


def test_sight_equals_complex_numbers():
    """Oracle: the plain sensor, which turns by multiplying with complex numbers."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        pose = np.array([*rng.uniform(-30, 30, 2), rng.uniform(-7, 7)])
        place = rng.uniform(-60, 60, 2)
        got = np.array(sight(setup_of(mount=MOUNTED), *pose, *place))
        expected = plain.sight(MOUNTED, pose, place)
        np.testing.assert_allclose(got[0], expected[0], rtol=1e-12)
        assert abs(plain.wrap(got[1] - expected[1])) < 1e-12


def test_lower_root_equals_a_cholesky_factor():
    """Oracle: numpy's Cholesky factor of A A', over twenty orders of magnitude between the rows."""
    rng = np.random.default_rng(5)
    for _ in range(200):
        rows = rng.standard_normal((2, 7)) * 10.0 ** rng.uniform(-10, 10, (2, 1))
        expected = np.linalg.cholesky(rows @ rows.T)
        got = lower_root(rows[0].copy(), rows[1].copy(), 7)
        np.testing.assert_allclose(got, expected[[0, 1, 1], [0, 0, 1]], rtol=1e-9)


@pytest.mark.parametrize("noise", [NO_NOISE, STATED, WIDE], ids=["sensor", "stated", "extent"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "uncertain"])
def test_what_a_sighting_founds(noise, known):
    """Oracle: the inverse sensor in plain numpy, its numeric Jacobian over (pose, range, bearing)."""
    rng = np.random.default_rng(6)
    setup = setup_of("cubature", MOUNTED, ratio_range=0.02)
    for _ in range(100):
        pose = np.array([*rng.uniform(-30, 30, 2), rng.uniform(-np.pi, np.pi)])
        z = np.array([rng.uniform(0.5, 40.0), rng.uniform(-np.pi, np.pi)])
        joint = np.zeros((5, 5))
        joint[:3, :3] = 0.0 if known else plain.random_spread(rng, 3, 0.1)
        joint[3:, 3:] = plain.noise_of(setup, noise, z[0])
        root = np.zeros((3, 3)) if known else np.linalg.cholesky(joint[:3, :3])
        out = np.zeros(sets.COLUMNS)
        found(setup, pose, root, z, noise, np.empty((2, 12)), out)
        matrix = plain.slopes(lambda v: plain.locate(MOUNTED, v[:3], v[3:]), np.array([*pose, *z]))
        np.testing.assert_allclose(out[[sets.X, sets.Y]], plain.locate(MOUNTED, pose, z), atol=1e-12)
        expected = matrix @ joint @ matrix.T
        np.testing.assert_allclose(plain.covariance(out), expected, atol=1e-9 * expected.max())
        assert out[sets.L11] > 0.0
        assert out[sets.L22] > 0.0


@pytest.mark.parametrize("bearing", [0.0, 0.4, 0.5 * np.pi, -np.pi])
@pytest.mark.parametrize("distance", [0.0, 1e-300, 1e-9])
def test_a_sighting_at_the_sensor_founds_a_factor(distance, bearing):
    """Oracle: a covariance has two positive eigenvalues, not smaller than the range noise seen at an arm's length."""
    out = np.zeros(sets.COLUMNS)
    z = np.array([distance, bearing])
    found(setup_of(), np.zeros(3), np.zeros((3, 3)), z, NO_NOISE, np.empty((2, 12)), out)
    values = np.linalg.eigvalsh(plain.covariance(out))
    np.testing.assert_allclose(values[1], 0.1**2, rtol=1e-6)
    assert np.sqrt(values[0]) >= 0.1 * 0.02 * (1.0 - 1e-6)
    assert out[sets.L11] > 0.0
    assert out[sets.L22] > 0.0


# --- the probability of detection -------------------------------------------------------------------------------


def seen_as(distance, bearing, cov=((0.01, 0.0), (0.0, 0.0004))) -> np.ndarray:
    row = np.zeros(sets.LOOK)
    root = np.linalg.cholesky(np.array(cov))
    row[[sets.RANGE, sets.BEARING]] = distance, bearing
    row[[sets.W11, sets.W21, sets.W22]] = root[0, 0], root[1, 0], root[1, 1]
    return row


def test_soft_edges_of_the_view():
    """Oracle: scipy's normal distribution of what is left to each edge, over the innovation's own deviations."""
    cov = np.array([[0.09, 0.004], [0.004, 0.0016]])
    rules = rules_of(MAX_RANGE=30.0, MIN_RANGE=2.0, HALF_VIEW=1.2)
    profile = np.array([0.9])
    for distance in [1.0, 1.9, 2.0, 2.3, 15.0, 29.5, 30.0, 30.4, 33.0]:
        for bearing in [-1.6, -1.21, -1.2, -1.15, 0.0, 1.19, 1.2, 1.3]:
            expected = 0.9 * norm.cdf((30.0 - distance) / 0.3) * norm.cdf((distance - 2.0) / 0.3)
            expected *= norm.cdf((1.2 - abs(bearing)) / 0.04)
            got = detection(rules, profile, NO_BEAMS, seen_as(distance, bearing, cov))
            assert got == pytest.approx(expected, rel=1e-7, abs=2e-9)  # six deviations count as sure


def test_all_around_has_no_edge():
    """Oracle: the profile alone, right behind as well as ahead."""
    for bearing in [0.0, 3.1, -np.pi]:
        assert detection(rules_of(), np.array([0.8]), NO_BEAMS, seen_as(10.0, bearing)) == 0.8


@pytest.mark.parametrize("rings", [1, 2, 7])
def test_rings_are_joined_by_lines(rings):
    """Oracle: numpy.interp over the middles of the rings, level before the first and after the last."""
    rules, profile = rules_of(RINGS=rings), np.linspace(0.95, 0.3, rings) ** 2
    middles = (np.arange(rings) + 0.5) * 50.0 / rings
    for distance in np.linspace(0.0, 49.0, 99):
        got = detection(rules, profile, NO_BEAMS, seen_as(distance, 0.3))
        assert got == pytest.approx(np.interp(distance, middles, profile), rel=1e-12)


def test_hidden_behind_the_nearest_beam():
    """Oracle: the nearest beam by brute force; it hides what lies deeper behind its end than DEPTH; no return hides
    nothing; nothing is seen beyond the sweep's own ends."""
    rng = np.random.default_rng(7)
    bearings = np.sort(rng.uniform(-1.5, 1.5, 181))
    ranges = np.where(rng.random(181) < 0.2, 0.0, rng.uniform(3.0, 30.0, 181))
    beams = np.stack([bearings, ranges], axis=1)
    for _ in range(2000):
        distance, bearing = rng.uniform(1.0, 40.0), rng.uniform(-1.7, 1.7)
        end = ranges[np.argmin(np.abs(bearings - bearing))]
        hidden = not bearings[0] < bearing < bearings[-1] or 0.0 < end < distance - 1.0
        got = detection(rules_of(), np.array([0.9]), beams, seen_as(distance, bearing))
        assert got == (0.0 if hidden else 0.9)


def test_a_sweep_all_around_has_no_blind_beam():
    """Oracle: 360 beams one degree apart, the last one before 180 degrees: between it and the first one, the nearer
    of the two decides."""
    bearings = np.radians(np.arange(-180.0, 180.0))
    ranges = np.full(360, 30.0)
    ranges[0] = 5.0
    beams, profile = np.stack([bearings, ranges], axis=1), np.array([0.9])
    assert detection(rules_of(), profile, beams, seen_as(10.0, np.radians(179.3))) == 0.9
    assert detection(rules_of(), profile, beams, seen_as(10.0, np.radians(179.7))) == 0.0
    assert detection(rules_of(), profile, beams, seen_as(10.0, np.radians(-180.0))) == 0.0
    assert detection(rules_of(), profile, beams, seen_as(4.0, np.radians(179.7))) == 0.9


def test_nothing_is_sighted_for_sure():
    """Oracle: ln(1 - P_D), the weight of a miss, must be finite."""
    got = detection(rules_of(), np.array([1.0]), NO_BEAMS, seen_as(10.0, 0.3))
    assert np.isfinite(np.log(1.0 - got))
    assert got == pytest.approx(1.0, abs=1e-5)


# --- factors stay factors ---------------------------------------------------------------------------------------


def run_of_updates(count: int, seed: int) -> tuple[int, float]:
    """Random components, corrected some two hundred times each by random looks of every rule: never a bad factor.

    Returns how many corrected rows were finite, and the least diagonal entry of all their roots.
    """
    rng = np.random.default_rng(seed)
    names = list(RULES)
    scratch, out, row = np.empty((4, 12)), np.empty(sets.LOOK), np.zeros(sets.COLUMNS)
    done, finite, least = 0, 0, np.inf
    while done < count:
        run = min(int(rng.integers(1, 400)), count - done)
        done += run
        setup = setup_of(
            names[rng.integers(len(names))],
            MOUNTED if rng.random() < 0.5 else CENTRED,
            10.0 ** rng.uniform(-4, 1),
            rng.choice([0.0, 0.02]),
            10.0 ** rng.uniform(-5, -0.5),
        )
        noise = STATED if rng.random() < 0.2 else NO_NOISE
        pose = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-np.pi, np.pi)])
        root = np.zeros((3, 3))
        if rng.random() < 0.5:
            root = np.linalg.cholesky(plain.random_spread(rng, 3, 10.0 ** rng.uniform(-5, 0)))
            root[rng.integers(3)] *= rng.integers(2)
        z = np.array([rng.uniform(0.0, 80.0), rng.uniform(-np.pi, np.pi)])
        found(setup, pose, root, z, noise, scratch, row)
        true = row[[sets.X, sets.Y]].copy()
        steps = 0.5 * rng.standard_normal((run, 3))
        errors = rng.standard_normal((run, 2))
        for k in range(run):
            pose = pose + steps[k]
            look(setup, pose, root, row, noise, scratch, out)
            assert np.isfinite(out[: sets.DETECTION]).all()
            assert np.isfinite(out[sets.NORM])
            assert min(out[sets.W11], out[sets.W22], out[sets.U11], out[sets.U22]) > 0.0
            distance, bearing = sight(setup, *pose, *true)
            nu = np.array([distance - out[sets.RANGE], plain.wrap(bearing - out[sets.BEARING])])
            nu = nu + lower(out, sets.W11) @ errors[k]
            corrected(row, out, nu, row)
            assert np.isfinite(row).all()
            finite += 1
            least = min(least, row[sets.L11], row[sets.L22], out[sets.W11], out[sets.W22])
    return finite, float(least)


def test_ten_thousand_updates_keep_a_factor():
    """Oracle: a factor is lower triangular, finite, with a positive diagonal."""
    finite, least = run_of_updates(10_000, 11)
    assert finite == 10_000
    assert 0.0 < least < np.inf


@pytest.mark.slow
def test_very_many_updates_keep_a_factor():
    """Oracle: as above, 50,000 updates of each of KALMAP_SLOW_SEEDS seeds (default 20: a million)."""
    for seed in range(int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))):
        finite, least = run_of_updates(50_000, 12 + seed)
        assert finite == 50_000
        assert 0.0 < least < np.inf
