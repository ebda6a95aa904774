"""The relations metric: against matrices and loops, its invariances, and the odometry figures of the real logs."""

from __future__ import annotations

import lzma

import numpy as np
import pytest

from kalmap.evaluation import relation_errors, relation_metrics
from kalmap.evaluation.relations import rows_of
from kalmap.geometry.se2 import compose, inverse
from kalmap.records import Relations
from real_data import data_root

__all__ = ["data_root"]


def matrix(pose):
    x, y, turn = pose
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def drive(rng, count):
    """Stamps on a millisecond grid, shuffled, and poses."""
    stamps = 1.5e9 + 0.01 * rng.permutation(100 * count)[:count]
    poses = np.c_[rng.normal(0, 20, (count, 2)), rng.uniform(-np.pi, np.pi, count)]
    return stamps, poses


def test_errors_are_those_of_matrices():
    rng = np.random.default_rng(5)
    stamps, poses = drive(rng, 60)
    first, second = rng.integers(0, 60, 200), rng.integers(0, 60, 200)
    known = np.c_[rng.normal(0, 3, (200, 2)), rng.uniform(-9, 9, 200)]
    errors = relation_errors(stamps, poses, Relations(stamps[first], stamps[second], known))
    assert len(errors) == 200
    assert errors.missed == 0
    for k in range(200):
        motion = np.linalg.inv(matrix(poses[first[k]])) @ matrix(poses[second[k]])
        e = np.linalg.inv(matrix(known[k])) @ motion
        assert errors.translations[k] == pytest.approx(np.hypot(e[0, 2], e[1, 2]), abs=1e-12)
        assert errors.rotations[k] == pytest.approx(np.arccos(np.clip(e[0, 0], -1, 1)), abs=1e-6)
        assert errors.closing[k] == (abs(stamps[second[k]] - stamps[first[k]]) >= 100.0)


def test_a_right_trajectory_has_no_error_wherever_it_lies():
    rng = np.random.default_rng(6)
    stamps, poses = drive(rng, 40)
    first, second = rng.integers(0, 40, 99), rng.integers(0, 40, 99)
    relations = Relations(stamps[first], stamps[second], compose(inverse(poses[first]), poses[second]))
    moved = compose(np.array([30.0, -7.0, 2.0]), poses)
    errors = relation_errors(stamps, moved, relations)
    assert max(errors.translations.max(), errors.rotations.max()) < 1e-12


def test_rows_are_the_nearest_by_brute_force():
    rng = np.random.default_rng(7)
    stamps = np.round(rng.uniform(0, 1, 300), 3)  # many of them twice
    wanted = np.concatenate([rng.uniform(-0.01, 1.01, 500), stamps[:50], [-1.0, 2.0, stamps.max() + 5e-4]])
    rows = rows_of(stamps, wanted)
    for row, instant in zip(rows, wanted, strict=True):
        gaps = np.abs(stamps - instant)
        assert (row >= 0) == (gaps.min() <= 1e-3)
        if row >= 0:
            assert gaps[row] == pytest.approx(gaps.min(), abs=1e-12)  # two may be equally far on either side
            assert row == np.flatnonzero(stamps == stamps[row])[0]


def test_numbers_by_hand():
    stamps = np.array([200.0, 0.0, 1.0])
    poses = np.array([[0.0, 3.0, 0.1], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    known = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    relations = Relations(np.array([0.0, 0.0, 0.0]), np.array([1.0, 200.0, 7.0]), known)
    metrics = relation_metrics(relation_errors(stamps, poses, relations))
    assert (metrics["relations_found"], metrics["relations_missed"]) == (2, 1)
    assert metrics["relations_translation_mean_m"] == pytest.approx(2.0)
    assert metrics["relations_translation_std_m"] == pytest.approx(1.0)
    assert metrics["relations_translation_squared_mean_m2"] == pytest.approx(5.0)
    assert metrics["relations_translation_squared_std_m2"] == pytest.approx(4.0)
    assert metrics["relations_rotation_mean_deg"] == pytest.approx(np.degrees(0.05))
    assert metrics["relations_local_translation_mean_m"] == pytest.approx(1.0)
    assert metrics["relations_loop_translation_mean_m"] == pytest.approx(3.0)
    assert metrics["relations_loop_rotation_squared_mean_deg2"] == pytest.approx(np.degrees(0.1) ** 2)


@pytest.mark.parametrize("stamps", [np.zeros(0), np.array([50.0])])
def test_nothing_found_is_counted_and_not_a_number(stamps):
    relations = Relations(np.array([1.0]), np.array([2.0]), np.zeros((1, 3)))
    metrics = relation_metrics(relation_errors(stamps, np.zeros((len(stamps), 3)), relations))
    assert metrics.pop("relations_missed") == 1
    assert {metrics.pop(f"relations_{name}found") for name in ("", "local_", "loop_")} == {0}
    assert set(metrics.values()) == {None}


@pytest.mark.parametrize(
    ("folder", "name", "translation", "rotation"),
    [
        ("intel-lab", "intel", (7.370, 14.349), (39.17, 53.79)),
        ("aces", "aces", (0.549, 2.674), (2.33, 6.50)),
    ],
)
def test_raw_odometry_scores_what_the_benchmark_says(data_root, folder, name, translation, rotation):
    log = data_root / folder / f"{name}.clf.xz"
    if not log.exists():
        pytest.skip(f"no real data: {log} does not exist")
    stamps, poses = [], []
    with lzma.open(log, "rt") as stream:
        for line in stream:
            if line.startswith("FLASER"):
                fields = line.split()
                tail = fields[2 + int(fields[1]) :]
                poses.append([float(field) for field in tail[3:6]])
                stamps.append(float(tail[6]))
    table = np.loadtxt(data_root / folder / f"{name}.relations")
    relations = Relations(table[:, 0], table[:, 1], table[:, [2, 3, 7]])
    metrics = relation_metrics(relation_errors(np.array(stamps), np.array(poses), relations))
    assert metrics["relations_missed"] == 0
    for kind, unit, expected, digits in (
        ("translation", "m", translation, 3),
        ("rotation", "deg", rotation, 2),
    ):
        for part, value in zip(("mean", "std"), expected, strict=True):
            assert round(metrics[f"relations_{kind}_{part}_{unit}"], digits) == value
