"""Beams that see the robot's own cover: what they measure is near and stays while the odometry moves.

A beam is covered if in the scans of the drive, a step apart, it brings back a range in at least half of them, and of
those 98 in a hundred lie within 3 cm of their median, which is less than 1 m. That says something once the robot has
gone 5 m in 30 scans, and unless most of the farther beams stay as well: then it is the robot that stands still, on
spinning wheels. It is plain, and the beams are masked, if the heading has taken values 90 degrees apart: no
wall beside a robot turns with it. On a straight way a wall may be followed that exactly, so it is only told.
"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.data.drive import Drive, Fan, fan_of, reaching, steps_of
from kalmap.data.plausibility import NAMED

NEAR = 1.0
"""m, beyond which nothing of a robot is looked for."""
BAND = 0.03
"""m, about the median: three times the noise of the scanners at such ranges."""
STAYS, RETURNS = 0.98, 0.5
"""Shares of the ranges in the band, and of the scans with a range."""
STEP, STEP_ANGLE = 0.1, np.deg2rad(5.0)
"""m, rad from one scan looked at to the next."""
WAY, SCANS = 5.0, 30
HEADINGS = np.deg2rad(90.0)
STUCK = 0.5
"""Share of the farther beams that stay, above which the robot does not move."""
MOST_SCANS = 2000


class Covered(msgspec.Struct, frozen=True):
    """Covered beams (B,) of all scans with the bearings (B,) rad. ranges: m, least and greatest of their medians."""

    bearings: np.ndarray
    beams: np.ndarray
    ranges: tuple[float, float]
    plain: bool

    def text(self) -> str:
        """Which beams, where they point, and what became of them."""
        angles = np.rad2deg(self.bearings)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.beams.astype(int), [0]]))).reshape(-1, 2)
        runs = [f"{angles[a]:.4g} to {angles[b - 1]:.4g}" for a, b in edges[:NAMED].tolist()]
        directions = ", ".join(runs) + ", ..." * (len(edges) > NAMED)
        low, high = self.ranges
        seen = (
            f"{self.beams.sum()} of {len(angles)} beams (at {directions} deg) stay at {low:.2f} to {high:.2f} m "
            "while the robot moves"
        )
        if self.plain:
            return f"{seen}: they see its own cover, and are left out"
        return f"{seen}: its own cover, or a wall beside its straight way; they are used"


def without_cover(drive: Drive) -> Drive:
    """The drive without its covered beams, where that is plain, and with a note on them."""
    found = covered_beams(drive)
    masks = {fan_of(each.bearings): each.beams for each in found if each.plain}
    notes = (f"{drive.file}: {each.text()}" for each in found)
    return msgspec.structs.replace(drive, covered=masks, notes=(*drive.notes, *notes))


def covered_beams(drive: Drive) -> tuple[Covered, ...]:
    """What is covered, for each set of bearings that the scans come with."""
    rows = drive.rows()
    steps = steps_of(drive)[0][rows]
    ways, turns = np.cumsum(np.hypot(steps[:, 0], steps[:, 1])), np.cumsum(steps[:, 2])
    fans: dict[Fan, list[int]] = {}
    for k, row in enumerate(rows.tolist()):
        if len(drive.bearings[row]):
            fans.setdefault(fan_of(drive.bearings[row]), []).append(k)
    found = (_covered(drive, rows, np.array(of_fan), ways, turns) for of_fan in fans.values())
    return tuple(each for each in found if each is not None)


def _covered(
    drive: Drive, rows: np.ndarray, of_fan: np.ndarray, ways: np.ndarray, turns: np.ndarray
) -> Covered | None:
    """What is covered in the scans `of_fan`, places in `rows`. ways, turns: (n,) m, rad, added up over the drive."""
    apart = _apart(ways[of_fan], turns[of_fan])
    kept = of_fan[apart]
    if len(kept) < SCANS or ways[kept[-1]] - ways[kept[0]] < WAY:
        return None
    kept = kept[:: 1 + len(kept) // MOST_SCANS]
    ranges = np.array([reaching(drive, row) for row in rows[kept].tolist()])
    ranges[~np.isfinite(ranges)] = np.nan
    often = np.isfinite(ranges).mean(axis=0) >= RETURNS
    middle = np.full(ranges.shape[1], np.inf)
    middle[often] = np.nanmedian(ranges[:, often], axis=0)
    stays = np.zeros(len(middle), dtype=bool)
    close = np.abs(ranges[:, often] - middle[often]) <= BAND
    stays[often] = close.sum(axis=0) >= STAYS * np.isfinite(ranges[:, often]).sum(axis=0)
    beams, farther = stays & (middle < NEAR), often & (middle >= NEAR)
    if not beams.any() or (farther.any() and stays[farther].mean() > STUCK):
        return None
    plain = float(np.ptp(turns[kept])) >= HEADINGS
    between = float(middle[beams].min()), float(middle[beams].max())
    return Covered(drive.bearings[rows[of_fan[0]]], beams, between, plain)


def _apart(ways: np.ndarray, turns: np.ndarray) -> list[int]:
    """Which scans are a step from the one before that was taken."""
    kept = [0]
    for k in range(1, len(ways)):
        if ways[k] - ways[kept[-1]] >= STEP or abs(turns[k] - turns[kept[-1]]) >= STEP_ANGLE:
            kept.append(k)
    return kept
