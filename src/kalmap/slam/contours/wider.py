"""Loops farther off than the search about the drive: maps that look alike, places that bear each other out.

Where the drive does not know any more where a map lies on an earlier one, maps are compared by what does not
change when they are turned or moved (how their contours lie to each other, pair by pair), and laid over the most
alike ones, turned in every way. One such place proves nothing: halls and corridors repeat themselves. Places
of several maps in a row must agree, each moved on by the drive between, and nothing else may be nearly as well borne
out.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.slam.contours.belief import GATE, enough, is_elsewhere, squared_distance
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.graph import FrameGraph
from kalmap.slam.contours.matching import Overlay, overlay, search
from kalmap.slam.contours.witness import Witness

RECENT = 8  # maps back to which a map is not looked for: the drive knows these
WINDOW = 8  # maps in a row whose places are held against each other
ALIKE = 10  # earlier maps, the most alike, that a map is laid over
LEAST_MATCHED, LEAST_AGREEMENT = 10.0, 0.9  # m of contour, and the share that agrees, of one place
HELD = 0.2  # m, standard deviation of a place, in any direction, above which it is one of many along a wall
WITNESSED = 0.8  # share of the samples that scans see or see through, that they must see
BEST_PLACES, NEARLY = 3, 0.7  # of one pair that are kept, and how good they are, as a share of the best
MAPS, MATCHED = (
    3,
    45.0,
)  # maps that must agree, and m of contour that they must lie on, if the drive allows the place
MAPS_AGAINST, MATCHED_AGAINST = 4, 60.0  # and if it does not
RIVAL = 0.6  # as much contour, as a share of the best, that speaks for anything else leaves all of it open
ASTRAY, ASTRAY_TURN = (
    1.0,
    0.15,
)  # m and rad that two places which are one may differ by, whatever the drive says
SLACK = np.diag([0.1**2, 0.1**2, 0.02**2])  # by which a drive of some maps is worse than it says

POINTS, REACH = 200, 8.0  # of a map that are compared pair by pair, and m, how far pairs reach
NEAREST, STEP, ANGLES = 0.2, 0.25, 16  # m, closest pair; m and angles that are told apart


class Glimpse(msgspec.Struct, frozen=True, eq=False):
    """A place of one map on another that was found by their looks."""

    first: int
    second: int
    found: Overlay

    @property
    def pair(self) -> tuple[int, int]:
        """Both maps."""
        return self.first, self.second

    @property
    def pose(self) -> np.ndarray:
        """(3,) T_first_second."""
        return self.found.pose

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3)."""
        return self.found.covariance

    @property
    def matched(self) -> float:
        """Contour of the second that lies on the first's, m."""
        return self.found.matched


def signature(closed: ClosedMap) -> np.ndarray:
    """How often two points of the contours lie so far apart, with normals so turned: the same wherever the map lies.

    (bins,) float32, shares of all pairs up to `REACH` m. After the geometrical landmark relations of Himstedt et al.
    2014, with contour points and their normals in the place of landmarks.
    """
    points, normals = closed.shape.points, closed.shape.point_normals
    bins = np.zeros((int(REACH / STEP), ANGLES, ANGLES), dtype=np.float32)
    rows = np.linspace(0, len(points) - 1, min(POINTS, len(points))).astype(int)
    i, j = np.triu_indices(len(rows), 1)
    way = points[rows[j]] - points[rows[i]]
    apart = np.hypot(*way.T)
    near = (apart > NEAREST) & (apart < REACH)
    i, j, way, apart = i[near], j[near], way[near], apart[near]
    course, facing = np.arctan2(way[:, 1], way[:, 0]), np.arctan2(normals[rows, 1], normals[rows, 0])
    one, other = (
        np.floor((wrap(angle) / (2.0 * np.pi) + 0.5) * ANGLES).astype(int) % ANGLES
        for angle in (facing[i] - course, facing[j] - course - np.pi)
    )
    at = np.floor(apart / STEP).astype(int)
    np.add.at(bins, (at, np.minimum(one, other), np.maximum(one, other)), 1.0)
    return np.asarray(bins.ravel() / max(1.0, float(bins.sum())))


def most_alike(signatures: np.ndarray, number: int, among: np.ndarray) -> np.ndarray:
    """Of the maps `among`, those most like map `number`, the most alike first. signatures: (n, bins).

    By the cosine of the roots of the shares, what many maps have counting less.
    """
    rare = np.log(len(signatures) / np.maximum(1.0, (signatures > 0.0).sum(axis=0))).astype(np.float32)
    roots = np.sqrt(signatures * rare)
    roots /= np.maximum(np.float32(1e-12), np.linalg.norm(roots, axis=1))[:, None]
    return np.asarray(among[np.argsort(-(roots[among] @ roots[number]), kind="stable")])


class Wider:
    """The places of the last maps that were found by their looks, and how all maps look."""

    def __init__(self) -> None:
        self.glimpses: list[Glimpse] = []
        self._signatures: list[np.ndarray] = []

    def copy(self) -> Wider:
        """The same, to go on with apart from this."""
        other = Wider()
        other.glimpses, other._signatures = list(self.glimpses), list(self._signatures)
        return other

    def look(
        self, maps: Sequence[ClosedMap], number: int, lost: np.ndarray, witness: Witness | None = None
    ) -> None:
        """Search for map `number` on the earlier maps `lost`, on which the drive does not know its place.

        witness: the scans behind the maps, which must bear a place out; None where there are none.
        """
        self.glimpses = [each for each in self.glimpses if each.second > number - WINDOW]
        lost = lost[lost < number - RECENT]
        if not len(lost):
            return
        self._signatures += [signature(each) for each in maps[len(self._signatures) : number + 1]]
        for first in most_alike(np.array(self._signatures), number, lost)[:ALIKE].tolist():
            for found in places(maps[first], maps[number]):
                if witness is not None and witness.share(maps, first, number, found.pose) < WITNESSED:
                    continue
                self.glimpses.append(Glimpse(first, number, found))

    def agreed(self, graph: FrameGraph, scale: float) -> list[Glimpse]:
        """The places, one for each map, that bear each other out and that nothing stands against; empty if none do."""
        count = len(self.glimpses)
        if not count:
            return []
        one = np.eye(count, dtype=bool)
        for a, b in _about_one(self.glimpses, graph).tolist():
            one[a, b] = one[b, a] = _agree(self.glimpses[a], self.glimpses[b], graph, scale)
        groups = [self._group(np.flatnonzero(row)) for row in one]
        weights = np.array([sum(self.glimpses[i].matched for i in group) for group in groups])
        best = int(np.argmax(weights))
        chosen = [self.glimpses[i] for i in groups[best]]
        apart = ~one[:, groups[best]].any(axis=1)
        if (weights[apart] > RIVAL * weights[best]).any():
            return []
        allowed = all(_allowed(each, graph, scale) for each in chosen)
        needed = (MAPS, MATCHED) if allowed else (MAPS_AGAINST, MATCHED_AGAINST)
        return chosen if enough([each.matched for each in chosen], *needed) else []

    def _group(self, members: np.ndarray) -> list[int]:
        """Of each map the place that lies on most."""
        best: dict[int, int] = {}
        for i in members.tolist():
            each = self.glimpses[i]
            if each.second not in best or each.matched > self.glimpses[best[each.second]].matched:
                best[each.second] = i
        return list(best.values())


def places(first: ClosedMap, second: ClosedMap) -> list[Overlay]:
    """Where `second` may lie on `first`, turned in any way: the best places, best first."""
    a, b = first.shape, second.shape
    guess = np.array([*(a.centre - b.centre), 0.0])
    found: list[Overlay] = []
    for place in search(first, second, guess, a.radius, np.pi):
        each = overlay(first, second, place, (LEAST_MATCHED, LEAST_AGREEMENT))
        if each is None or np.linalg.eigvalsh(each.covariance[:2, :2])[1] > HELD**2:
            continue
        if all(is_elsewhere(each.pose, other.pose) for other in found):
            found.append(each)
    found.sort(key=lambda each: -each.matched * each.agreement)
    good = [
        each
        for each in found
        if each.matched * each.agreement > NEARLY * found[0].matched * found[0].agreement
    ]
    return good[:BEST_PLACES]


def _about_one(glimpses: Sequence[Glimpse], graph: FrameGraph) -> np.ndarray:
    """(P, 2) places, the later one first, that differ by no more than two that are one may differ."""
    poses = np.array([each.pose for each in glimpses])
    first, second = np.array([(each.first, each.second) for each in glimpses]).T
    ahead, behind = compose(graph.frames[first], poses), graph.frames[second]
    after = compose(inverse(behind)[None, :], behind[:, None])  # of each row's map, on from each column's
    shift = compose(
        inverse(compose(np.broadcast_to(ahead[None], after.shape), after)),
        np.broadcast_to(ahead[:, None], after.shape),
    )
    near = (np.hypot(shift[..., 0], shift[..., 1]) < ASTRAY) & (np.abs(shift[..., 2]) < ASTRAY_TURN)
    near &= (first[:, None] != first) | (second[:, None] != second)
    return np.argwhere(np.tril(near, -1))


def _agree(one: Glimpse, other: Glimpse, graph: FrameGraph, scale: float) -> bool:
    """Whether two places are one: the second's map where the first one has it, moved on by the drive between."""
    before, before_covariance = graph.between(one.first, other.first)
    after, after_covariance = graph.between(other.second, one.second)
    shift = compose(inverse(compose(compose(before, other.pose), after)), one.pose)
    there = np.zeros(3)
    spread = (
        SLACK + _carried(one.pose, there, scale * one.covariance) + _carried(after, there, after_covariance)
    )
    spread += _carried(other.pose, after, scale * other.covariance)
    spread += _carried(before, compose(other.pose, after), before_covariance)
    return float(shift @ np.linalg.solve(spread, shift)) < GATE


def _carried(pose: np.ndarray, further: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(3, 3) covariance of `pose`, by its numbers, as an error of the pose `further` on, in that pose's axes."""
    design = np.eye(3)
    design[:2, :2] = _turn(-further[2] - pose[2])
    design[:2, 2] = _turn(-further[2]) @ (-further[1], further[0])
    return np.asarray(design @ covariance @ design.T)


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _allowed(each: Glimpse, graph: FrameGraph, scale: float) -> bool:
    """Whether the drive allows the place."""
    guess, covariance = graph.between(each.first, each.second)
    return squared_distance(each.pose, guess, covariance + scale * each.covariance) < GATE
