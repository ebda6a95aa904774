"""Stories by hand in which a later frame changes what an earlier one was taken for."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import (
    Keep,
    KnownIds,
    Trial,
)
from kalmap.records import NEW, SPURIOUS, Reason, Sightings
from kalmap.slam import LandmarkSlam, run
from slam_problems import feed, log_of
from window_problems import (
    DIAMETER,
    OVERTURNED,
    assert_same_state,
    labels_of,
    standing,
    still,
    told,
)


def test_what_is_seen_once_was_nothing():
    """Oracle: by hand, and a filter by identities that was told that it is nothing: 20 m founds a landmark and is
    gone a frame later; the landmarks behind it move up."""
    events, settings = standing([[10.0], [10.0, 20.0, 15.0], [10.0, 15.0]]), still(management=Keep())
    slam = feed(LandmarkSlam(**settings), events[:4])
    assert slam._ids == [0, 1, 2] and slam.frame_labels.tolist() == [0, 1, 2]
    feed(slam, events[4:])
    assert slam._ids == [0, 1] and slam._founded == 2 and slam.frame_labels.tolist() == [0, 1]
    assert list(slam.frame_revisions) == [1] and slam.frame_revisions[1][0].tolist() == [0, SPURIOUS, 1]
    ids = [[0], [0, -1, 1], [0, 1]]
    for event, known in zip(events[1::2], ids, strict=True):
        event.ids[:] = known
    twin = feed(LandmarkSlam(settings["motion"], association=KnownIds()), events)
    np.testing.assert_allclose(slam._belief.mean[:7], twin._belief.mean[:7], atol=1e-9)
    np.testing.assert_allclose(slam._belief.covariance(), twin._belief.covariance(), atol=1e-9)
    assert labels_of(events, **settings) == [[0], [0, SPURIOUS, 1], [0, 1]]


def test_the_next_frame_overturns_a_decision():
    """Oracle: by hand and a filter told the end of the story: 10 m is a landmark on trial. At first the nearer of
    two (distance squared 1 and 4) is it, which confirms it, and the other is false; the next frame sees one at 10
    m and one farther out (0 and 9), so the farther is new in both frames, the other is the landmark."""
    settings = still(management=Trial(confirm=3))
    slam = feed(LandmarkSlam(**settings), OVERTURNED[:6])
    assert slam.frame_labels.tolist() == [0, SPURIOUS] and slam.landmark_count == 1 == slam.frame_used
    provisional = slam._belief.mean[3]
    feed(slam, OVERTURNED[6:])
    assert slam.frame_revisions[2][0].tolist() == [1, 0] and slam.frame_labels.tolist() == [0, 1]
    decisions = [None, ([NEW], False), None, ([0], False), None, ([NEW, 0], False), None, ([0, 1], True)]
    assert_same_state(slam, told(decisions, OVERTURNED, **settings))
    assert slam._counts == [4, 2] and slam._on_trial == {1} and slam.frames_taken == 4
    assert [int(score) for score in slam._memory["score"]] == [
        3,
        2,
    ]  # it counts no further once it is believed
    assert slam._belief.mean[3] < 10.0 < provisional
    assert labels_of(OVERTURNED, **settings) == [[0], [0], [SPURIOUS, 0], [0, SPURIOUS]]  # 1 is on trial


def test_the_audit_trail_tells_the_story_as_it_ended():
    """Oracle: by hand: the entry of the frame that was taken again has the labels, reasons and landmarks of the
    second telling, under the frame's own number; and no explanation changes the filter."""
    settings = still(management=Trial(confirm=3))
    slam = LandmarkSlam(**settings)
    trail = run(slam, log_of(OVERTURNED), explain=True).decisions
    assert [entry.number for entry in trail] == [0, 1, 2, 3]
    assert [entry.labels.tolist() for entry in trail] == [[0], [0], [1, 0], [0, 1]]
    assert [entry.why.reasons.tolist() for entry in trail] == [
        [Reason.FOUNDED], [Reason.WINDOW], [Reason.FOUNDED, Reason.WINDOW], [Reason.WINDOW] * 2,
    ]  # fmt: skip
    assert trail[2].why.notes == ("taken again",) and trail[2].time == 2.0
    assert [(m.landmark, m.action) for m in trail[2].why.managed] == [(1, "founded"), (0, "confirmed")]
    assert "over 2 frames" in trail[3].why.notes[0]
    assert_same_state(slam, feed(LandmarkSlam(**settings), OVERTURNED))


def test_what_looked_false_is_a_new_landmark():
    """Oracle: by hand: beside a landmark on trial that has its sighting another is false, until it is seen again."""
    events, settings = (
        standing([[10.0], [10.0], [10.0, 10.3], [10.0, 10.3]]),
        still(management=Trial(confirm=9)),
    )
    slam = feed(LandmarkSlam(**settings), events[:6])
    assert slam.frame_labels.tolist() == [0, SPURIOUS]
    feed(slam, events[6:])
    assert slam.frame_revisions[2][0].tolist() == [0, 1] and slam.frame_labels.tolist() == [0, 1]


def test_the_third_frame_overturns_two():
    """Oracle: by hand and a filter by identities: 10.2 m is the landmark at 10 m rather than that at 10.5 m (distance
    squared 2 and 4.5), until a third frame sees 10.5 m again."""
    events, settings = standing([[10.0, 10.5], [10.2], [10.5]]), still(window=3, management=Keep())
    slam = feed(LandmarkSlam(**settings), events[:4])
    assert slam.frame_revisions[0][0].tolist() == [0, SPURIOUS] and slam.frame_labels.tolist() == [0]
    feed(slam, events[4:])
    assert {f: r[0].tolist() for f, r in slam.frame_revisions.items()} == {0: [SPURIOUS, 0], 1: [0]}
    for event, known in zip(events[1::2], [[-1, 4], [4], [4]], strict=True):
        event.ids[:] = known
    twin = feed(LandmarkSlam(settings["motion"], association=KnownIds()), events)
    np.testing.assert_allclose(slam._belief.mean[:5], twin._belief.mean[:5], atol=1e-9)
    np.testing.assert_allclose(slam._belief.covariance(), twin._belief.covariance(), atol=1e-9)


@pytest.mark.parametrize("window", [2, 3])
def test_numbers_that_moved_up_are_not_taken_for_others(window):
    """Oracle: by hand: 20 m founds 0 and 10 m founds 1; as 20 m was nothing, 10 m is 0 from then on, also in frames
    that were looked at before that was known. Nothing is revised any more."""
    events = standing([[20.0, 10.0], [10.0], [10.0], [10.0], [10.0]])
    settings = still(window=window, management=Keep())
    slam = LandmarkSlam(**settings)
    revised = [feed(slam, events[k : k + 2]).frame_revisions for k in range(0, 10, 2)]
    assert [sorted(each) for each in revised] == [[], [0], [], [], []]
    assert slam._ids == [0] and slam._counts == [5]
    assert labels_of(events, **settings) == [[SPURIOUS, 0], [0], [0], [0], [0]]


def test_a_frame_is_looked_at_again_when_those_before_it_change():
    """Oracle: by hand: 10.2 m is 10 m, landmark 0, and 20 m is 1, until the third frame sees 10.5 m again: then 10 m
    was nothing, 20 m is 0 and 10.5 m is 1. By the old numbers the fourth frame would take 20 m for 10.2 m."""
    events = standing([[10.0, 20.0, 10.5], [10.2, 20.0], [10.5, 20.0], [10.5, 20.0], [10.5, 20.0]])
    settings = still(window=3, management=Keep())
    slam = LandmarkSlam(**settings)
    revised = [feed(slam, events[k : k + 2]).frame_revisions for k in range(0, 10, 2)]
    assert [sorted(each) for each in revised] == [[], [0], [0, 1], [], []]
    assert labels_of(events, **settings) == [[SPURIOUS, 0, 1], [1, 0], [1, 0], [1, 0], [1, 0]]


def test_doubt_is_no_reason_to_go_back():
    """Oracle: by hand: half-way between two landmarks a sighting is left unused, and stays so."""
    events = standing([[10.0, 10.6], [10.0, 10.6], [10.31], [10.0, 10.6], [10.0, 10.6]])
    for margin, expected in ((4.6, SPURIOUS), (0.0, 1)):
        settings = still(management=Keep(), ambiguity=margin)
        slam = LandmarkSlam(**settings)
        slam.explain = True
        feed(slam, events[:6])
        assert slam.frame_labels.tolist() == [expected]
        assert slam.frame_decision.why.reasons.tolist() == [Reason.AMBIGUOUS if margin else Reason.WINDOW]
        feed(slam, events[6:8])
        assert slam.frame_revisions == {}
        assert labels_of(events, **settings) == [[0, 1], [0, 1], [expected], [0, 1], [0, 1]]


def test_one_landmark_on_trial_is_not_given_twice():
    """Oracle: by hand: of two sightings of a landmark on trial one has it, the other is left."""
    events = standing([[10.0], [10.0], [10.0, 10.1]])
    slam = feed(LandmarkSlam(**still(management=Trial(confirm=9))), events)
    assert slam.frame_labels.tolist() == [0, SPURIOUS] and slam._counts == [3]


def test_a_frame_that_uses_nothing_says_so_though_others_were_taken_again():
    """Oracle: by hand: no innovation, no sighting used, no label of its own."""
    events = standing([[10.0], [10.0], [10.0, 20.0], []])
    slam = feed(LandmarkSlam(**still(management=Keep())), events)
    assert list(slam.frame_revisions) == [2] and slam.frame_used == 0 and np.isnan(slam.frame_nis)
    assert len(slam.frame_labels) == 0 and slam.frame_sightings is events[-1]


def test_sightings_that_differ_in_size_are_two_things():
    """Oracle: by hand: in one place, but a thick and a thin one: neither was seen twice."""
    events = standing([[10.0], [10.0]])
    sizes = ([0.2], [0.9])
    told_sizes = [
        Sightings(e.time, e.values, attributes={"diameter": np.array(sizes[k // 2])}) if k % 2 else e
        for k, e in enumerate(events)
    ]
    settings = still(management=Keep(), attributes=(DIAMETER,))
    assert labels_of(told_sizes, **settings) == [[SPURIOUS], [0]]
    assert labels_of(events, **still(management=Keep())) == [[0], [0]]


def test_what_is_no_point_may_have_moved_a_little():
    """Oracle: by hand: 0.6 m apart is four standard deviations and one thing only if things are wide."""
    events = standing([[10.0], [10.6]])
    assert labels_of(events, **still(management=Keep())) == [[SPURIOUS], [0]]
    assert labels_of(events, **still(management=Keep(), extent=0.5)) == [[0], [0]]


def test_two_landmarks_that_have_become_one_take_one_sighting():
    """Oracle: by hand: of sightings given to landmarks that are one by now, over two mergers, the first has it; a
    landmark that is gone is founded again."""
    slam = feed(LandmarkSlam(**still(management=Keep())), standing([[10.0, 15.0], [10.0, 15.0]]))
    slam.merged = {7: 5, 5: 1}
    entry = slam._window.pending[0]
    entry.frame = Sightings(9.0, np.array([[10.0, 0.0], [15.0, 0.0], [15.1, 0.0], [20.0, 0.0]]))
    entry.noises = slam.sensor.covariance(entry.frame.values)
    association = slam._window._conclude(entry, [(-1, 0), (-1, 7), (-1, 1), (-1, 8)], False, ())
    assert association.matched.tolist() == [0, 1, SPURIOUS, NEW]
