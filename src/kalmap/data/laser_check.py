"""What a log of raw laser scans holds, and what of it is odd, for `kalmap check`."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.data.drive import Drive, reaching, silence_notes, steps_of, times_put_right
from kalmap.data.laser_classes import laser_class
from kalmap.data.plausibility import FASTEST, NAMED, Finding

FAR = 0.5
"""m between two scans: no jump of the odometry is shorter."""
WIDE = np.deg2rad(30.0)
"""rad between two scans, likewise."""
TIMES = 3.0
"""A jump is this many times the step that one in a hundred exceeds."""


class LaserReport(msgspec.Struct, frozen=True):
    """Scans and odometry of a drive.

    scanner: the class that it is taken for. beams: fewest and most of a scan. field_of_view_deg: deg, of the widest.
    no_returns: share of the beams. shortest, longest: m, of the true ranges; None without any. put_right: how many
    stamps were; step_back: s, the largest step back between two stamps. path: m; turned: rad, both by odometry.
    mount: m, m, rad.
    """

    scans: int
    scanner: str
    beams: tuple[int, int]
    field_of_view_deg: float
    no_returns: float
    shortest: float | None
    longest: float | None
    put_right: int
    step_back: float
    path: float
    turned: float
    mount: tuple[float, float, float]


def laser_report(drive: Drive) -> LaserReport:
    """The counts of a drive, from the rows that become events."""
    rows = drive.rows()
    stamps, times = drive.stamps[rows], times_put_right(drive)[rows]
    steps = steps_of(drive)[0][rows]
    sizes = [len(drive.ranges[row]) for row in rows.tolist()]
    returns, shortest, longest = 0, np.inf, -np.inf
    for row in rows.tolist():
        ranges = reaching(drive, row)
        ranges = ranges[np.isfinite(ranges)]
        returns += len(ranges)
        if len(ranges):
            shortest, longest = min(shortest, float(ranges.min())), max(longest, float(ranges.max()))
    widest = max((drive.bearings[row] for row in rows.tolist()), key=len, default=np.zeros(1))
    return LaserReport(
        scans=len(rows),
        scanner=laser_class(drive).name,
        beams=(min(sizes, default=0), max(sizes, default=0)),
        field_of_view_deg=float(np.rad2deg(widest[-1] - widest[0])),
        no_returns=1.0 - returns / sum(sizes) if sizes else 0.0,
        shortest=shortest if returns else None,
        longest=longest if returns else None,
        put_right=int((stamps != times).sum()),
        step_back=float(max(0.0, -np.diff(stamps).min(initial=0.0))),
        path=float(np.hypot(steps[:, 0], steps[:, 1]).sum()),
        turned=float(np.abs(steps[:, 2]).sum()),
        mount=tuple(drive.mount.tolist()),
    )


def drive_notes(drive: Drive) -> tuple[str, ...]:
    """What the reader decided, and where what it hands on is guessed or left out."""
    return (*drive.notes, *silence_notes(drive))


def laser_findings(drive: Drive) -> list[Finding]:
    """Jumps of the clock and of the odometry, and what the reader decided by itself."""
    findings = [Finding("note", "log", note, 1) for note in drive_notes(drive)]
    if drive.jumps:
        named = sorted(drive.jumps)[:NAMED]
        first = tuple(f"record {drive.records[k]}: {drive.jumps[k].problem}" for k in named)
        findings.append(Finding("problem", "scans", "the clock jumps", len(drive.jumps), first))
    rows = drive.rows()
    steps, durations = steps_of(drive)[0][rows], np.diff(times_put_right(drive)[rows], prepend=np.nan)
    ways, turns = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    # Stamps jitter, so a step is held against the usual period where its own is shorter.
    period = float(np.median(durations[1:])) if len(rows) > 1 else 0.0
    fast = ways > FASTEST * np.maximum(np.nan_to_num(durations), period)
    far, wide = _outstanding(ways, FAR) & ~fast, _outstanding(turns, WIDE) & ~fast
    for severity, what, where in (
        ("problem", f"movement faster than {FASTEST:g} m/s", fast),
        ("note", "the odometry jumps between two scans", far | wide),
    ):
        at = np.flatnonzero(where)
        first = tuple(
            f"record {drive.records[rows[k]]}: {ways[k]:.3g} m, {np.rad2deg(turns[k]):.3g} deg"
            for k in at[:NAMED]
        )
        if len(at):
            findings.append(Finding(severity, "odometry", what, len(at), first))  # type: ignore[arg-type]
    return findings


def _outstanding(sizes: np.ndarray, least: float) -> np.ndarray:
    """Which steps are far longer than the others."""
    return (
        sizes > max(least, TIMES * float(np.quantile(sizes, 0.99))) if len(sizes) else np.zeros(0, dtype=bool)
    )


def laser_lines(laser: LaserReport) -> list[str]:
    """A report as lines to read in a terminal."""
    low, high = laser.beams
    beams = f"{low}" if low == high else f"{low} to {high}"
    reach = "none" if laser.shortest is None else f"{laser.shortest:.4g} m to {laser.longest:.4g} m"
    x, y, heading = laser.mount
    lines = [
        f"  laser: {laser.scanner}, {beams} beams over {laser.field_of_view_deg:.4g} deg, ranges {reach}, "
        f"{100 * laser.no_returns:.3g} % without return",
        f"  laser on the robot: {x:.4g} m ahead, {y:.4g} m left, turned {np.rad2deg(heading):.4g} deg",
        f"  odometry: path {laser.path:.1f} m, {laser.turned:.2f} rad turned",
    ]
    if laser.put_right:
        lines.append(f"  stamps put right: {laser.put_right}, largest step back {laser.step_back:.3g} s")
    return lines
