"""The Poisson multi-Bernoulli update of a map: against every association hypothesis written out."""

from __future__ import annotations

import os

import numpy as np
import pytest

import finite_sets as plain
from finite_sets import Scene, matchings, random_scene, rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.bernoulli import bernoulli_update
from set_problems import BARE, ROOT, run_of_frames


def by_hypotheses(scene: Scene) -> tuple[float, list[np.ndarray], np.ndarray]:
    """ln of the sum over all hypotheses, each landmark's row after it by the moments of its mixture over them, and the
    probability that each sighting is some landmark's.

    A hypothesis: some landmarks exist, some of these are seen, each by one sighting, the rest of the sightings are
    false or the first of something new. Landmarks that are not seen may exist or not.
    """
    looks = scene.looks()
    densities = scene.densities(looks)
    alone = scene.rules[sets.CLUTTER] / (1.0 - scene.rules[sets.BIRTH])
    total, explained = 0.0, np.zeros(len(scene.z))
    parts: list[list[tuple[float, np.ndarray, np.ndarray, float]]] = [[] for _ in scene.rows]
    for choice in matchings(scene.within_gate(looks)):
        weight = np.exp(-scene.rules[sets.CLUTTER_RATE])
        for i, j in enumerate(choice):
            weight *= alone if j < 0 else scene.rows[j, 0] * looks[j].detection * densities[i, j]
        for j, (row, look) in enumerate(zip(scene.rows, looks)):
            if j not in choice:
                weight *= 1.0 - row[0] + row[0] * (1.0 - look.detection)
        total += weight
        for i, j in enumerate(choice):
            explained[i] += weight if j >= 0 else 0.0
        for j, (row, look) in enumerate(zip(scene.rows, looks)):
            if j in choice:
                z = scene.z[choice.index(j)]
                parts[j].append((weight, look.moved(row, z), look.after, row[sets.SEEN] + 1.0))
                continue
            there = row[0] * (1.0 - look.detection) / (1.0 - row[0] * look.detection)
            parts[j].append((weight * there, row[[sets.X, sets.Y]], plain.covariance(row), row[sets.SEEN]))
    rows = []
    for row, part in zip(scene.rows, parts):
        weights = np.array([p[0] for p in part])
        places = np.array([p[1] for p in part])
        mean = weights @ places / weights.sum()
        off = places - mean
        spread = np.einsum("n,nij->ij", weights, [p[2] for p in part]) + (weights[:, None] * off).T @ off
        seen = weights @ [p[3] for p in part] / weights.sum()
        rows.append(plain.component(weights.sum() / total, mean, spread / weights.sum(), row[sets.ID], seen))
    return np.log(total), rows, explained / total


@pytest.mark.parametrize("rule, root", [("jacobian", 0.0), ("jacobian", 1.0), ("cubature", 1.0)])
@pytest.mark.parametrize("landmarks, sightings", [(1, 0), (1, 1), (1, 3), (2, 1), (2, 2), (2, 4), (5, 3)])
def test_update_over_all_hypotheses(rule, root, landmarks, sightings):
    """Oracle: existence, mean, covariance, count of sightings and normaliser by enumeration and moment matching,
    landmarks far apart and beside each other."""
    rng = np.random.default_rng(61)
    for near in (None, 1.0):
        for births in (0.0, 0.3):
            rules = rules_of(BIRTH=births, PRUNE=1e-250)
            scene = random_scene(rng, landmarks, sightings, rules, near=near, rule=rule, root=root * ROOT)
            scene.rows[:, sets.ID] = np.arange(landmarks)
            outcome = scene.update(bernoulli_update, number=50)
            log_sum, rows, explained = by_hypotheses(scene)
            assert outcome.log_weight == pytest.approx(log_sum, rel=1e-8)
            old = outcome.rows[outcome.rows[:, sets.ID] < landmarks]
            old = old[np.argsort(old[:, sets.ID])]
            np.testing.assert_allclose(old, np.array(rows), rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(outcome.explained, explained, rtol=1e-7, atol=1e-12)
            born = outcome.rows[outcome.rows[:, sets.ID] >= landmarks]
            expected = births * (1.0 - explained)
            if births:
                assert len(born) == sightings
                np.testing.assert_allclose(np.sort(born[:, 0]), np.sort(expected), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("rule", ["jacobian", "cubature"])
def test_sightings_across_the_wrap(rule):
    """Oracle: enumeration, landmarks and their sightings on two sides of the bearing pi."""
    rng = np.random.default_rng(67)
    for _ in range(10):
        scene = plain.behind(random_scene(rng, 3, 3, rules_of(GATE=100.0, **BARE), rule=rule))
        scene.rows[:, sets.ID] = np.arange(3)
        outcome = scene.update(bernoulli_update)
        log_sum, rows, explained = by_hypotheses(scene)
        assert outcome.log_weight == pytest.approx(log_sum, rel=1e-8)
        old = outcome.rows[np.argsort(outcome.rows[:, sets.ID])]
        np.testing.assert_allclose(old, np.array(rows), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(outcome.explained, explained, rtol=1e-7)
        assert explained.min() > 0.5


def test_seven_landmarks_in_a_ring_of_doubt():
    """Oracle: enumeration. More sightings and landmarks in one cluster than are summed exactly, each sighting nearest
    to its own and near enough to its neighbours: messages, within 0.02; their sum is less than the true one, by less
    than sqrt(2) for each landmark."""
    rng = np.random.default_rng(62)
    angles = np.arange(7) * 2.0 * np.pi / 7.0
    places = np.array([15.0, 0.0]) + 0.7 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = np.array([plain.component(0.8, place, 0.01 * np.eye(2), k) for k, place in enumerate(places)])
    scene = Scene(rows, np.zeros((0, 2)), rules_of(GATE=16.0, **BARE), pose=np.zeros(3), mount=plain.CENTRED)
    near = places + 0.08 * rng.standard_normal(places.shape)
    scene.z = np.array([plain.sight(plain.CENTRED, scene.pose, place) for place in near])
    outcome = scene.update(bernoulli_update)
    log_sum, expected, explained = by_hypotheses(scene)
    old = outcome.rows[np.argsort(outcome.rows[:, sets.ID])]
    np.testing.assert_allclose(old[:, 0], [row[0] for row in expected], atol=0.02)
    np.testing.assert_allclose(old[:, 1:3], [row[1:3] for row in expected], atol=0.02)
    np.testing.assert_allclose(outcome.explained, explained, atol=0.02)
    assert log_sum - 3.5 * np.log(2.0) <= outcome.log_weight <= log_sum + 1e-6


def test_no_sighting_is_a_frame_too():
    """Oracle: r (1 - P_D) / (1 - r P_D), in product the weight."""
    rng = np.random.default_rng(63)
    scene = random_scene(rng, 5, 0, rules_of(**BARE))
    scene.rows[:, sets.ID] = np.arange(5)
    outcome = scene.update(bernoulli_update)
    before = scene.rows[:, 0]
    after = outcome.rows[np.argsort(outcome.rows[:, sets.ID])]
    np.testing.assert_allclose(after[:, 0], before * 0.1 / (1.0 - 0.9 * before), rtol=1e-12)
    np.testing.assert_array_equal(after[:, 1:], scene.rows[:, 1:])
    assert outcome.log_weight == pytest.approx(-0.3 + np.log(1.0 - 0.9 * before).sum(), rel=1e-12)


def test_no_landmark_and_what_is_founded():
    """Oracle: every sighting is new with probability BIRTH; density c / (1 - BIRTH) each."""
    rng = np.random.default_rng(64)
    scene = random_scene(rng, 0, 4, rules_of(BIRTH=0.2, PRUNE=1e-5))
    outcome = scene.update(bernoulli_update)
    np.testing.assert_allclose(outcome.rows[:, 0], 0.2)
    assert outcome.log_weight == pytest.approx(4.0 * np.log(1e-3 / 0.8) - 0.3, rel=1e-12)
    places = [plain.locate(scene.mount, scene.pose, z) for z in scene.z]
    np.testing.assert_allclose(outcome.rows[:, [sets.X, sets.Y]], places, atol=1e-12)


@pytest.mark.parametrize("seen", [0.0, 1e-9, 1e-5, 1.0 - 1e-5, 1.0])
@pytest.mark.parametrize("existence", [1e-9, 0.5, 1.0 - 1e-12, 1.0])
def test_certain_landmarks_and_certain_detection(seen, existence):
    """Oracle: every number finite; a landmark stays as it is that cannot be seen, exists if it is sighted, and is
    gone if one that could not be missed is missed; unless it exists for sure: r (1 - P_D) / (1 - r P_D) of the missed
    one, and of the sighted one with the odds of its pair r P_D g to (1 - r P_D) c."""
    rows = np.array(
        [
            plain.component(existence, place, 0.01 * np.eye(2), k)
            for k, place in enumerate([(12.0, 0.0), (0.0, 12.0)])
        ]
    )
    rules = rules_of(BIRTH=0.0, PRUNE=1e-250)
    scene = Scene(rows, np.array([[12.0, 0.0]]), rules, "jacobian", plain.CENTRED, np.zeros(3))
    scene.profile = np.array([seen])
    outcome = scene.update(bernoulli_update)
    assert np.isfinite(outcome.log_weight)
    assert np.isfinite(outcome.rows).all()
    assert (outcome.rows[:, 0] <= 1.0).all()
    after = outcome.rows[np.argsort(outcome.rows[:, sets.ID])]
    if seen < 1e-6:
        np.testing.assert_array_equal(after, rows)
    elif seen > 0.5 and existence == 0.5:
        assert after[0, 0] > 0.99
        assert after[1, 0] < 1e-4
    if seen >= 1e-6:
        # nothing is sighted more surely than 1 - 1e-6 and nothing believed beyond it: misses in a row can undo it
        share = min(seen, 1.0 - 1e-6)
        missed = existence * (1.0 - share) / (1.0 - existence * share)
        own = existence * share * scene.densities(scene.looks())[0, 0]
        own /= own + rules[sets.CLUTTER] * (1.0 - existence * share)
        sighted = own + (1.0 - own) * missed
        np.testing.assert_allclose(after[1, 0], min(missed, sets.SUREST), rtol=1e-9)
        np.testing.assert_allclose(after[0, 0], min(sighted, sets.SUREST), rtol=1e-9)
        if existence == 1.0:
            assert (after[:, 0] == sets.SUREST).all()


def test_tallies_of_the_rings():
    """Oracle: by hand: landmarks that likely exist count with their existence as seeable, with the probability of any
    of their pairs as seen, in the ring they lie in."""
    rows = np.array(
        [
            plain.component(w, (x, 0.0), 0.01 * np.eye(2), k)
            for k, (w, x) in enumerate([(0.9, 8.0), (0.7, 40.0), (0.3, 9.0)])
        ]
    )
    rules = rules_of(RINGS=2, GATE=20.0, **BARE)
    scene = Scene(rows, np.array([[8.0, 0.0]]), rules, "jacobian", plain.CENTRED, np.zeros(3))
    scene.profile = np.array([0.8, 0.8])
    outcome = scene.update(bernoulli_update)
    pairs = by_hypotheses(
        Scene(rows[:1], scene.z, rules, "jacobian", plain.CENTRED, np.zeros(3), profile=scene.profile)
    )
    np.testing.assert_allclose(outcome.tally[0], [0.9, 0.7], rtol=1e-12)
    np.testing.assert_allclose(outcome.tally[1], [pairs[2][0], 0.0], rtol=1e-3)


def test_random_frames_never_break_a_map():
    """Oracle: weights finite, factors factors."""
    updates, least = run_of_frames(bernoulli_update, 20_000, 65)
    assert updates >= 20_000
    assert 0.0 < least < np.inf


@pytest.mark.slow
def test_very_many_updates_never_break_a_map():
    """Oracle: as above, 50,000 updates of each of KALMAP_SLOW_SEEDS seeds (default 20: a million)."""
    for seed in range(int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))):
        updates, least = run_of_frames(bernoulli_update, 50_000, 66 + seed)
        assert updates >= 50_000
        assert 0.0 < least < np.inf
