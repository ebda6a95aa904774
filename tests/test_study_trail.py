"""The audit trail in a result folder."""

from __future__ import annotations

from types import SimpleNamespace

import msgspec
import numpy as np

from kalmap.data import open_audit, write_audit
from kalmap.data.audit import AUDIT
from kalmap.records import SPURIOUS, Reason
from kalmap.study.trail import save_trail
from test_view_samples import manifest
from trails import cluster, contest, drive, easy, nothing


def outcome(frames):
    """As much of a run's outcome as the trail is made of."""
    return SimpleNamespace(decisions=frames)


def test_the_trail_is_written_with_where_it_comes_from(tmp_path):
    folder = tmp_path / "a result"
    folder.mkdir()
    frames = [easy(), contest(), msgspec.structs.replace(cluster(), number=900)]
    trail, worst = save_trail(folder, outcome(frames), manifest(log="park"))
    assert worst is frames[2] and trail is not None
    assert (trail.file, trail.command) == (AUDIT, f"kalmap why '{folder}'")
    with open_audit(folder) as audit:
        assert audit.frames() == 3 and audit.summary() == trail.summary
        assert audit.about()["log"] == "park" and audit.about()["command"] == "kalmap run course-35"


def test_without_decisions_no_stale_file_is_left(tmp_path):
    write_audit(tmp_path / AUDIT, [easy()], {})
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "association.png").write_bytes(b"old")
    assert save_trail(tmp_path, outcome([]), manifest()) == (None, None)
    assert not (tmp_path / AUDIT).exists() and not (tmp_path / "figures" / "association.png").exists()


def test_of_frames_alike_in_trouble_the_one_that_the_summary_names_is_drawn(tmp_path):
    """Oracle: the summary, which takes the earlier; the later frame has a sighting more."""
    few = contest()
    more = msgspec.structs.replace(
        few,
        number=few.number + 1,
        values=np.vstack([few.values, [9.0, 0.0]]),
        labels=np.r_[few.labels, SPURIOUS],
        trial=np.r_[few.trial, False],
        noises=None,
        why=msgspec.structs.replace(few.why, reasons=np.r_[few.why.reasons, Reason.NEAREST]),
    )
    trail, worst = save_trail(tmp_path, outcome([few, more]), manifest())
    first, second = trail.summary.worst
    assert first[2] == second[2] and worst is few and worst.number == first[0]


def test_where_nothing_was_in_doubt_the_fullest_frame_is_drawn(tmp_path):
    frames = [nothing(), *drive(3)]
    frames = [msgspec.structs.replace(frame, number=k) for k, frame in enumerate(frames)]
    _, worst = save_trail(tmp_path, outcome(frames), manifest())
    assert worst is frames[1] and worst.why.reasons[0] == Reason.FOUNDED and SPURIOUS not in worst.labels
