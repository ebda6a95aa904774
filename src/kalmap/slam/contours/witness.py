"""What the scans behind two maps say of a place of one on the other: that they see its walls, or through them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels import contour as kernel
from kalmap.slam.contours.belief import LEAST_THINGS, POINTS, Verdict, judged
from kalmap.slam.contours.closed import ENOUGH, ClosedMap
from kalmap.slam.contours.leg import Leg
from kalmap.slam.contours.seen import Rules, Seen, prepare
from kalmap.slam.contours.sketch import Sketch, drawn, laid

SCANS = 8  # of a map, spread over its leg, that are asked
LIMIT = 0.15  # m, how far a sample may lie from what the scan shows
KEPT = 64  # maps whose scans stay cut, or drawn
FARTHEST = 2.0, 0.4  # m and rad about where the drive has a map, that are searched by points
ASKED = 40  # samples, least that must be answered for


class Witness:
    """The scans of closed maps, asked what they see of other maps' contours.

    Contours that lie on each other say little where rooms are alike: the wall of one map may stand where the other
    map's scanner looked through. legs: of all maps, which may grow. What is learnt of the scanner on the way is left
    out: it is little beside `LIMIT`, and so the answer is the same whenever it is asked. Where maps hold hardly any
    contour, the scans' single points find such places, too (`sketch`).
    """

    def __init__(self, legs: Sequence[Leg], rules: Rules) -> None:
        self._legs, self._rules = legs, rules
        self._views: dict[int, list[tuple[np.ndarray, Seen]]] = {}
        self._sketches: dict[int, Sketch | None] = {}

    def share(self, maps: Sequence[ClosedMap], first: int, second: int, pose: np.ndarray) -> float:
        """Of the samples that the scans of either map see or see through, with T_first_second `pose`, those seen.

        The lesser of both ways round; 0 where there is too little to tell.
        """
        one = self._seen(maps[first], second, pose)
        other = self._seen(maps[second], first, inverse(pose))
        return min(one, other)

    def by_points(
        self,
        first: int,
        second: int,
        drive: tuple[np.ndarray, np.ndarray, float],
        reach: tuple[float, float],
        end: np.ndarray | None,
    ) -> Verdict | None:
        """The verdict on the second map's place on the first by what scans saw point by point, see `sketch.laid`.

        drive: where the drive has the map (3,), the covariance (3, 3) of that, and the scale of the maps' own. reach: m
        and rad, how far around that is searched; beyond `FARTHEST` points are too much alike, and nothing is said, nor
        where too little agrees or another place is nearly as good.
        """
        if reach[0] > FARTHEST[0] or reach[1] > FARTHEST[1]:
            return None
        a, b = self._sketch(first), self._sketch(second)
        if a is None or b is None:
            return None
        places = laid((a, self._legs[first]), (b, self._legs[second]), drive[0], *reach, end)
        if not places or places[0].things < LEAST_THINGS:
            return None
        verdict = judged([each.overlay for each in places], *drive, bar=POINTS, about=b.middle)
        return verdict if verdict is None or verdict.why is None or verdict.is_doubted else None

    def adopt(self, other: Witness) -> None:
        """Take over what another one has drawn of the same legs, which are the first of these."""
        self._sketches.update(other._sketches)

    def _sketch(self, number: int) -> Sketch | None:
        if number not in self._sketches:
            if len(self._sketches) == KEPT:
                del self._sketches[next(iter(self._sketches))]
            self._sketches[number] = drawn(self._legs[number], self._rules)
        return self._sketches[number]

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
