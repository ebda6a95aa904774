"""Association accuracy, step times and paired tests."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmap.evaluation import paired_test, score_association, step_times
from kalmap.records import NEW, SPURIOUS


def test_each_kind_of_association():
    truth = [7, 7, 8, 9, 7, 8, 8, 7, -1, 9]
    given_to = [0, 0, 0, 1, 2, 3, 1, SPURIOUS, 4, 4]
    score = score_association(np.array(truth), np.array(given_to), false_ids=True)
    # 7 founds 0; joined; 8 joins 7's, unfounded; 9 founds 1; 7 founds again; 8 founds; 8 joins 9's; unused;
    # clutter founds 4; 9 joins clutter's
    assert (score.right, score.wrong, score.missed_new) == (1, 2, 1)
    assert (score.right_new, score.false_new, score.unused) == (3, 1, 1)
    assert (score.false_admitted, score.false_rejected, score.unscored) == (1, 0, 0)
    assert score.accuracy == pytest.approx(4 / 10) and score.accuracy_used == pytest.approx(4 / 9)


def test_new_without_a_number_founds_too():
    score = score_association(np.array([1, 1, 2]), np.array([NEW, NEW, NEW]))
    assert (score.right_new, score.false_new) == (2, 1)


@given(st.lists(st.integers(0, 20)))
def test_the_truth_itself_is_right(truth):
    score = score_association(np.array(truth, dtype=int), np.array(truth, dtype=int))
    assert score.accuracy == (1.0 if truth else None)
    assert score.right + score.right_new == len(truth)


def test_an_association_of_other_length_is_refused():
    with pytest.raises(ValueError):
        score_association(np.array([1]), np.array([1, 2]))


def test_step_times():
    times = step_times(np.arange(101) / 1000)
    assert (times.mean_ms, times.p50_ms, times.p99_ms, times.max_ms) == pytest.approx((50, 50, 99, 100))
    assert step_times(np.array([])) is None
    assert step_times(np.array([np.nan])) is None


def test_a_clear_difference_is_found():
    rng = np.random.default_rng(6)
    base = rng.uniform(3, 5, 50)
    result = paired_test(base - 0.2 + rng.normal(0, 0.1, 50), base)
    assert result.n == 50 and result.better > 40
    assert result.p_value < 1e-6
    assert result.low < -0.2 < result.high < 0 and result.mean_difference == pytest.approx(-0.2, abs=0.05)


def test_the_numbers_are_scipys():
    stats = pytest.importorskip("scipy.stats")
    first, second = np.random.default_rng(7).normal(size=(2, 12))
    result = paired_test(first, second)
    assert result.p_value == pytest.approx(stats.wilcoxon(first, second).pvalue)
    interval = stats.ttest_rel(first, second).confidence_interval()
    assert (result.low, result.high) == pytest.approx((interval.low, interval.high))


def test_methods_that_do_not_differ():
    result = paired_test(np.ones(5), np.ones(5))
    assert (result.mean_difference, result.low, result.high, result.p_value, result.n) == (0, 0, 0, 1, 5)


def test_few_and_broken_pairs():
    assert paired_test(np.array([]), np.array([])) is None
    one = paired_test(np.array([1.0, np.nan]), np.array([2.0, 1.0]))
    assert (one.n, one.low, one.high, one.mean_difference) == (1, None, None, -1)
    with pytest.raises(ValueError):
        paired_test(np.ones(2), np.ones(3))
