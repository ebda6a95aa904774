"""What the scans behind two maps say of a place of one on the other: that they see its walls, or through them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels import contour as kernel
from kalmap.slam.contours.closed import ENOUGH, ClosedMap
from kalmap.slam.contours.leg import Leg
from kalmap.slam.contours.seen import Rules, Seen, prepare

SCANS = 8  # of a map, spread over its leg, that are asked
LIMIT = 0.15  # m, how far a sample may lie from what the scan shows
KEPT = 64  # maps whose scans stay cut
ASKED = 40  # samples, least that must be answered for


class Witness:
    """The scans of closed maps, asked what they see of other maps' contours.

    Contours that lie on each other say little where rooms are alike: the wall of one map may stand where the other
    map's scanner looked through. legs: of all maps, which may grow. What is learnt of the scanner on the way is left
    out: it is little beside `LIMIT`, and so the answer is the same whenever it is asked.
    """

    def __init__(self, legs: Sequence[Leg], rules: Rules) -> None:
        self._legs, self._rules = legs, rules
        self._views: dict[int, list[tuple[np.ndarray, Seen]]] = {}

    def share(self, maps: Sequence[ClosedMap], first: int, second: int, pose: np.ndarray) -> float:
        """Of the samples that the scans of either map see or see through, with T_first_second `pose`, those seen.

        The lesser of both ways round; 0 where there is too little to tell.
        """
        one = self._seen(maps[first], second, pose)
        other = self._seen(maps[second], first, inverse(pose))
        return min(one, other)

    def _seen(self, closed: ClosedMap, by: int, pose: np.ndarray) -> float:
        rows = np.flatnonzero(closed.sightings >= ENOUGH)
        samples, normals = (
            np.ascontiguousarray(closed.samples[rows]),
            np.ascontiguousarray(closed.normals[rows]),
        )
        found, seen, through = np.empty(len(rows), dtype=np.int64), 0, 0
        # silence counts at any range here: it is judged by shares, not sample by sample
        reach = np.full(2, self._rules.sensor.max_range)
        for place, view in self._of(by):
            pieces = view.pieces
            kernel.look(
                compose(pose, place), samples, normals, self._rules.mount, view.bearings, view.ranges,
                view.piece_of_beam, pieces.coef, pieces.origin, pieces.scale, reach, LIMIT,
                found, np.empty(len(rows)), np.empty((len(rows), 2)),
            )  # fmt: skip
            seen += int((found >= 0).sum())
            through += int((found == kernel.OPEN).sum())
        return seen / (seen + through) if seen + through >= ASKED else 0.0

    def _of(self, number: int) -> list[tuple[np.ndarray, Seen]]:
        """Scans of a map with their places in it, by how far the vehicle had come."""
        if number not in self._views:
            if len(self._views) == KEPT:
                del self._views[next(iter(self._views))]
            leg = self._legs[number]
            way = np.cumsum(np.hypot(*np.diff(leg.poses[:, :2], axis=0, prepend=leg.poses[:1, :2]).T))
            rows = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], SCANS)).clip(0, len(way) - 1))
            self._views[number] = [
                (
                    leg.poses[row],
                    prepare(leg.scans[row], self._rules, self._rules.calibration.mean, leg.twists[row]),
                )
                for row in rows.tolist()
            ]
        return self._views[number]
