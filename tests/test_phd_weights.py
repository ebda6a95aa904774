"""The weight of a particle whose map is a PHD: the papers' strategies, with sets and associations enumerated."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import finite_sets as plain
from finite_sets import Scene, matchings, random_scene, rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.phd import phd_update
from set_problems import BARE, ROOT, STRATEGIES, updated_intensity


def factor_of_strategy(scene: Scene, features: np.ndarray) -> float:
    """ln p(Z | x) = ln g(Z | M, x) + sum of ln v - ln v+ over M + N+ - N, the set likelihood enumerated."""
    after, _ = updated_intensity(scene)
    known = features.copy()
    known[:, [sets.L11, sets.L21, sets.L22]] = 0.0
    at = Scene(
        known,
        scene.z,
        scene.rules,
        scene.rule,
        scene.mount,
        scene.pose,
        scene.root,
        scene.profile,
        scene.noise,
    )
    looks = at.looks()
    total = np.log(
        plain.set_likelihood(
            scene.rules[sets.CLUTTER],
            scene.rules[sets.CLUTTER_RATE],
            [look.detection for look in looks],
            at.densities(looks),
        )
    )
    for feature in features:
        place = feature[[sets.X, sets.Y]]
        total += np.log(plain.density_of(scene.rows, place)) - np.log(plain.density_of(after, place))
    return total + after[:, 0].sum() - scene.rows[:, 0].sum()


def features_of(rows: np.ndarray, rules: np.ndarray) -> np.ndarray:
    """The heaviest first."""
    return plain.heaviest_first(rows, rules[sets.FEATURE])


@pytest.mark.parametrize("rule, root", [("jacobian", 0.0), ("cubature", 1.0)])
@pytest.mark.parametrize("name", ["empty", "single-feature", "multi-feature"])
def test_weight_of_a_set_of_features(name, rule, root):
    """Oracle: the identity of the three strategies with the set likelihood over all matchings written out, v and v+
    by scipy, the features those of the updated map."""
    rng = np.random.default_rng(42)
    used = set()
    for k in range(40):
        rules = rules_of(WEIGHTING=STRATEGIES[name], FEATURE=0.3, **BARE)
        near = None if k % 2 else 0.6
        components, sightings = int(rng.integers(1, 5)), int(rng.integers(0, 4))
        scene = random_scene(rng, components, sightings, rules, near=near, rule=rule, root=root * ROOT)
        outcome = scene.update(phd_update)
        features = features_of(outcome.rows, rules)
        features = features[: {"empty": 0, "single-feature": 1, "multi-feature": None}[name]]
        used.add(len(features))
        assert outcome.log_weight == pytest.approx(factor_of_strategy(scene, features), rel=1e-6, abs=1e-6)
    assert used >= {"empty": {0}, "single-feature": {0, 1}, "multi-feature": {0, 1, 2, 3}}[name]


@pytest.mark.parametrize("rule", ["jacobian", "cubature"])
@pytest.mark.parametrize("name", ["empty", "single-feature", "multi-feature", "single-cluster"])
def test_sightings_across_the_wrap(name, rule):
    """Oracle: the same equations in plain numpy, landmarks and their sightings on two sides of the bearing pi."""
    rng = np.random.default_rng(55)
    rules = rules_of(WEIGHTING=STRATEGIES[name], FEATURE=0.3, GATE=100.0, **BARE)
    for _ in range(10):
        scene = plain.behind(random_scene(rng, 3, 3, rules, rule=rule))
        outcome = scene.update(phd_update)
        expected, explained = updated_intensity(scene)
        got, expected = plain.heaviest_first(outcome.rows), plain.heaviest_first(expected)
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(outcome.explained, explained, rtol=1e-7, atol=1e-12)
        assert explained.min() > 0.5
        if name == "single-cluster":
            looks = scene.looks()
            parts = scene.densities(looks) @ [look.detection * row[0] for row, look in zip(scene.rows, looks)]
            factor = np.log(1e-3 + parts).sum() - 0.3 - 0.9 * scene.rows[:, 0].sum()
        else:
            features = features_of(outcome.rows, rules)
            factor = factor_of_strategy(scene, features[: {"empty": 0, "single-feature": 1}.get(name)])
        assert outcome.log_weight == pytest.approx(factor, rel=1e-6, abs=1e-6)


def test_weight_of_a_merged_map():
    """Oracle: as above, the features being the merged components; v+ is that before merging."""
    rng = np.random.default_rng(43)
    for _ in range(20):
        rules = rules_of(WEIGHTING=sets.MULTI_FEATURE, MERGE=4.0, FEATURE=0.4, **BARE)
        scene = random_scene(rng, 4, 3, rules, near=1.0)
        outcome = scene.update(phd_update)
        expected = factor_of_strategy(scene, features_of(outcome.rows, rules))
        assert outcome.log_weight == pytest.approx(expected, rel=1e-6, abs=1e-6)


def log_evidence(rate, clutter, mass, missed, sighted, most: int = 25) -> float:
    """ln p(Z) of a Poisson map by its number of features: missed and sighted (M,) are integrals of the intensity times
    1 - P_D, and times P_D and the likelihood of each sighting; every hypothesis is written out."""
    total = 0.0
    for n in range(most):
        given = 0.0
        for choice in matchings(np.ones((len(sighted), n), bool)):
            value = np.exp(-rate)
            for i, j in enumerate(choice):
                value *= clutter if j < 0 else sighted[i] / mass
            used = sum(j >= 0 for j in choice)
            given += value * (missed / mass) ** (n - used)
        total += np.exp(-mass) * mass**n / math.factorial(n) * given
    return np.log(total)


@pytest.mark.parametrize("rule, root", [("jacobian", 0.0), ("cubature", 1.0)])
@pytest.mark.parametrize("sightings", [0, 1, 2])
def test_single_cluster_is_the_evidence_of_a_poisson_map(sightings, rule, root):
    """Oracle: the sum over 0 to 24 features and all their associations, Gaussians integrated by the plain looks."""
    rng = np.random.default_rng(44)
    for near in (None, 0.6):
        scene = random_scene(rng, 2, sightings, rules_of(**BARE), near=near, rule=rule, root=root * ROOT)
        looks = scene.looks()
        weights, seen = scene.rows[:, 0], np.array([look.detection for look in looks])
        sighted = scene.densities(looks) @ (weights * seen)
        expected = log_evidence(0.3, 1e-3, weights.sum(), weights @ (1.0 - seen), sighted)
        assert scene.update(phd_update).log_weight == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("rule", ["jacobian", "cubature"])
@pytest.mark.parametrize("sightings", [0, 1, 2])
def test_single_cluster_by_quadrature_over_the_plane(sightings, rule):
    """Oracle: the same sum, the intensity times the sensor's density integrated on a grid over the plane: what is left
    is the lineariser's error, within a hundredth for landmarks known to 10 cm, 15 m away."""
    scene = Scene(np.zeros((2, sets.COLUMNS)), np.zeros((0, 2)), rules_of(**BARE), rule)
    centre = scene.pose[:2] + [9.0, 12.0]
    first = plain.component(0.6, centre, [[0.012, 0.004], [0.004, 0.01]])
    scene.rows = np.array(
        [first, plain.component(0.8, centre + [0.2, -0.1], [[0.01, -0.003], [-0.003, 0.008]])]
    )
    scene.z = np.array(
        [plain.sight(scene.mount, scene.pose, centre + off) for off in ([0.1, 0.1], [0.3, -0.2])]
    )
    scene.z = scene.z[:sightings]
    axis = np.linspace(-1.2, 1.2, 161)
    places = centre + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    cell = (axis[1] - axis[0]) ** 2
    values = np.zeros(len(places))
    for row in scene.rows:
        values += row[0] * multivariate_normal.pdf(places, row[[sets.X, sets.Y]], plain.covariance(row))
    predicted = np.array([plain.sight(scene.mount, scene.pose, place) for place in places])
    sighted = []
    for z in scene.z:
        off = np.stack([z[0] - predicted[:, 0], plain.wrap(z[1] - predicted[:, 1])], axis=1)
        density = multivariate_normal.pdf(off, np.zeros(2), np.diag([0.1**2, 0.02**2]))
        sighted.append(0.9 * cell * (values @ density))
    mass = cell * values.sum()
    assert mass == pytest.approx(scene.rows[:, 0].sum(), rel=1e-6)
    expected = log_evidence(0.3, 1e-3, mass, 0.1 * mass, np.array(sighted))
    assert scene.update(phd_update).log_weight == pytest.approx(expected, abs=0.01 * max(sightings, 1e-4))


@pytest.mark.parametrize("root", [0.0, 1.0])
def test_cubature_strategy_is_the_papers(root):
    """Oracle: equations (25) to (27) as printed, on the plain cubature look of the heaviest component."""
    rng = np.random.default_rng(46)
    for _ in range(30):
        rules = rules_of(WEIGHTING=sets.CUBATURE_FEATURE, **BARE)
        components, sightings = int(rng.integers(1, 5)), int(rng.integers(0, 5))
        scene = random_scene(rng, components, sightings, rules, rule="cubature", root=root * ROOT, near=2.0)
        looks, clutter = scene.looks(), rules[sets.CLUTTER]
        densities = scene.densities(looks)
        j = int(np.argmax(scene.rows[:, 0]))
        seen, weight = looks[j].detection, scene.rows[j, 0]
        a = (1.0 - seen) * clutter**sightings
        a += seen * weight * sum(clutter ** (sightings - 1) * densities[i, j] for i in range(sightings))
        parts = densities * [look.detection * row[0] for look, row in zip(looks, scene.rows)]
        shares = parts / (clutter + parts.sum(axis=1, keepdims=True))
        after = scene.rows[:, 0] * [1.0 - look.detection for look in looks] + shares.sum(axis=0)
        b = np.exp(scene.rows[:, 0].sum() - after.sum() + rules[sets.CLUTTER_RATE]) * after[j]
        assert scene.update(phd_update).log_weight == pytest.approx(np.log(a / b), rel=1e-7, abs=1e-9)


def test_cubature_strategy_beside_the_multi_feature_one():
    """Oracle: with one certain landmark, sighted where it should be, or not at all, both strategies give a particle
    the better odds in the same order as its pose is nearer to the truth."""
    row = plain.component(0.95, (12.0, 0.0), 0.01 * np.eye(2))
    for name in ("cubature-feature", "multi-feature"):
        weights = []
        for offset in (0.0, 0.2, 0.4, 0.6):
            rules = rules_of(WEIGHTING=STRATEGIES[name])
            pose = np.array([offset, 0.0, 0.0])
            scene = Scene(row[None], np.array([[12.0, 0.0]]), rules, "cubature", plain.CENTRED, pose)
            weights.append(scene.update(phd_update).log_weight)
        assert (np.diff(weights) < 0.0).all()
