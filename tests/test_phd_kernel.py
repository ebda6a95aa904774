"""The PHD update of a map and the weight of its particle: equations of the papers in plain numpy, sets enumerated."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import finite_sets as plain
from finite_sets import Scene, matchings, random_scene, rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.phd import intensity, phd_update

ROOT = np.array([[0.05, 0.0, 0.0], [0.01, 0.03, 0.0], [0.002, 0.001, 0.004]])
STRATEGIES = {
    "empty": sets.EMPTY,
    "single-feature": sets.SINGLE_FEATURE,
    "single-cluster": sets.SINGLE_CLUSTER,
    "multi-feature": sets.MULTI_FEATURE,
    "cubature-feature": sets.CUBATURE_FEATURE,
}
BARE = {"BIRTH": 0.0, "PRUNE": 1e-250}  # nothing is born, merged or dropped: the update alone


def updated_intensity(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Equations (30) to (32): the rows of the updated map, and what the map explains of each sighting."""
    looks = scene.looks()
    densities = scene.densities(looks)
    rows, explained = [], []
    for row, look in zip(scene.rows, looks):
        rows.append(row.copy())
        rows[-1][sets.WEIGHT] *= 1.0 - look.detection
    for i, z in enumerate(scene.z):
        parts = np.array(
            [look.detection * row[0] * d for row, look, d in zip(scene.rows, looks, densities[i])]
        )
        whole = scene.rules[sets.CLUTTER] + parts.sum()
        explained.append(parts.sum() / whole)
        for row, look, part in zip(scene.rows, looks, parts):
            seen = row[sets.SEEN] + 1.0
            rows.append(plain.component(part / whole, look.moved(row, z), look.after, row[sets.ID], seen))
    return np.array(rows).reshape(-1, sets.COLUMNS), np.array(explained)


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


def run_of_frames(kernel, updates: int, seed: int) -> None:
    """Random frames of maps that live on; counts a pair of sighting and component as an update."""
    rng = np.random.default_rng(seed)
    done = 0
    while done < updates:
        rules = rules_of(
            WEIGHTING=rng.integers(5),
            CLUTTER=10.0 ** rng.uniform(-7, 0),
            GATE=rng.choice([12.0, 40.0]),
            MERGE=rng.choice([0.0, 1.0, 50.0]),
            PRUNE=10.0 ** rng.uniform(-8, -2),
            CAP=rng.choice([5, 60]),
            BIRTH=rng.choice([1e-4, 0.1, 0.9]),
            HALF_VIEW=rng.choice([1.5, np.pi]),
            RINGS=3,
        )
        scene = random_scene(rng, int(rng.integers(0, 25)), 0, rules, scale=10.0 ** rng.uniform(-2, 1))
        scene.rule = str(rng.choice(["jacobian", "cubature", "central"]))
        scene.profile = rng.choice([0.0, 0.3, 0.9, 1.0 - 1e-7, 1.0], 3)
        scene.room = int(rng.choice([25, 200]))
        scene.root = ROOT * rng.choice([0.0, 0.1, 10.0])
        for _ in range(int(rng.integers(1, 40))):
            count = int(rng.integers(0, 12))
            scene.z = np.stack([rng.uniform(0.0, 50.0, count), rng.uniform(-np.pi, np.pi, count)], axis=1)
            for i in range(min(count, len(scene.rows))):
                if rng.random() < 0.8:
                    scene.z[i] = plain.sight(scene.mount, scene.pose, scene.rows[i, [sets.X, sets.Y]])
                    scene.z[i] += rng.standard_normal(2) * [0.1, 0.02]
            scene.z[:, 0] = np.abs(scene.z[:, 0])
            scene.z[:, 1] = plain.wrap(scene.z[:, 1])
            outcome = scene.update(kernel)
            done += max(count, 1) * max(len(scene.rows), 1)
            assert np.isfinite(outcome.log_weight)
            assert np.isfinite(outcome.rows).all()
            assert np.isfinite(outcome.tally).all()
            assert ((outcome.explained >= 0.0) & (outcome.explained <= 1.0)).all()
            assert (outcome.rows[:, [sets.WEIGHT, sets.L11, sets.L22]] > 0.0).all()
            scene.rows = outcome.rows
            scene.pose = scene.pose + rng.standard_normal(3) * [0.5, 0.5, 0.1]


def test_random_frames_never_break_a_map():
    """Oracle: weights finite, factors factors."""
    run_of_frames(phd_update, 20_000, 53)


@pytest.mark.slow
def test_a_million_updates_never_break_a_map():
    """Oracle: as above."""
    run_of_frames(phd_update, 1_000_000, 54)
