"""The audit trail in a result folder."""

from __future__ import annotations

from types import SimpleNamespace

import msgspec

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
    for empty in (outcome([]), SimpleNamespace()):
        assert save_trail(tmp_path, empty, manifest()) == (None, None)
    assert not (tmp_path / AUDIT).exists() and not (tmp_path / "figures" / "association.png").exists()


def test_where_nothing_was_in_doubt_the_fullest_frame_is_drawn(tmp_path):
    frames = [nothing(), *drive(3)]
    frames = [msgspec.structs.replace(frame, number=k) for k, frame in enumerate(frames)]
    _, worst = save_trail(tmp_path, outcome(frames), manifest())
    assert worst is frames[1] and worst.why.reasons[0] == Reason.FOUNDED and SPURIOUS not in worst.labels
