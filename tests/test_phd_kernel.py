"""The PHD update of a map: equations of the papers in plain numpy, edges and frames by hand."""

from __future__ import annotations

import os

import numpy as np
import pytest

import finite_sets as plain
from finite_sets import Scene, random_scene, rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.phd import intensity, phd_update
from set_problems import BARE, ROOT, STRATEGIES, run_of_frames, updated_intensity


@pytest.mark.parametrize(
    "rule, root", [("jacobian", 0.0), ("jacobian", 1.0), ("cubature", 1.0), ("central", 0.0)]
)
@pytest.mark.parametrize("components, sightings", [(1, 0), (1, 1), (3, 2), (6, 5), (4, 0)])
def test_the_updated_intensity(rule, root, components, sightings):
    """Oracle: equations (30) to (32) over the plain looks: weights, means, covariances, ids and counts of sightings."""
    rng = np.random.default_rng(41)
    for near in (None, 0.5):
        scene = random_scene(
            rng, components, sightings, rules_of(**BARE), near=near, rule=rule, root=root * ROOT
        )
        outcome = scene.update(phd_update)
        expected, explained = updated_intensity(scene)
        got, expected = plain.heaviest_first(outcome.rows), plain.heaviest_first(expected)
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(outcome.explained, explained, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("name", STRATEGIES)
def test_no_sighting_is_a_frame_too(name):
    """Oracle: by hand: every weight times 1 - P_D, places as they were; exp(-sum P_D w) for the cluster."""
    rng = np.random.default_rng(47)
    rules = rules_of(WEIGHTING=STRATEGIES[name], **BARE)
    scene = random_scene(rng, 5, 0, rules)
    outcome = scene.update(phd_update)
    expected = plain.heaviest_first(scene.rows)
    expected[:, 0] *= 1.0 - 0.9
    np.testing.assert_allclose(outcome.rows, expected, rtol=1e-12)
    np.testing.assert_allclose(outcome.tally[1], 0.0)
    assert outcome.tally[0, 0] == (scene.rows[:, sets.SEEN] >= 3.0).sum()
    gone = 0.9 * scene.rows[:, 0].sum()
    if name in ("empty", "single-feature", "single-cluster", "multi-feature"):
        assert outcome.log_weight == pytest.approx(-0.3 - gone, rel=1e-9)
    else:
        assert outcome.log_weight == pytest.approx(-0.3 - gone - np.log(scene.rows[:, 0].max()), rel=1e-9)


@pytest.mark.parametrize("name", STRATEGIES)
def test_no_component(name):
    """Oracle: c^M exp(-lambda), and a component for each sighting with the weight of births, where it lies."""
    rng = np.random.default_rng(48)
    rules = rules_of(WEIGHTING=STRATEGIES[name], BIRTH=0.05, PRUNE=1e-5)
    scene = random_scene(rng, 0, 3, rules)
    outcome = scene.update(phd_update)
    assert outcome.log_weight == pytest.approx(3.0 * np.log(1e-3) - 0.3, rel=1e-12)
    np.testing.assert_array_equal(outcome.explained, 0.0)
    np.testing.assert_allclose(outcome.rows[:, sets.WEIGHT], 0.05)
    places = [plain.locate(scene.mount, scene.pose, z) for z in scene.z]
    np.testing.assert_allclose(outcome.rows[:, [sets.X, sets.Y]], places, atol=1e-12)
    np.testing.assert_array_equal(outcome.rows[:, sets.SEEN], 1.0)
    assert len(set(outcome.rows[:, sets.ID])) == 3
    nothing = Scene(scene.rows, scene.z[:0], rules).update(phd_update)
    assert len(nothing.rows) == 0
    assert nothing.log_weight == pytest.approx(-0.3, rel=1e-12)


@pytest.mark.parametrize("name", STRATEGIES)
def test_only_clutter(name):
    """Oracle: sightings far from every component change the map as no sighting does, and give a factor c each."""
    rng = np.random.default_rng(49)
    rules = rules_of(WEIGHTING=STRATEGIES[name], GATE=25.0, **BARE)
    scene = random_scene(rng, 4, 0, rules)
    quiet = scene.update(phd_update)
    scene.z = np.array([[45.0, 0.3], [44.0, -2.0]])
    noisy = scene.update(phd_update)
    np.testing.assert_array_equal(noisy.rows, quiet.rows)
    assert noisy.log_weight == pytest.approx(quiet.log_weight + 2.0 * np.log(1e-3), rel=1e-12)
    np.testing.assert_array_equal(noisy.explained, 0.0)


@pytest.mark.parametrize("name", STRATEGIES)
@pytest.mark.parametrize("seen", [0.0, 1e-9, 1e-5, 1.0 - 1e-5, 1.0])
def test_detection_all_but_certain_or_all_but_impossible(name, seen):
    """Oracle: every number finite; at zero the map stays as it is, at one a sighted landmark stays a landmark and an
    unseen one goes."""
    row = plain.component(0.95, (12.0, 0.0), 0.01 * np.eye(2))
    other = plain.component(0.95, (0.0, 12.0), 0.01 * np.eye(2))
    rules = rules_of(WEIGHTING=STRATEGIES[name], BIRTH=0.0, PRUNE=1e-9)
    scene = Scene(
        np.array([row, other]), np.array([[12.0, 0.0]]), rules, "jacobian", plain.CENTRED, np.zeros(3)
    )
    scene.profile = np.array([seen])
    outcome = scene.update(phd_update)
    assert np.isfinite(outcome.log_weight)
    assert np.isfinite(outcome.rows).all()
    weights = np.array([outcome.rows[outcome.rows[:, axis] > 6.0, 0].sum() for axis in (sets.X, sets.Y)])
    if seen < 1e-6:
        np.testing.assert_array_equal(outcome.rows, scene.rows)
    elif seen > 0.5:
        assert weights[0] > 0.99
        assert weights[1] < 1e-4


def test_what_is_out_of_view_is_left_alone():
    """Oracle: components behind the view or out of range come back bit for bit, whatever holes the others leave."""
    rng = np.random.default_rng(50)
    for _ in range(50):
        rules = rules_of(HALF_VIEW=1.0, MAX_RANGE=25.0, PRUNE=rng.choice([1e-6, 0.3]), MERGE=4.0)
        scene = random_scene(rng, 12, 4, rules, mount=plain.CENTRED, room=int(rng.choice([12, 500])))
        aside = np.array(
            [plain.sight(plain.CENTRED, scene.pose, row[[sets.X, sets.Y]]) for row in scene.rows]
        )
        hidden = (np.abs(aside[:, 1]) > 1.6) | (aside[:, 0] > 30.0)
        outcome = scene.update(phd_update)
        assert len(outcome.rows) <= scene.room
        assert np.isfinite(outcome.rows).all()
        for row in scene.rows[hidden]:
            assert (outcome.rows == row).all(axis=1).sum() == 1
        assert outcome.rows[:, 0].min() >= rules[sets.PRUNE] or hidden.any()


def test_total_weight_after_all():
    """Oracle: births and merging keep the sum: missed, explained and born, by hand."""
    rng = np.random.default_rng(51)
    for _ in range(20):
        scene = random_scene(rng, 6, 5, rules_of(MERGE=4.0, PRUNE=1e-200, BIRTH=0.1), near=3.0)
        outcome = scene.update(phd_update)
        expected = (
            0.1 * scene.rows[:, 0].sum() + outcome.explained.sum() + 0.1 * (1.0 - outcome.explained).sum()
        )
        assert outcome.rows[:, 0].sum() == pytest.approx(expected, rel=1e-9)


def test_intensity_is_a_sum_of_normal_densities():
    """Oracle: scipy's multivariate normal."""
    rng = np.random.default_rng(52)
    scene = random_scene(rng, 6, 0, rules_of(), near=1.0)
    for _ in range(50):
        place = scene.rows[0, [sets.X, sets.Y]] + rng.uniform(-1.5, 1.5, 2)
        expected = plain.density_of(scene.rows, place)
        assert intensity(scene.rows, 6, *place) == pytest.approx(expected, rel=1e-9, abs=1e-13)


def test_random_frames_never_break_a_map():
    """Oracle: weights finite, factors factors."""
    updates, least = run_of_frames(phd_update, 20_000, 53)
    assert updates >= 20_000
    assert 0.0 < least < np.inf


@pytest.mark.slow
def test_very_many_updates_never_break_a_map():
    """Oracle: as above, 50,000 updates of each of KALMAP_SLOW_SEEDS seeds (default 20: a million)."""
    for seed in range(int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))):
        updates, least = run_of_frames(phd_update, 50_000, 54 + seed)
        assert updates >= 50_000
        assert 0.0 < least < np.inf
