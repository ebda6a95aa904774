"""Verdicts on sightings, pairs of sightings, owners of landmarks, and the metrics made of them."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalmap.evaluation import (
    Verdict,
    evaluate,
    landmark_owners,
    score_association,
    score_landmarks,
    score_pairs,
)
from kalmap.evaluation.owners import FALSE, UNKNOWN
from kalmap.records import NEW, SPURIOUS, Estimate, Landmarks, Log, RunConfig, Trace
from kalmap.view.reading import metric_of, reading

# true ids and labels of up to 40 sightings of few features and landmarks, so that all verdicts come up
PROBLEMS = st.lists(st.tuples(st.integers(-1, 4), st.integers(-2, 5)), max_size=40).map(
    lambda pairs: tuple(np.array(pairs, dtype=np.int64).reshape(-1, 2).T)
)


def verdicts_one_by_one(truth, labels, false_ids):
    """The definitions, sighting after sighting with the books kept in dicts."""
    founder, begun, verdicts = {}, set(), []
    for feature, label in zip(truth.tolist(), labels.tolist()):
        if feature < 0 and not false_ids:
            verdicts.append(Verdict.UNSCORED)
            continue
        had_one = feature in begun
        founds = label == NEW or (label >= 0 and label not in founder)
        if founds:
            begun.add(feature)
        if label >= 0:
            founder.setdefault(label, feature)
        if feature < 0:
            verdicts.append(Verdict.FALSE_REJECTED if label == SPURIOUS else Verdict.FALSE_ADMITTED)
        elif label == SPURIOUS:
            verdicts.append(Verdict.UNUSED)
        elif founds:
            verdicts.append(Verdict.FALSE_NEW if had_one else Verdict.RIGHT_NEW)
        elif founder[label] == feature:
            verdicts.append(Verdict.RIGHT)
        else:
            verdicts.append(Verdict.WRONG if had_one else Verdict.MISSED_NEW)
    return verdicts


@settings(deadline=None)
@given(PROBLEMS, st.booleans())
def test_verdicts_are_those_found_one_by_one(problem, false_ids):
    """Oracle: a loop over the sightings with dicts; counts and accuracies from its list of verdicts."""
    score = score_association(*problem, false_ids=false_ids)
    expected = verdicts_one_by_one(*problem, false_ids)
    assert score.verdicts.tolist() == expected
    counts = Counter(expected)
    for verdict in Verdict:
        assert getattr(score, verdict.name.lower()) == counts[verdict]
    right = counts[Verdict.RIGHT] + counts[Verdict.RIGHT_NEW]
    scored = [v for v in expected if v != Verdict.UNSCORED]
    used = [v for v in scored if v not in (Verdict.UNUSED, Verdict.FALSE_REJECTED)]
    correct = right + counts[Verdict.FALSE_REJECTED]
    assert score.accuracy == (pytest.approx(correct / len(scored)) if scored else None)
    assert score.accuracy_used == (pytest.approx(right / len(used)) if used else None)


def test_each_verdict_written_out():
    """Oracle: the story, told by hand."""
    story = [
        (7, 0, Verdict.RIGHT_NEW),
        (7, 0, Verdict.RIGHT),
        (8, 0, Verdict.MISSED_NEW),
        (8, NEW, Verdict.RIGHT_NEW),
        (8, 0, Verdict.WRONG),
        (7, 1, Verdict.FALSE_NEW),
        (7, 1, Verdict.RIGHT),  # a duplicate is one's own all the same
        (7, SPURIOUS, Verdict.UNUSED),
        (-1, SPURIOUS, Verdict.FALSE_REJECTED),
        (-1, 2, Verdict.FALSE_ADMITTED),
        (-1, NEW, Verdict.FALSE_ADMITTED),
        (7, 2, Verdict.WRONG),  # founded by what is no feature
        (9, 2, Verdict.MISSED_NEW),
    ]
    truth, labels, expected = map(list, zip(*story))
    score = score_association(np.array(truth), np.array(labels), false_ids=True)
    assert score.verdicts.tolist() == expected
    assert score.accuracy == pytest.approx(5 / 13) and score.accuracy_used == pytest.approx(4 / 11)


@settings(deadline=None)
@given(PROBLEMS)
def test_sightings_that_nobody_knows_change_nothing(problem):
    """Oracle: the same score without them; it also holds for pairs and for the features found and missed."""
    truth, labels = problem
    known = truth >= 0
    whole, part = score_association(truth, labels), score_association(truth[known], labels[known])
    np.testing.assert_array_equal(whole.verdicts[known], part.verdicts)
    assert whole.unscored == np.sum(~known) and whole.accuracy == part.accuracy
    assert score_pairs(truth, labels) == score_pairs(truth[known], labels[known])
    final = np.arange(4)
    assert score_landmarks(truth, labels, final) == score_landmarks(truth[known], labels[known], final)


@settings(deadline=None)
@given(PROBLEMS, st.booleans())
def test_pairs_are_those_counted_one_by_one(problem, false_ids):
    """Oracle: all pairs of sightings, looked at one after the other."""
    rows = [(f, k) for f, k in zip(*(each.tolist() for each in problem)) if f >= 0 or false_ids]
    said = real = both = 0
    for (feature, label), (other_feature, other_label) in combinations(rows, 2):
        one_landmark = label == other_label and label >= 0
        one_feature = feature == other_feature and feature >= 0
        said, real, both = said + one_landmark, real + one_feature, both + (one_landmark and one_feature)
    score = score_pairs(*problem, false_ids=false_ids)
    assert (score.true_pairs, score.said_pairs, score.real_pairs) == (both, said, real)
    assert score.precision == (pytest.approx(both / said) if said else None)
    assert score.recall == (pytest.approx(both / real) if real else None)
    if said and real and both:
        harmonic = 2 / (1 / score.precision + 1 / score.recall)
        assert score.f1 == pytest.approx(harmonic)
    else:
        assert score.f1 == (0 if said or real else None)


def test_pairs_of_many_sightings_are_counted_exactly():
    """Oracle: the closed form n (n - 1) / 2, beyond what 32 bits or a float's 53 hold one by one."""
    n = 100_000
    score = score_pairs(np.zeros(n, dtype=np.int32), np.zeros(n, dtype=np.int32))
    assert score.true_pairs == score.said_pairs == score.real_pairs == 4_999_950_000 and score.f1 == 1.0


def owners_one_by_one(truth, labels, landmarks, false_ids):
    owners = []
    for landmark in landmarks:
        own = [f for f, k in zip(truth.tolist(), labels.tolist()) if k == landmark]
        real = [f for f in own if f >= 0]
        if false_ids and len(real) < len(own) / 2:
            owners.append(FALSE)
        elif real:
            owners.append(Counter(real).most_common(1)[0][0])  # of equals the one that came first
        else:
            owners.append(UNKNOWN)
    return owners


@settings(deadline=None)
@given(PROBLEMS, st.booleans(), st.permutations(range(7)), st.integers(0, 7), st.integers(1, 5))
def test_landmarks_are_those_found_one_by_one(problem, false_ids, numbers, size, least):
    """Oracle: a Counter for each landmark, and sets; the landmarks add up, whatever they are."""
    landmarks = np.array(numbers[:size], dtype=np.int64)
    owners = owners_one_by_one(*problem, landmarks.tolist(), false_ids)
    assert landmark_owners(*problem, landmarks, false_ids=false_ids).tolist() == owners
    score = score_landmarks(*problem, landmarks, false_ids=false_ids, least=least)
    of = Counter(owner for owner in owners if owner >= 0)
    seen = Counter(problem[0].tolist())
    assert score.spurious == (owners.count(FALSE) if false_ids else None)
    assert score.duplicates == sum(count - 1 for count in of.values())
    assert (score.found, score.unknown) == (len(of), owners.count(UNKNOWN))
    assert score.missed == sum(1 for f, k in seen.items() if f >= 0 and k >= least and f not in of)
    assert score.found + score.duplicates + score.unknown + (score.spurious or 0) == size


def test_a_landmark_is_what_most_of_its_sightings_are_though_clutter_founded_it():
    """Oracle: the definitions: the verdicts go by the founder, the final map by majority."""
    truth, labels = np.array([-1, 5, 5, 5]), np.array([3, 3, 3, 3])
    assert score_association(truth, labels, false_ids=True).right == 0
    assert landmark_owners(truth, labels, np.array([3]), false_ids=True).tolist() == [5]
    # half of them are real: not spurious; one less, and it is
    assert landmark_owners(truth[:2], labels[:2], np.array([3]), false_ids=True).tolist() == [5]
    assert landmark_owners(truth[:1], labels[:1], np.array([3]), false_ids=True).tolist() == [FALSE]
    assert score_landmarks(truth, labels, np.array([3])).spurious is None


def test_no_sightings_and_one():
    nothing = np.zeros(0, dtype=np.int64)
    score = score_association(nothing, nothing)
    assert score.accuracy is None and score.accuracy_used is None and len(score.verdicts) == 0
    assert score_association(np.array([]), np.array([])).unused == 0
    pairs = score_pairs(nothing, nothing)
    assert (pairs.said_pairs, pairs.precision, pairs.recall, pairs.f1) == (0, None, None, None)
    assert landmark_owners(nothing, nothing, np.array([4])).tolist() == [UNKNOWN]
    assert len(landmark_owners(np.array([1]), np.array([0]), nothing)) == 0
    one = score_association(np.array([3]), np.array([0]))
    assert (one.right_new, one.accuracy) == (1, 1.0)
    assert score_pairs(np.array([3]), np.array([0])).f1 is None
    left_aside = score_association(np.array([3]), np.array([SPURIOUS]))
    assert (left_aside.accuracy, left_aside.accuracy_used) == (0.0, None)


@pytest.mark.parametrize("judge", [score_association, score_pairs])
@pytest.mark.parametrize(
    ("truth", "labels", "says"),
    [
        ([1, 2], [1], "same length"),
        ([1.0, 2.0], [0, 1], "whole numbers"),
        ([1, 2], [0.0, np.nan], "whole numbers"),
        ([[1, 2]], [[0, 1]], "whole numbers"),
        ([1, 2], [0, -3], "-3 is no landmark"),
    ],
)
def test_lists_that_are_no_labels_are_refused(judge, truth, labels, says):
    with pytest.raises(ValueError, match=says):
        judge(np.array(truth), np.array(labels))


def test_a_landmark_named_twice_is_refused():
    with pytest.raises(ValueError, match="twice"):
        landmark_owners(np.array([1]), np.array([0]), np.array([0, 0]))


def judged(truth, labels, landmark_ids, **fields):
    """`evaluate` of an empty run with a map of these landmarks."""
    log = Log(name="t", source="t", defaults=RunConfig(), open=lambda skip: iter(()), **fields)
    n = len(landmark_ids)
    landmarks = Landmarks(
        np.array(landmark_ids), np.zeros((n, 2)), np.zeros((n, 2, 2)), np.ones(n, dtype=np.int64), np.ones(n)
    )
    trace = Trace(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), *[np.zeros(0)] * 6)
    estimate = Estimate(
        0.0, np.zeros(3), np.zeros((3, 3)), landmarks, {}, lambda: (np.zeros(0), np.zeros((0, 0)))
    )
    association = None if truth is None else (np.array(truth), np.array(labels))
    metrics = evaluate(trace, estimate, log, ids_known=False, association=association)
    return {key: value for key, value in metrics.items() if key.startswith("association_")}


def test_evaluate_makes_flat_metrics_of_it():
    """Oracle: counted by hand: features 1, 2, 2 again, and clutter founding a landmark; 4 is seen thrice."""
    truth = [1, 1, 2, 2, 2, -1, -1, 4, 4, 4]
    labels = [0, 0, 5, 5, 6, 7, SPURIOUS, SPURIOUS, 0, SPURIOUS]
    metrics = judged(truth, labels, [0, 5, 6, 7], false_ids=True)
    assert metrics == {
        "association_accuracy": 0.5,
        "association_accuracy_used": pytest.approx(4 / 7),
        "association_precision": pytest.approx(2 / 4),
        "association_recall": pytest.approx(2 / 7),
        "association_f1": pytest.approx(4 / 11),
        "association_right": 2,
        "association_wrong": 0,
        "association_missed_new": 1,
        "association_right_new": 2,
        "association_false_new": 1,
        "association_unused": 2,
        "association_false_rejected": 1,
        "association_false_admitted": 1,
        "association_unscored": 0,
        "association_spurious_landmarks": 1,
        "association_duplicate_landmarks": 1,
        "association_unknown_landmarks": 0,
        "association_missed_features": 1,
    }
    unsaid = judged(truth, labels, [0, 5, 6, 7])
    assert unsaid["association_spurious_landmarks"] is None and unsaid["association_unscored"] == 2
    assert unsaid["association_unknown_landmarks"] == 1 and unsaid["association_accuracy"] == pytest.approx(
        4 / 8
    )
    assert judged(None, None, [0], false_ids=True) == {"association_accuracy": None}


def test_the_report_reads_every_one_of_them():
    """Oracle: each metric has a sentence of its own; a count that is not known says so."""
    known = judged([1, 1, -1], [0, 0, 1], [0, 1], false_ids=True)
    said = [reading(key, value) for key, value in known.items()]
    assert all(said) and len(set(said)) == len(said) == 18
    unsaid = judged([1, 1, -1], [0, 0, 1], [0, 1])["association_spurious_landmarks"]
    assert "does not say" in reading("association_spurious_landmarks", unsaid)
    assert "decided in its frame" in reading("association_accuracy_at_once", 0.5)
    assert (
        reading("association_s", 1.5) == "" and reading("association_s", None) == ""
    )  # its label says it all
    assert metric_of("association_recall").unit == metric_of("association_accuracy_used").unit == "%"
