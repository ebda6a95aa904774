"""Verdicts on sightings, pairs of sightings, owners of landmarks, identities from outside."""

from __future__ import annotations

from collections import Counter
from itertools import combinations, permutations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from kalmap.data import open_log
from kalmap.evaluation import (
    Verdict,
    evaluate,
    landmark_owners,
    pair_by_nearest,
    score_association,
    score_landmarks,
    score_pairs,
    sighting_identities,
)
from kalmap.evaluation.owners import FALSE, UNKNOWN
from kalmap.records import NEW, SPURIOUS, Estimate, Landmarks, Log, RunConfig, Sightings, SightingTruth, Trace
from kalmap.view.reading import metric_of, reading
from real_data import data_root  # noqa: F401

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


def plane(values):
    return values[:, :1] * np.column_stack([np.cos(values[:, 1]), np.sin(values[:, 1])])


def saved_by_hand(distance, cutoff):
    """What the best one-to-one pairing saves of `cutoff` a pair, over all pairings."""
    if len(distance) > distance.shape[1]:
        distance = distance.T
    saving = np.maximum(cutoff - distance, 0.0)
    rows = range(len(saving))
    return max(
        saving[rows, list(columns)].sum() for columns in permutations(range(saving.shape[1]), len(rows))
    )


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 5))
def test_identities_of_a_crowded_frame(seed, found, given_to):
    """Oracle: every one-to-one pairing of the frame, and `pair_by_nearest`, which looks at the whole table."""
    rng, cutoff = np.random.default_rng(seed), 0.5
    values, true_values = (
        np.column_stack([rng.uniform(9.5, 10.5, n), rng.uniform(-0.05, 0.05, n)]) for n in (found, given_to)
    )
    truth = SightingTruth(np.full(given_to, 2.0), true_values, 10 + rng.permutation(given_to))
    ids = sighting_identities(np.full(found, 2.0), values, truth, cutoff=cutoff)
    distance = np.hypot(*(plane(values)[:, None] - plane(true_values)[None]).transpose(2, 0, 1))
    rows, columns = pair_by_nearest(plane(values), plane(true_values), cutoff)
    expected = np.full(found, -1)
    expected[rows] = truth.ids[columns]
    assert ids.tolist() == expected.tolist()
    place = {number: k for k, number in enumerate(truth.ids.tolist())}
    saved = [cutoff - distance[k, place[i]] for k, i in enumerate(ids.tolist()) if i >= 0]
    assert min(saved, default=1.0) > 0 and len(saved) == len({i for i in ids.tolist() if i >= 0})
    assert sum(saved) == pytest.approx(saved_by_hand(distance, cutoff), abs=1e-12)


def test_identities_over_many_frames():
    """Oracle: `pair_by_nearest` frame by frame; the sightings come shuffled, on a clock of Unix seconds."""
    rng = np.random.default_rng(4)
    times = np.repeat(1.2e9 + 0.2 * np.arange(60), 8)
    true_values = np.column_stack([rng.uniform(2, 4, 480), rng.uniform(-0.6, 0.6, 480)])
    truth = SightingTruth(times, true_values, rng.integers(0, 100, 480))
    values = true_values + rng.normal(0, [0.2, 0.03], (480, 2))
    order = rng.permutation(480)
    kept = order[:400]
    ids = sighting_identities(times[kept] + rng.uniform(-4e-4, 4e-4, 400), values[kept], truth)
    expected = np.full(400, -1)
    for time in np.unique(times):
        here, there = np.flatnonzero(times[kept] == time), np.flatnonzero(times == time)
        rows, columns = pair_by_nearest(plane(values[kept[here]]), plane(true_values[there]), 0.5)
        expected[here[rows]] = truth.ids[there[columns]]
    assert 300 < np.sum(expected >= 0) < 400
    assert ids.tolist() == expected.tolist()


def test_an_identity_needs_the_same_instant_and_place():
    """Oracle: by hand; the bounds are those of the docstring: within the tolerance, below the cutoff."""
    truth = SightingTruth(np.array([1.0, 2.0]), np.array([[5.0, 0.0], [5.0, 0.0]]), np.array([7, 8]))
    times = np.array([1.0, 1.0625, 1.125, 2.0, 2.0, 2.0, np.nan, 1.0, 1.0, 1e300])
    values = np.array(
        [
            [5, 0],
            [5.125, 0],
            [5, 0],
            [5.25, 0],
            [5.4, 0],
            [-5, np.pi],
            [5, 0],
            [np.inf, 0],
            [5, np.nan],
            [5, 0],
        ]
    )
    alone = [
        sighting_identities(times[k : k + 1], values[k : k + 1], truth, tolerance=0.0625)[0]
        for k in range(10)
    ]
    assert alone == [7, 7, -1, 8, 8, 8, -1, -1, -1, -1]
    ids = sighting_identities(times, values, truth, cutoff=0.4, tolerance=0.0625)
    assert ids.tolist() == [7, -1, -1, -1, -1, 8, -1, -1, -1, -1]
    backwards = sighting_identities(times[::-1], values[::-1], truth, cutoff=0.4, tolerance=0.0625)
    assert backwards.tolist() == ids.tolist()[::-1]
    edge = sighting_identities(times[3:4], values[3:4], truth, cutoff=0.25)
    assert edge.tolist() == [-1]


def test_identities_of_nothing_and_from_nothing():
    nothing = SightingTruth(np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    one = SightingTruth(np.zeros(1), np.ones((1, 2)), np.array([3]))
    assert sighting_identities(np.zeros(0), np.zeros((0, 2)), one).tolist() == []
    assert sighting_identities(np.zeros(2), np.ones((2, 2)), nothing).tolist() == [-1, -1]
    # the same sighting two hundred times: it can be the given one only once
    crowd = sighting_identities(np.zeros(200), np.ones((200, 2)), one)
    assert sorted(crowd.tolist())[-2:] == [-1, 3]
    broken = SightingTruth(np.zeros(2), np.array([[np.nan, 1.0], [1.0, 1.0]]), np.array([3, 4]))
    assert sighting_identities(np.zeros(1), np.ones((1, 2)), broken).tolist() == [4]


@pytest.mark.parametrize(
    ("times", "values", "options", "says"),
    [
        (np.zeros(2), np.zeros((3, 2)), {}, "values"),
        (np.zeros(2), np.zeros((2, 3)), {}, "values"),
        (np.zeros(2), np.zeros((2, 2)), {"cutoff": 0.0}, "finite and positive"),
        (np.zeros(2), np.zeros((2, 2)), {"cutoff": np.nan}, "finite and positive"),
        (np.zeros(2), np.zeros((2, 2)), {"tolerance": np.inf}, "finite and positive"),
    ],
)
def test_identities_asked_for_in_a_wrong_way(times, values, options, says):
    truth = SightingTruth(np.zeros(1), np.ones((1, 2)), np.array([3]))
    with pytest.raises(ValueError, match=says):
        sighting_identities(times, values, truth, **options)
    with pytest.raises(ValueError, match="as many ids"):
        sighting_identities(np.zeros(1), np.ones((1, 2)), msgspec.structs.replace(truth, ids=np.arange(2)))


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


def detections(folder):
    """A folder with two scans of detections, the first two of which the reference names."""
    cells = np.empty((1, 2), dtype=object)
    cells[0] = [np.array([[5.0, 6.0], [1.0, 2.0], [0.3, 0.4]]), np.array([[7.0], [1.5], [0.3]])]
    content = {"time": np.arange(5.0), "u": np.ones((2, 5)), "TLsr": np.array([0.5, 1.5]), "zt": cells}
    savemat(folder / "VictoriaParkSinSincronizar.mat", content)
    return folder


def test_identities_stand_beside_the_detections_where_their_file_is(tmp_path):
    """Oracle: the rows written, by hand; a row that is no good, or not named, is left out."""
    folder = detections(tmp_path)
    assert open_log(folder, variant="detections").sighting_truth is None
    rows = np.array(
        [
            [500.0, 6.0, 2.0, 0.0, 0.0, 9.0],
            [500.0, 5.0, 1.0, 0.0, 0.0, 7.0],
            [700.0, np.nan, 1.0, 0.0, 0.0, 7.0],
            [800.0, 5.0, 1.0, 0.0, 0.0, 7.5],
            [900.0, 5.0, 1.0, 0.0, 0.0, -1.0],
        ]
    )
    savemat(folder / "data_sensor_clean_clean.mat", {"data_sensor_clean_clean": rows})
    log = open_log(folder, variant="detections")
    truth = log.sighting_truth
    assert truth.times.tolist() == [0.5, 0.5] and truth.ids.tolist() == [9, 7]
    np.testing.assert_allclose(truth.values, [[6.0, 2.0 - np.pi / 2], [5.0, 1.0 - np.pi / 2]])
    assert not log.false_ids
    frames = [event for event in log if isinstance(event, Sightings)]
    found = [sighting_identities(np.full(len(f.values), f.time), f.values, truth).tolist() for f in frames]
    assert found == [[7, 9], [-1]] and all(frame.ids is None for frame in frames)


def all_sightings(log):
    frames = [event for event in log if isinstance(event, Sightings)]
    times = np.repeat([frame.time for frame in frames], [len(frame.values) for frame in frames])
    return times, np.concatenate([frame.values for frame in frames])


def test_victoria_parks_detections_get_the_identities_of_the_exact_rows(data_root):  # noqa: F811
    """Oracle: the two files joined on their exact numbers (ms, range, bearing): 46860 of them are named."""
    folder = data_root / "victoria_park"
    rows = loadmat(folder / "data_sensor_clean_clean.mat")["data_sensor_clean_clean"]
    named = {(round(row[0]), row[1], row[2]): int(row[5]) for row in rows}
    raw = loadmat(folder / "VictoriaParkSinSincronizar.mat")
    expected = [
        named.get((round(1000 * time), z, bearing), -1)
        for time, scan in zip(raw["TLsr"].ravel(), raw["zt"].ravel())
        if time >= raw["time"].ravel()[0]  # what is seen before the first odometry is left out
        for z, bearing, _ in (scan.T if scan.size else ())
    ]
    log = open_log(folder, variant="detections")
    ids = sighting_identities(*all_sightings(log), log.sighting_truth)
    assert ids.tolist() == expected and np.sum(ids >= 0) == 46860
    assert len(np.unique(ids[ids >= 0])) == 299 and log.sighting_truth.ids.shape == (46860,)


def test_victoria_parks_ascii_clock_starts_later(data_root):  # noqa: F811
    """Oracle: the same 46860 identities, in the same order, as on the MATLAB files' clock."""
    logs = {
        name: open_log(data_root / "victoria_park", variant=name) for name in ("detections", "ascii", "scans")
    }
    truths = {name: log.sighting_truth for name, log in logs.items()}
    ids = {
        name: sighting_identities(*all_sightings(logs[name]), truths[name])
        for name in ("detections", "ascii")
    }
    assert [np.sum(each >= 0) for each in ids.values()] == [46860, 46860]
    assert np.array_equal(*(each[each >= 0] for each in ids.values()))
    for of, then in zip(msgspec.structs.astuple(truths["scans"]), msgspec.structs.astuple(truths["ascii"])):
        assert np.array_equal(of, then)
    assert truths["detections"].times - truths["scans"].times == pytest.approx(20.967, abs=1e-9)
    assert open_log(data_root / "victoria_park").sighting_truth is None  # its sightings say it themselves


@pytest.mark.parametrize("name", ["victoria_park", "dlr", "mrclam/MRCLAM_Dataset9", "mrclam/MRCLAM_Dataset7"])
def test_an_unidentified_sighting_is_not_said_to_be_false(data_root, name):  # noqa: F811
    """Oracle: the data sets' descriptions: -1 is unidentified (DLR) or a bar code not listed (MRCLAM)."""
    log = open_log(data_root / name, robot=3 if "mrclam" in name else None)
    assert log.truth_ids and not log.false_ids
    ids = np.concatenate([event.ids for event in log if isinstance(event, Sightings)])
    unknown = {"victoria_park": 0, "dlr": 436, "mrclam/MRCLAM_Dataset7": 9}
    if name in unknown:
        assert np.sum(ids < 0) == unknown[name]
    labels = np.where(ids < 0, SPURIOUS, ids)  # as the log itself would have it
    score = score_association(ids, labels)
    assert score.accuracy == 1.0 and score.unscored == np.sum(ids < 0) and score.false_rejected == 0
