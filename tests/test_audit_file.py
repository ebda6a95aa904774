"""The audit trail's file: it explains itself, stays small, and refuses what is missing, foreign or damaged."""

from __future__ import annotations

import sqlite3

import msgspec
import numpy as np
import pytest

from kalmap.data import open_audit, write_audit
from kalmap.data.audit import AUDIT
from kalmap.records import REASONS, SPURIOUS, KalmapError, LogError, Reason
from trails import (
    contest,
    drive,
    easy,
    opened_trail,  # noqa: F401
    replaced,
)


def test_the_file_explains_itself(trail, tmp_path):
    """Its sentences are those of `REASONS`; a view reads as sentences; it says where it comes from."""
    audit = trail(contest(), log="park", command="kalmap run park")
    assert audit.reasons() == {int(reason): sentence for reason, sentence in REASONS.items()}
    assert audit.about()["log"] == "park" and audit.about()["format"] == "kalmap-association/1"
    raw = sqlite3.connect(tmp_path / AUDIT)
    rows = raw.execute("SELECT sighting, landmark, sentence FROM decisions ORDER BY sighting").fetchall()
    raw.close()
    assert rows[1] == (1, SPURIOUS, REASONS[Reason.CONTEST_LOST]) and len(rows) == 6


def test_a_trail_of_a_thousand_frames_is_small(tmp_path):
    """7,000 frames of 7 sightings with 4 candidates each stay below 20 MB: here a seventh of them."""
    many = []
    for k, frame in enumerate(drive(100) * 10):
        why = frame.why
        four = {name: np.repeat(getattr(why, name), 4, axis=0) for name in ("pairs", "squared", "log_volume")}
        four["squared"] = four["squared"] + np.random.default_rng(k).uniform(0.1, 1.0, len(four["squared"]))
        many.append(replaced(frame, number=k, **four))
    write_audit(tmp_path / AUDIT, many, {})
    assert np.mean([len(frame.labels) for frame in many]) == 7.0
    assert (tmp_path / AUDIT).stat().st_size < 20e6 / 7.0


def test_an_empty_trail(trail):
    audit = trail()
    summary = audit.summary()
    assert (audit.frames(), summary.frames, summary.sightings, summary.first, summary.worst) == (
        0,
        0,
        0,
        None,
        (),
    )
    assert audit.final(4) == 4
    for question in (lambda: audit.frame(0), lambda: audit.landmark(0), lambda: audit.frame_at(1.0)):
        with pytest.raises(LogError, match="holds no"):
            question()


def test_what_does_not_exist_is_named_with_the_nearest(trail):
    audit = trail(contest(), msgspec.structs.replace(easy(), number=900))
    for question, words in (
        (
            lambda: audit.frame(840),
            "frame 840 does not exist; numbers run from 812 to 900, the nearest is 812",
        ),
        (
            lambda: audit.landmark(30),
            "landmark 30 does not exist; numbers run from 0 to 100, the nearest is 21",
        ),
        (lambda: audit.landmark(-2), "the nearest is 0"),
        (lambda: audit.landmark(2**70), "64 bits"),
        (lambda: audit.frame_at(float("nan")), "nan is no time"),
    ):
        with pytest.raises(LogError, match=words):
            question()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"labels": np.zeros(5, dtype=np.int64)}, r"frame 812 .*labels: expected \(6,\), found \(5,\)"),
        ({"reasons": np.zeros(7, dtype=np.int64)}, "reasons"),
        ({"squared": np.zeros(1)}, "squared"),
        ({"pairs": np.zeros((6, 3), dtype=np.int64)}, "pairs"),
        ({"pairs": np.full((6, 2), 6)}, "pairs: speak of a sighting that is not there"),
        ({"pose": np.zeros(2)}, "pose"),
        ({"spreads": np.zeros((5, 4))}, "spreads"),
        ({"noises": np.zeros((1, 2, 2))}, "noises"),
    ],
)
def test_a_frame_whose_parts_do_not_fit_is_refused_and_the_old_file_stays(tmp_path, changes, words):
    write_audit(tmp_path / AUDIT, [easy()], {})
    before = (tmp_path / AUDIT).read_bytes()
    with pytest.raises(KalmapError, match=words):
        write_audit(tmp_path / AUDIT, [easy(), replaced(contest(), **changes)], {})
    assert (tmp_path / AUDIT).read_bytes() == before and [one.name for one in tmp_path.iterdir()] == [AUDIT]


def test_other_failures_leave_the_old_file_too(tmp_path):
    """A number given twice; a source of frames that fails; a folder that does not exist."""
    write_audit(tmp_path / AUDIT, [easy()], {})
    before = (tmp_path / AUDIT).read_bytes()

    def broken():
        yield contest()
        raise RuntimeError("no more")

    with pytest.raises(KalmapError, match="same number"):
        write_audit(tmp_path / AUDIT, [easy(), easy()], {})
    with pytest.raises(RuntimeError, match="no more"):
        write_audit(tmp_path / AUDIT, broken(), {})
    with pytest.raises(KalmapError, match="cannot be written"):
        write_audit(tmp_path / "none" / AUDIT, [easy()], {})
    assert (tmp_path / AUDIT).read_bytes() == before and [one.name for one in tmp_path.iterdir()] == [AUDIT]


def foreign(path):
    raw = sqlite3.connect(path)
    raw.execute("CREATE TABLE frames (frame INTEGER)")
    raw.close()


def newer(path):
    write_audit(path, [easy()], {})
    raw = sqlite3.connect(path)
    raw.execute("PRAGMA user_version = 2")
    raw.close()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "holds no audit trail"),
        (lambda path: path.write_bytes(b""), "not an audit trail"),
        (lambda path: path.write_text("frame,sighting\n" * 100), "not an audit trail"),
        (foreign, "is not an audit trail of kalmap"),
        (newer, "written in format 2 by a newer kalmap"),
    ],
    ids=["missing", "empty", "text", "foreign", "newer"],
)
def test_what_is_no_audit_trail_is_refused(tmp_path, make, words):
    make(tmp_path / AUDIT)
    with pytest.raises(LogError, match=words):
        open_audit(tmp_path)


def test_a_folder_of_results_says_where_the_trails_are(tmp_path):
    for name in ("ekf", "ckf"):
        (tmp_path / name).mkdir()
        write_audit(tmp_path / name / AUDIT, [easy()], {})
    with pytest.raises(LogError, match=r"there is one in .*ckf, .*ekf"):
        open_audit(tmp_path)
    with pytest.raises(LogError, match="no such file"):
        open_audit(tmp_path / "none")


def test_what_no_writer_writes_is_refused(tmp_path):
    """A sound sqlite file with a reason that nobody knows, or a text where a number belongs."""
    for change in ("UPDATE sightings SET reason = 99", "UPDATE sightings SET range = 'far'"):
        write_audit(tmp_path / AUDIT, [contest()], {})
        raw = sqlite3.connect(tmp_path / AUDIT, isolation_level=None)
        raw.execute(change)
        raw.close()
        with open_audit(tmp_path) as audit, pytest.raises(LogError, match="damaged: frame 812"):
            audit.frame(812)
        with open_audit(tmp_path) as audit, pytest.raises(LogError, match="damaged"):
            audit.landmark(17), audit.summary()


def ask_everything(path) -> None:
    with open_audit(path) as audit:
        audit.summary(), audit.about(), audit.reasons(), audit.frame_at(3.0), audit.final(3)
        for number in range(30):
            audit.frame(number), audit.landmark(number % 10)


def test_a_damaged_file_is_a_log_error_and_nothing_else(tmp_path):
    """Cut off at any length it is refused. With some bytes turned over it is refused or answers: no other error."""
    path = tmp_path / AUDIT
    write_audit(path, drive(30), {})
    good = path.read_bytes()
    ask_everything(path)
    for length in range(1, len(good), len(good) // 20):
        path.write_bytes(good[:length])
        with pytest.raises(LogError):
            ask_everything(path)
    rng, refused = np.random.default_rng(4), 0
    for _ in range(60):
        bad = bytearray(good)
        for place in rng.integers(0, len(bad), 20):
            bad[place] ^= int(rng.integers(1, 256))
        path.write_bytes(bad)
        try:
            ask_everything(path)
        except LogError:
            refused += 1
    assert refused > 30
