"""Identities of sightings from outside: paired by place and instant, and those that come with recorded logs."""

from __future__ import annotations

from itertools import permutations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from kalmap.data import open_log
from kalmap.evaluation import pair_by_nearest, score_association, sighting_identities
from kalmap.records import SPURIOUS, Sightings, SightingTruth
from real_data import data_root  # noqa: F401


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
