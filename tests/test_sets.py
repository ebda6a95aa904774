"""OSPA, GOSPA, COLA and their course in time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from kalmap.evaluation import (
    SetError,
    cardinality_error,
    cola,
    gospa,
    ospa,
    pairing,
    seen_so_far,
    set_errors_over_time,
)
from kalmap.records import KalmapError
from kalmap.simulate.sense import visible

NONE = np.zeros((0, 2))
SQUARE = np.array([(0.0, 0.0), (10.0, 0.0), (0.0, 10.0), (10.0, 10.0)])
THREE = np.array([(0.3, 0.4), (10.0, 0.5), (0.0, 12.0)])

coordinates = st.integers(-40, 40).map(
    lambda value: value / 4
)  # a lattice, for ties and pairs at the cut-off
sets = st.lists(st.tuples(coordinates, coordinates), max_size=5).map(
    lambda rows: np.array(rows).reshape(-1, 2)
)
orders = st.sampled_from((1.0, 1.5, 2.0, 3.0))
cutoffs = st.sampled_from((0.5, 2.0, 5.0, 30.0))


def by_hand(one, other, order, cutoff):
    """Sizes m <= n and the least sum of min(d, c)^p over all assignments of the smaller set."""
    small, large = sorted((one, other), key=len)
    distance = np.linalg.norm(small[:, None] - large[None], axis=2)
    powers = np.minimum(distance, cutoff) ** order
    sums = [
        sum(powers[i, j] for i, j in enumerate(chosen))
        for chosen in itertools.permutations(range(len(large)), len(small))
    ]
    return len(small), len(large), min(sums)


def scattered(seed, count, width):
    return np.random.default_rng(seed).uniform(0.0, width, (count, 2))


@pytest.mark.parametrize(("order", "value"), [(1.0, 2.0), (2.0, 2.715695123)])
def test_ospa_of_three_against_four(order, value):
    """Oracle: by hand, e.g. for p = 1 (.5 + .5 + 2 + 5) / 4; the parts: 3 / 4 and 5 / 4."""
    found = ospa(THREE, SQUARE, order=order, cutoff=5.0)
    assert found.value == pytest.approx(value, abs=1e-9)
    parts = (found.localisation**order, found.cardinality**order)
    assert parts == pytest.approx((0.75, 1.25) if order == 1 else (4.5 / 4, 25 / 4))


@pytest.mark.parametrize(("order", "value", "parts"), [(1.0, 5.5, (3, 2.5)), (2.0, 17**0.5, (4.5, 12.5))])
def test_gospa_of_three_against_four(order, value, parts):
    """Oracle: by hand."""
    found = gospa(THREE, SQUARE, order=order, cutoff=5.0)
    assert found.value == pytest.approx(value)
    assert (found.localisation, found.missed, found.false) == pytest.approx((*parts, 0.0))
    assert (found.paired, found.missed_count, found.false_count) == (3, 1, 0)


def test_a_feature_and_its_estimate_farther_apart_than_the_cutoff_are_missed_and_false():
    """Oracle: by hand: c^2 / 2 for each of the two; the surplus feature c^2 / alpha."""
    found = gospa(np.array([(9.0, 0.0)]), np.array([(0.0, 0.0), (0.0, 1.0)]), cutoff=4.0)
    assert (found.localisation, found.missed, found.false) == (0.0, 16.0, 8.0)
    found = gospa(np.array([(9.0, 0.0)]), np.array([(0.0, 0.0), (0.0, 1.0)]), cutoff=4.0, alpha=1.0)
    assert (found.localisation, found.missed, found.false) == (0.0, 24.0, 8.0)
    whole = ospa(np.array([(9.0, 0.0)]), np.array([(0.0, 0.0)]), cutoff=4.0)
    assert (whole.value, whole.localisation, whole.cardinality) == (4.0, 4.0, 0.0)


@pytest.mark.parametrize(("order", "value"), [(1.0, 1.6), (2.0, 1.086278049)])
def test_cola_of_three_against_four(order, value):
    """Oracle: by hand, e.g. for p = 1 (.5 + .5 + 2 + 5) / 5."""
    found = cola(THREE, SQUARE, order=order, cutoff=5.0)
    assert found.value == pytest.approx(value, abs=1e-9)
    assert found.localisation**order + found.cardinality**order == pytest.approx(found.value**order)
    assert found.cardinality == 1.0


def test_nothing_against_39():
    """Oracle: by hand: OSPA is the cut-off, GOSPA (39 c^p / 2)^(1/p), COLA 39^(1/p)."""
    many = scattered(1, 39, 60.0)
    for one, other in ((NONE, many), (many, NONE), ([], many)):
        for order in (1.0, 2.0):
            assert ospa(one, other, order=order, cutoff=5.0).value == pytest.approx(5.0)
            assert cola(one, other, order=order, cutoff=5.0).value == pytest.approx(39 ** (1 / order))
        assert gospa(one, other, order=1.0, cutoff=5.0).value == pytest.approx(97.5)
        assert gospa(one, other, order=2.0, cutoff=5.0).value == pytest.approx(22.079402, abs=1e-6)


def test_two_empty_sets_are_alike():
    assert ospa(NONE, NONE, cutoff=5.0).value == cola(NONE, NONE, cutoff=5.0).value == 0.0
    found = gospa(NONE, [], cutoff=5.0)
    assert (found.value, found.missed, found.false, found.paired) == (0.0, 0.0, 0.0, 0)


def test_cardinality_error():
    less, more = cardinality_error(THREE, SQUARE), cardinality_error(SQUARE, NONE)
    assert (less.value, less.estimated, less.true) == (-1, 3, 4) and more.value == 4


@given(sets, sets, orders, cutoffs, st.sampled_from((0.5, 1.0, 2.0)))
def test_all_assignments_tried_give_the_same(one, other, order, cutoff, alpha):
    """Oracle: brute force, and the definitions."""
    small, large, least = by_hand(one, other, order, cutoff)
    unit = cutoff**order
    surplus = unit * (large - small)
    approx = lambda power: pytest.approx(power ** (1 / order), rel=1e-9, abs=1e-9)  # noqa: E731
    whole, linear = ospa(one, other, order=order, cutoff=cutoff), cola(one, other, order=order, cutoff=cutoff)
    general = gospa(one, other, order=order, cutoff=cutoff, alpha=alpha)
    assert whole.value == approx((least + surplus) / max(large, 1))
    assert whole.localisation == approx(least / max(large, 1))
    assert whole.cardinality == approx(surplus / max(large, 1))
    assert linear.value == approx((least + surplus) / unit)
    assert general.value == approx(least + surplus / alpha)
    parts = general.localisation + general.missed + general.false
    assert parts == pytest.approx(general.value**order, rel=1e-9, abs=1e-9)


@given(sets, sets, orders, cutoffs)
def test_gospa_of_alpha_2_is_the_best_of_all_partial_assignments(one, other, order, cutoff):
    """Oracle: brute force over all partial assignments (Rahmathullah and others 2017, proposition 1)."""
    small, large = sorted((one, other), key=len)
    powers = np.linalg.norm(small[:, None] - large[None], axis=2) ** order
    best = math.inf
    for size in range(len(small) + 1):
        for rows in itertools.combinations(range(len(small)), size):
            for columns in itertools.permutations(range(len(large)), size):
                unpaired = len(small) + len(large) - 2 * size
                best = min(best, powers[list(rows), list(columns)].sum() + unpaired * cutoff**order / 2)
    found = gospa(one, other, order=order, cutoff=cutoff)
    assert found.value**order == pytest.approx(best, rel=1e-9, abs=1e-9)
    assert found.missed == found.missed_count * cutoff**order / 2
    assert found.false == found.false_count * cutoff**order / 2


@given(sets, sets, sets, orders, cutoffs)
def test_they_are_metrics(one, other, third, order, cutoff):
    """Oracle: the axioms: zero for the same set in any order only, symmetry, triangle inequality."""
    for distance in (ospa, gospa, cola):

        def between(a, b, distance=distance):
            return distance(a, b, order=order, cutoff=cutoff).value

        assert between(one, one[::-1]) == 0.0
        assert (between(one, other) == 0.0) == (sorted(one.tolist()) == sorted(other.tolist()))
        assert between(one, other) == pytest.approx(between(other, one))
        assert between(one, third) <= between(one, other) + between(other, third) + 1e-9


@given(sets, sets, orders)
def test_gospa_mirrors_missed_and_false(one, other, order):
    there, back = gospa(one, other, order=order, cutoff=2.0), gospa(other, one, order=order, cutoff=2.0)
    assert (there.missed_count, there.false_count) == (back.false_count, back.missed_count)
    assert (there.missed, there.false) == pytest.approx((back.false, back.missed))


@pytest.mark.parametrize("table", [0, 250_000], ids=["by groups", "in one table"])
@pytest.mark.parametrize(("width", "cutoff"), [(100.0, 3.0), (30.0, 3.0), (10.0, 50.0), (1000.0, 1.0)])
def test_large_sets_are_paired_exactly(monkeypatch, table, width, cutoff):
    """Oracle: the full table of distances, solved by scipy."""
    monkeypatch.setattr(pairing, "_TABLE", table)
    one, other = scattered(2, 150, width), scattered(3, 180, width)
    one[:90] = other[:90] + np.random.default_rng(4).normal(0.0, 0.5, (90, 2))
    powers = np.minimum(np.linalg.norm(one[:, None] - other[None], axis=2), cutoff) ** 2
    least = powers[linear_sum_assignment(powers)].sum()
    assert ospa(one, other, cutoff=cutoff).value ** 2 == pytest.approx((least + 30 * cutoff**2) / 180)
    assert ospa(one, other, cutoff=cutoff).localisation ** 2 == pytest.approx(least / 180)
    assert gospa(other, one, cutoff=cutoff).value ** 2 == pytest.approx(least + 15 * cutoff**2)


def test_a_high_order_neither_overflows_nor_vanishes():
    """Oracle: as p grows, OSPA of sets of the same size tends to the largest distance of a pair (here 2)."""
    found = ospa(np.vstack([THREE, [(10.0, 10.0)]]), SQUARE, order=150.0, cutoff=5.0)
    assert found.value == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    ("one", "other", "options", "what"),
    [
        ([(0.0, math.nan)], SQUARE, {}, "estimated: position 0"),
        (SQUARE, [(0.0, 0.0), (math.inf, 1.0)], {}, "true: position 1"),
        (SQUARE, [1.0, 2.0], {}, r"true: expected .*\(N, 2\)"),
        (np.ones((2, 3)), SQUARE, {}, "estimated: expected"),
        (SQUARE, SQUARE, {"cutoff": 0.0}, "cutoff"),
        (SQUARE, SQUARE, {"cutoff": math.nan}, "cutoff"),
        (SQUARE, SQUARE, {"cutoff": math.inf}, "cutoff"),
        (SQUARE, SQUARE, {"order": 0.5}, "order"),
        (SQUARE, SQUARE, {"order": math.inf}, "order"),
        (SQUARE, SQUARE, {"order": 1000.0}, "cutoff"),
    ],
)
def test_what_has_no_distance_is_refused(one, other, options, what):
    for distance in (ospa, gospa, cola):
        with pytest.raises(SetError, match=what) as caught:
            distance(one, other, **{"cutoff": 5.0, **options})
        assert isinstance(caught.value, KalmapError) and isinstance(caught.value, ValueError)


def test_other_refusals():
    for alpha in (0.0, 2.1, math.nan):
        with pytest.raises(SetError, match="alpha"):
            gospa(SQUARE, SQUARE, cutoff=5.0, alpha=alpha)
    with pytest.raises(SetError, match="estimated"):
        cardinality_error([(math.nan, 0.0)], SQUARE)
    with pytest.raises(SetError, match=r"seen: .*\(1, 4\)"):
        set_errors_over_time([THREE], SQUARE, np.ones((2, 4), dtype=bool), cutoff=5.0)
    with pytest.raises(SetError, match="booleans"):
        set_errors_over_time([THREE], SQUARE, np.ones((1, 4)), cutoff=5.0)
    with pytest.raises(SetError, match="instant 1: estimated: position 0"):
        set_errors_over_time([NONE, [(math.nan, 0.0)]], SQUARE, np.ones((2, 4), dtype=bool), cutoff=5.0)


@pytest.mark.parametrize("order", [1.0, 2.0])
@pytest.mark.parametrize("seed", range(20))
def test_stone_soup_says_the_same(seed, order):
    """Oracle: Stone Soup. Its OSPA pairs by d and not by d^p: it is asked for order 1 between powers."""
    metrics = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    state = pytest.importorskip("stonesoup.types.state").State
    rng = np.random.default_rng(seed)
    one, other = (rng.uniform(0.0, 20.0, (rng.integers(1, 15), 2)) for _ in range(2))
    states = [[state(row[:, None], timestamp=0) for row in each] for each in (one, other)]

    theirs = metrics.GOSPAMetric(p=order, c=5.0).compute_gospa_metric(*states)[0].value
    ours = gospa(one, other, order=order, cutoff=5.0)
    assert ours.value == pytest.approx(theirs["distance"])
    for part in ("localisation", "missed", "false"):
        assert getattr(ours, part) == pytest.approx(theirs[part], abs=1e-9)

    def power(first, second):
        return float(np.linalg.norm(first.state_vector - second.state_vector)) ** order

    powers = metrics.OSPAMetric(p=1, c=5.0**order, measure=power).compute_OSPA_distance(*states).value
    assert ospa(one, other, order=order, cutoff=5.0).value == pytest.approx(powers ** (1 / order))


def test_the_course_is_each_instant_by_itself():
    """Oracle: the distances one by one, against those seen; an instant without map or truth is one of them."""
    seen = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]], dtype=bool)
    maps = [NONE, NONE, THREE[:2], THREE]
    course = set_errors_over_time(maps, SQUARE, seen, order=1.0, cutoff=5.0, alpha=1.0)
    for k, (found, there) in enumerate(zip(maps, (SQUARE[row] for row in seen), strict=True)):
        whole = ospa(found, there, order=1.0, cutoff=5.0)
        split = (course.ospa[k], course.localisation[k], course.cardinality[k])
        assert split == (whole.value, whole.localisation, whole.cardinality)
        assert course.gospa[k] == gospa(found, there, order=1.0, cutoff=5.0, alpha=1.0).value
    assert course.estimated.tolist() == [0, 0, 2, 3] and course.true.tolist() == [0, 1, 3, 4]
    assert len(course) == 4 and course.ospa[0] == 0.0 and course.ospa[1] == 5.0
    assert len(set_errors_over_time([], SQUARE, np.zeros((0, 4), dtype=bool), cutoff=5.0)) == 0


@pytest.mark.parametrize("field_of_view_deg", [30.0, 180.0, 270.0, 360.0])
def test_seen_so_far_is_what_the_simulator_says_was_in_view(field_of_view_deg, monkeypatch):
    """Oracle: the simulator's own visibility, pose by pose; in chunks of any size."""
    rng = np.random.default_rng(6)
    poses = np.column_stack([rng.uniform(0, 50, (60, 2)), rng.uniform(-7, 7, 60)])
    landmarks = rng.uniform(0, 50, (80, 2))
    frames, features, _ = visible(poses, landmarks, 12.0, field_of_view_deg)
    expected = np.zeros((60, 80), dtype=bool)
    for frame, feature in zip(frames, features, strict=True):
        expected[frame:, feature] = True
    for pairs in (500_000, 81, 500):
        monkeypatch.setattr("kalmap.evaluation.set_course._PAIRS", pairs)
        np.testing.assert_array_equal(
            seen_so_far(poses, landmarks, 12.0, math.radians(field_of_view_deg)), expected
        )
    assert 0 < expected[0].sum() < expected[-1].sum()


def test_the_edges_of_what_is_in_view():
    """Oracle: by hand: at the range or abeam is out; what was seen once stays seen."""
    landmarks = np.array([(5.0, 0.0), (4.9, 0.0), (0.0, 2.0), (-2.0, 0.0)])
    poses = np.array([(0.0, 0.0, 0.0), (-0.5, 0.0, math.pi), (100.0, 0.0, 0.0)])
    seen = seen_so_far(poses, landmarks, 5.0, math.pi)
    assert seen[0].tolist() == [False, True, False, False]
    assert seen[1].tolist() == seen[2].tolist() == [False, True, False, True]
    assert seen_so_far(poses, NONE, 5.0, 1.0).shape == (3, 0)
    assert seen_so_far(np.zeros((0, 3)), landmarks, 5.0, 1.0).shape == (0, 4)
