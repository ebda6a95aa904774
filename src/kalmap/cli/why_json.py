"""An audit trail as JSON can hold it: the same answers as in words, with all there is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from kalmap.cli.why_text import candidates_of
from kalmap.records import Frame, Reason
from kalmap.records.trail import TrailSummary, doubts

if TYPE_CHECKING:
    from kalmap.data.audit_story import Story


def frame_json(frame: Frame, reasons: Mapping[int, str]) -> dict[str, Any]:
    """A frame with one entry a sighting, its candidates inside."""
    why, kinds = frame.why, doubts(frame)
    sightings = [
        {
            "sighting": m,
            "range": frame.values[m, 0],
            "bearing": frame.values[m, 1],
            "landmark": frame.labels[m] if frame.labels[m] >= 0 else None,
            "on_trial": bool(frame.trial[m]),
            "reason": Reason(why.reasons[m]).name,
            "why": reasons.get(int(why.reasons[m]), ""),
            "doubt": kinds[m] or None,
            "candidates": [
                {"landmark": landmark, "squared": squared, "log_volume": volume}
                for landmark, squared, volume in candidates_of(frame, m)
            ],
        }
        for m in range(len(frame.values))
    ]
    expected = zip(frame.landmarks.tolist(), frame.positions, frame.spreads)
    return {
        "frame": frame.number,
        "time": frame.time,
        "pose": frame.pose,
        "sensor": frame.sensor,
        "gate": why.gate,
        "new_gate": why.new_gate,
        "notes": why.notes,
        "sightings": sightings,
        "expected": [{"landmark": n, "position": place, "spread": spread} for n, place, spread in expected],
        "managed": why.managed,
    }


def landmark_json(story: Story, reasons: Mapping[int, str]) -> dict[str, Any]:
    """A landmark's story, with every reason as name and sentence."""

    def told(one: Any) -> dict[str, Any]:
        return _fields(one) | {"reason": one.reason.name, "why": reasons.get(one.reason, "")}

    sightings, passed = [told(one) for one in story.sightings], [told(one) for one in story.passed]
    return _fields(story) | {"sightings": sightings, "passed": passed}


def summary_json(summary: TrailSummary, about: Mapping[str, str]) -> dict[str, Any]:
    """The counts, reasons by their names, after what the trail says about itself."""
    worst = [{"frame": number, "time": time, "trouble": found} for number, time, found in summary.worst]
    reasons = {Reason(reason).name: count for reason, count in summary.reasons.items()}
    return {"about": about} | _fields(summary) | {"reasons": reasons, "worst": worst}


def _fields(record: Any) -> dict[str, Any]:
    return {name: getattr(record, name) for name in record.__struct_fields__}
