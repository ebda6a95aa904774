"""The audit trail as a file: exact round trips, stories and counts that are true, refusals with a name."""

from __future__ import annotations

import sqlite3

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kalmap.data import open_audit, write_audit
from kalmap.records import SPURIOUS, Frame, Managed, Reason, Why
from kalmap.records.trail import CLOSE, Trouble, doubts, trouble
from trails import (
    GATE,
    cluster,
    contest,
    decide,
    drive,
    easy,
    nothing,
    opened_trail,  # noqa: F401
    replaced,
    scattered,
)

numbers = st.floats(width=64)  # NaN and infinity too
whole = st.integers(0, 2**62)


def same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Equal to the last bit, NaN to NaN; sqlite knows no sign of zero."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def assert_same(written: Frame, read: Frame) -> None:
    for name in ("pose", "sensor", "values", "labels", "trial", "landmarks", "positions", "spreads"):
        assert same(getattr(written, name), getattr(read, name)), name
    for name in ("reasons", "pairs", "squared", "log_volume"):
        assert same(getattr(written.why, name), getattr(read.why, name)), name
    assert written.noises is None or not written.noises.size or same(np.array(written.noises), read.noises)
    for one, other in ((written.time, read.time), (written.why.gate, read.why.gate)):
        assert one == other or (np.isnan(one) and np.isnan(other))
    assert (written.number, written.why.notes) == (read.number, read.why.notes)
    assert written.why.managed == read.why.managed


@pytest.mark.parametrize("make", [easy, contest, nothing, cluster])
def test_a_frame_comes_back_as_it_was(trail, make):
    frame = make()
    assert_same(frame, trail(frame).frame(frame.number))


@st.composite
def frames(draw) -> Frame:
    """Any frame whose arrays fit each other, whatever numbers it holds."""
    seen, places = draw(st.integers(0, 4)), draw(st.integers(0, 3))
    pairs = draw(st.integers(0, 5)) if seen else 0

    def floats(*shape):
        return draw(arrays(np.float64, shape, elements=numbers))

    half = floats(places, 2, 2)
    half[:, 0, 1] = half[:, 1, 0]
    managed = st.builds(
        Managed, whole, st.sampled_from(["founded", "merged"]), st.text(), st.integers(-1, 2**62)
    )
    return Frame(
        number=draw(whole),
        time=draw(numbers),
        pose=floats(3),
        sensor=floats(3),
        values=floats(seen, 2),
        labels=draw(arrays(np.int64, seen)),
        trial=draw(arrays(np.bool_, seen)),
        why=Why(
            gate=draw(numbers),
            new_gate=draw(numbers),
            reasons=draw(arrays(np.int64, seen, elements=st.sampled_from([int(r) for r in Reason]))),
            pairs=np.column_stack(
                [
                    draw(arrays(np.int64, pairs, elements=st.integers(0, seen - 1))),
                    draw(arrays(np.int64, pairs)),
                ]
            )
            if pairs
            else np.zeros((0, 2), dtype=np.int64),
            squared=floats(pairs),
            log_volume=floats(pairs),
            notes=tuple(draw(st.lists(st.text(), max_size=2))),
            managed=tuple(draw(st.lists(managed, max_size=2))),
        ),
        landmarks=draw(arrays(np.int64, places)),
        positions=floats(places, 2),
        spreads=half,
    )


@given(frames())
@settings(max_examples=60, deadline=None)
def test_any_frame_comes_back_as_it_was_and_no_nan_is_written(tmp_path_factory, frame):
    """Whatever a frame holds. NaN stands in the file as NULL (Oracle: sqlite's own typeof)."""
    path = tmp_path_factory.getbasetemp() / "any.sqlite"
    with np.errstate(invalid="ignore"):
        write_audit(path, [frame], {})
    with open_audit(path) as audit:
        assert_same(frame, audit.frame(frame.number))
    with sqlite3.connect(path) as raw:
        kinds = [kind for (kind,) in raw.execute("SELECT typeof(squared) FROM candidates ORDER BY number")]
    raw.close()
    assert kinds == ["null" if np.isnan(value) else "real" for value in frame.why.squared]


def test_noises_that_were_not_kept_come_back_as_none(trail):
    bare = msgspec.structs.replace(contest(), noises=None)
    assert trail(bare).frame(812).noises is None


# --- stories and counts -------------------------------------------------------------------------------------------


def life() -> list[Frame]:
    """Landmark 5 is founded in frame 2, confirmed in 4, loses a sighting to 9 in 5 and is merged into 3 in 6, which
    is merged into 1 in 7; 9 is retired in 7, and 12 is on trial at the end.
    """
    far = np.array([50.0, 50.0])

    def frame(number, at, known, *managed, trial=(), fresh=12):
        points = np.array(at, dtype=float).reshape(-1, 2)
        return decide(
            number, scattered(range(1), [far]) | known, points, managed=managed, trial=trial, fresh=fresh
        )

    five = {5: (np.array([10.0, 0.0]), 0.01 * np.eye(2))}
    nine = {9: (np.array([10.3, 0.3]), 0.01 * np.eye(2))}
    return [
        frame(2, [(10.0, 0.0)], {}, Managed(5, "founded", "nothing near"), fresh=5),
        frame(3, [], five),
        frame(4, [(10.1, 0.0)], five, Managed(5, "confirmed", "information counter 2")),
        frame(5, [(10.3, 0.3)], five | nine),
        frame(6, [(10.0, 0.1)], five, Managed(5, "merged", "jointly compatible, d^2 0.4", 3)),
        frame(
            7,
            [(-20.0, 9.0)],
            {},
            Managed(3, "merged", "again", 1),
            Managed(9, "retired", "not seen for long"),
        ),
    ]


def test_the_story_of_a_landmark_from_founding_to_merger(trail):
    """Oracle: the life as it was written down."""
    audit = trail(*life())
    story = audit.landmark(5)
    assert (story.fate, story.founded, story.confirmed, story.ended) == ("merged", 2, 4, 6)
    assert (story.into, story.final) == (3, 1)
    assert [(one.frame, one.reason, one.trial) for one in story.sightings] == [
        (2, Reason.FOUNDED, True),
        (4, Reason.NEAREST, False),
        (6, Reason.NEAREST, False),
    ]
    assert np.isnan(story.sightings[0].squared) and story.sightings[1].time == pytest.approx(0.8)
    assert [(one.frame, one.action, one.why) for one in story.happened] == [
        (2, "founded", "nothing near"),
        (4, "confirmed", "information counter 2"),
        (6, "merged", "jointly compatible, d^2 0.4"),
    ]
    (passed,) = story.passed
    assert (passed.frame, passed.given, passed.reason) == (
        5,
        9,
        Reason.NEAREST,
    ) and 0.0 < passed.squared < GATE
    (seen,) = audit.landmark(9).sightings
    assert seen.others == ((5, passed.squared),)
    assert seen.margin == pytest.approx(passed.squared - seen.squared)


def test_fates_and_mergers_are_followed(trail):
    audit = trail(*life())
    assert [audit.final(label) for label in (5, 3, 1, 9, 77, SPURIOUS)] == [1, 1, 1, 9, 77, SPURIOUS]
    fates = {number: audit.landmark(number).fate for number in (1, 3, 5, 9, 12)}
    assert fates == {1: "confirmed", 3: "merged", 5: "merged", 9: "retired", 12: "trial"}
    assert [one.landmark for one in audit.landmark(3).happened] == [5, 3]
    summary = audit.summary()
    assert (summary.confirmed, summary.trial, summary.retired, summary.merged) == (1, 1, 1, 2)


def test_mergers_in_a_circle_come_to_an_end(trail):
    """No writer should write such a thing; a reader must not hang on it."""
    managed = (Managed(1, "merged", "", 2), Managed(2, "merged", "", 1))
    assert trail(replaced(nothing(), managed=managed)).final(1) == 2


def test_stories_and_counts_agree_with_the_frames(trail):
    """Oracle: loops over the frames as they were handed in."""
    handed = [
        *drive(90),
        *(msgspec.structs.replace(make(), number=900 + k) for k, make in enumerate((contest, cluster))),
    ]
    audit = trail(*handed)
    for number in (0, 3, 7, 17, 19):
        story, seen, passed = audit.landmark(number), [], []
        for frame in handed:
            for m, label in enumerate(frame.labels.tolist()):
                pairs = {
                    int(n): d
                    for (k, n), d in zip(frame.why.pairs, frame.why.squared.tolist(), strict=True)
                    if k == m
                }
                own = pairs.pop(number, np.nan)
                if label == number:
                    seen.append(
                        (frame.number, m, own, tuple(sorted(pairs.items(), key=lambda pair: pair[1])))
                    )
                elif own < frame.why.gate:
                    passed.append((frame.number, m, own, label))
        assert [(one.frame, one.sighting, one.others) for one in story.sightings] == [
            (f, m, o) for f, m, _, o in seen
        ]
        np.testing.assert_array_equal(
            [one.squared for one in story.sightings], [own for _, _, own, _ in seen]
        )
        assert [(one.frame, one.sighting, one.squared, one.given) for one in story.passed] == passed
    summary, found = audit.summary(), [trouble(frame) for frame in handed]
    reasons = np.concatenate([frame.why.reasons for frame in handed])
    labels = np.concatenate([frame.labels for frame in handed])
    assert summary.reasons == {int(r): int((reasons == r).sum()) for r in np.unique(reasons)}
    assert (summary.frames, summary.sightings, summary.unused) == (92, len(labels), int((labels < 0).sum()))
    assert summary.founded == (reasons == Reason.FOUNDED).sum()
    assert summary.matched + summary.founded + summary.unused == summary.sightings
    assert summary.troubled == sum(one.total > 0 for one in found)
    assert summary.trouble.total == sum(one.total for one in found)
    ranked = sorted(zip(handed, found, strict=True), key=lambda pair: (-pair[1].total, pair[0].number))
    worst = [(frame.number, frame.time, one) for frame, one in ranked[:10] if one.total]
    assert list(summary.worst) == worst


def test_the_frame_nearest_to_a_time(trail):
    """Oracle: argmin over the times."""
    handed = [
        msgspec.structs.replace(nothing(), number=10 + k, time=t) for k, t in enumerate((1.0, 2.5, 2.5, 9.0))
    ]
    audit = trail(*handed)
    assert (audit.frames(), audit.frame_at(-1e9).number, audit.frame_at(2.5).number) == (4, 10, 11)
    for time in np.random.default_rng(1).uniform(0.0, 12.0, 30):
        nearest = int(np.argmin([abs(frame.time - time) for frame in handed]))
        assert audit.frame_at(time).number == 10 + nearest


# --- trouble ------------------------------------------------------------------------------------------------------


def doubtful(reason: Reason, second: float, label: int = 1, volume: float = 0.0) -> Frame:
    """One sighting at d^2 = 1 from landmark 1 and at `second` from landmark 2, gate 9.21."""
    frame = decide(0, scattered(range(1, 3), [[10, 0], [10, 1]]), np.array([[10.0, 0.2]]))
    return replaced(
        frame,
        labels=np.array([label]),
        reasons=np.array([int(reason)]),
        squared=np.array([1.0, second]),
        log_volume=np.array([0.0, volume]),
    )


@pytest.mark.parametrize(
    ("frame", "kind"),
    [
        (doubtful(Reason.NEAREST, 8.0), ""),
        (doubtful(Reason.NEAREST, 0.999 * CLOSE + 1.0), "rival"),
        (doubtful(Reason.NEAREST, 1.001 * CLOSE + 1.0), ""),
        (doubtful(Reason.NEAREST, 8.0, volume=-3.0), "rival"),
        (doubtful(Reason.NEAREST, 9.3, volume=-9.0), ""),
        (doubtful(Reason.NEAREST, np.nan), ""),
        (doubtful(Reason.FALSE_ALARM, 8.0, SPURIOUS), "rival"),
        (doubtful(Reason.AMBIGUOUS, 8.0, SPURIOUS), "rival"),
        (doubtful(Reason.CONTEST_LOST, 8.0, SPURIOUS), "contest"),
        (doubtful(Reason.JOINTLY_INCOMPATIBLE, 8.0, SPURIOUS), "contest"),
        (doubtful(Reason.BETWEEN_GATES, 30.0, SPURIOUS), "between gates"),
        (doubtful(Reason.OFFSET, 30.0), "offset"),
        (doubtful(Reason.WIDENED, 1.0), "offset"),
    ],
)
def test_what_is_trouble(frame, kind):
    """Each kind of doubt, at both sides of its bounds."""
    assert doubts(frame) == [kind]
    assert trouble(frame).total == bool(kind)


def test_trouble_counts_every_sighting_once():
    assert trouble(contest()) == Trouble(contests=1, rivals=1)
    assert trouble(contest()).in_words() == "1 contest, 1 close rival"
    assert trouble(nothing()) == Trouble() and Trouble().in_words() == ""
    assert 0 < trouble(cluster()).total <= 20
