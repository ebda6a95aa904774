"""The audit trail of a run, written into its result folder."""

from __future__ import annotations

import shlex
from pathlib import Path

from kalmap.data.audit import AUDIT, write_audit
from kalmap.data.audit_read import open_audit
from kalmap.records import Frame, Manifest
from kalmap.slam import Outcome
from kalmap.view import Trail

FIGURE = "association"


def save_trail(folder: Path, outcome: Outcome, manifest: Manifest) -> tuple[Trail | None, Frame | None]:
    """Write the trail of a run that kept one; else see that none of an earlier run is left in the folder.

    Returns what the report says of it, and the frame to draw: the one with the most trouble, or where nothing was in
    doubt the one with the most sightings. Both None without a trail.
    """
    frames = outcome.decisions
    (folder / "figures" / f"{FIGURE}.png").unlink(missing_ok=True)
    if not frames:
        (folder / AUDIT).unlink(missing_ok=True)
        return None, None
    about = {"kalmap": manifest.kalmap, "log": manifest.log, "command": manifest.command}
    write_audit(folder / AUDIT, frames, {**about, "started": manifest.started})
    with open_audit(folder) as audit:
        summary = audit.summary()
    if summary.worst:  # the one that the report and `kalmap why` name first
        number = summary.worst[0][0]
        worst = next(frame for frame in frames if frame.number == number)
    else:
        worst = max(frames, key=lambda frame: len(frame.values))
    return Trail(summary, AUDIT, f"kalmap why {shlex.quote(str(folder))}"), worst
