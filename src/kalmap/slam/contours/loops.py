"""Loops: where a closed map may lie on earlier ones, which of these places is believed, and what is taken back."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import rotate
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.graph import FrameGraph, Relation
from kalmap.slam.contours.matching import Overlay, overlay, search

GATE = 16.3  # squared distance of three numbers that chance exceeds once in a thousand
LEAST_MATCHED = 8.0  # m of contour that must lie on each other
LEAST_AGREEMENT = 0.75
AMBIGUOUS = 0.8  # a second place this good, as a share of the best, leaves the loop open
WIDEST, FARTHEST_TURN = 8.0, 0.7  # m and rad, the largest search
SURE, SURE_TURN = 0.5, 0.1  # m and rad: where the place is known better than this, there is nothing to search
FLOOR = np.diag([0.01**2, 0.01**2, 0.002**2])  # of a relation's covariance: maps bend


class Loops:
    """The frames of all closed maps, with every loop that is believed at the moment.

    open: pairs of maps that seemed to lie on each other but were not believed, with what was found: tried again in the
    end. searched: how many pairs were looked at.
    """

    def __init__(self) -> None:
        self.maps: list[ClosedMap] = []
        self.graph = FrameGraph()
        self.open: dict[tuple[int, int], str] = {}
        self.searched = 0

    def close(self, closed: ClosedMap) -> None:
        """Take a map that has been closed, and look for its loops."""
        if self.maps:
            last = self.maps[-1]
            self.graph.append(last.end, last.end_covariance + FLOOR)
        self.maps.append(closed)
        self._seek(len(self.maps) - 1)

    def _seek(self, number: int) -> None:
        """Look for the map among all earlier ones, the surest places first."""
        waiting = list(range(number))
        while waiting:
            at = [self._looseness(i, number) for i in waiting]
            best = int(np.argmin(at))
            if not np.isfinite(at[best]):
                break
            first = waiting.pop(best)
            found = self._lay(first, number)
            if found is not None:
                self.graph.add(found)
                self.graph.solve()

    def _looseness(self, first: int, second: int) -> float:
        """How unsure the place of one map on the other is, in m; infinite where they cannot touch."""
        pose, covariance = self.graph.between(first, second)
        a, b = self.maps[first].shape, self.maps[second].shape
        spread = 3.0 * float(np.sqrt(max(covariance[0, 0], covariance[1, 1])))
        centre = pose[:2] + rotate(pose[2], b.centre)
        if np.hypot(*(centre - a.centre)) > a.radius + b.radius + min(spread, WIDEST) - 2.0:
            return np.inf
        return spread

    def _lay(self, first: int, second: int) -> Relation | None:
        """The relation of two maps, if they lie on each other in one place and in no other."""
        self.searched += 1
        guess, covariance = self.graph.between(first, second)
        a, b = self.maps[first], self.maps[second]
        half = min(WIDEST, 3.0 * float(np.sqrt(max(covariance[0, 0], covariance[1, 1]))) + 0.3)
        turn = min(FARTHEST_TURN, 3.0 * float(np.sqrt(covariance[2, 2])) + 0.05)
        places = [guess]
        if half > SURE or turn > SURE_TURN:
            places += search(a, b, guess, half, turn)
        overlays = [each for place in places if (each := overlay(a, b, place)) is not None]
        overlays.sort(key=lambda each: -each.matched * each.agreement)
        problem = self._problem(overlays, guess, covariance)
        if problem is not None:
            if overlays and overlays[0].matched >= LEAST_MATCHED:
                self.open[first, second] = problem
            return None
        self.open.pop((first, second), None)
        best = overlays[0]
        return Relation(first, second, best.pose, np.linalg.inv(best.covariance + FLOOR), loop=True)

    @staticmethod
    def _problem(overlays: list[Overlay], guess: np.ndarray, covariance: np.ndarray) -> str | None:
        """Why the best of the places is not believed; None if it is."""
        if not overlays or overlays[0].matched < LEAST_MATCHED:
            return "too little lies on each other"
        best = overlays[0]
        if best.agreement < LEAST_AGREEMENT:
            return f"only {best.agreement:.0%} of what lies side by side agrees"
        shift = best.pose - guess
        shift[2] = wrap(shift[2])
        squared = float(shift @ np.linalg.solve(covariance + best.covariance + FLOOR, shift))
        if squared > GATE:
            return f"the place contradicts the drive: squared distance {squared:.0f}"
        for other in overlays[1:]:
            apart = other.pose - best.pose
            elsewhere = np.hypot(apart[0], apart[1]) > 0.3 or abs(wrap(apart[2])) > 0.1
            if elsewhere and other.matched * other.agreement > AMBIGUOUS * best.matched * best.agreement:
                return "another place is nearly as good"
        return None
