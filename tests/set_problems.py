"""What tests of the maps of random finite sets share: settings, the updated intensity, frames of maps that live on."""

from __future__ import annotations

import numpy as np

import finite_sets as plain
from finite_sets import Scene, random_scene, rules_of
from kalmap.kernels import set_layout as sets

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


def run_of_frames(kernel, updates: int, seed: int) -> tuple[int, float]:
    """Random frames of maps that live on; counts a pair of sighting and component as an update.

    Returns how many updates there were, and the least of all weights and diagonal entries of roots after them.
    """
    rng = np.random.default_rng(seed)
    done, least = 0, np.inf
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
            positive = outcome.rows[:, [sets.WEIGHT, sets.L11, sets.L22]]
            assert (positive > 0.0).all()
            least = min(least, positive.min(initial=np.inf))
            scene.rows = outcome.rows
            scene.pose = scene.pose + rng.standard_normal(3) * [0.5, 0.5, 0.1]
    return done, float(least)
