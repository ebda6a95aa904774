"""Loops: where a closed map may lie on earlier ones, which of these places is believed, and what is taken back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, rotate
from kalmap.slam.contours.belief import (
    FLOOR,
    GATE,
    SURE,
    SURE_TURN,
    Verdict,
    contradicted,
    contradicts_drive,
    enough,
    judged,
    may_be_tried,
    squared_off,
)
from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.graph import FrameGraph, Relation, beside_the_end
from kalmap.slam.contours.matching import Overlay, overlay, search
from kalmap.slam.contours.wider import RECENT, Glimpse, Wider
from kalmap.slam.contours.witness import Witness

VOTES = 2  # maps that must say the same against the drive
VOTED_MATCHED = 20.0  # m of contour that they must say it of
MOST_TRIED = 10  # of the places that are doubted
WIDEST, FARTHEST_TURN = 8.0, 0.7  # m and rad, the largest search
FARTHEST_MISFIT = 30.0  # as much as one pair of maps counts in the errors' scale
PRIOR_SCALE, PRIOR_COUNT = 2.0, 3  # of the errors' scale, before maps have been seen
SPARSE = 20.0  # m of contour: where one map of a pair has less, single points of the scans are asked, too
BENT = 1.5  # how much wider errors are than shows where maps follow each other, in variance: both bend alike there


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
        self.wider = Wider()
        self.witness: Witness | None = None
        self._misfits: list[float] = []
        self.graph.rescale(self.scale)

    def copy(self) -> Loops:
        """The same maps, with a graph of their own."""
        other = Loops()
        other.maps, other.graph, other.open = list(self.maps), self.graph.copy(), dict(self.open)
        other.searched, other._misfits = self.searched, list(self._misfits)
        other.wider, other.witness = self.wider.copy(), self.witness
        return other

    def close(self, closed: ClosedMap, witness: Witness | None = None) -> None:
        """Take a map that has been closed, and look for its loops."""
        self.append(closed)
        self.seek(witness)

    def append(self, closed: ClosedMap) -> None:
        """Take a map that has been closed: it begins where the last one ends."""
        if self.maps:
            last = self.maps[-1]
            self.graph.append(last.end, last.end_covariance + FLOOR)
        self.maps.append(closed)

    def seek(self, witness: Witness | None = None) -> None:
        """Look for the newest map among all others. witness: the scans behind all maps, if there are any."""
        self.witness = witness
        number = len(self.maps) - 1
        self._seek(number, set())
        self.wider.look(self.maps, number, self._lost(number), witness)
        agreed = self.wider.agreed(self.graph, self.scale)
        if agreed and self._all_hold(agreed, lambda: not contradicted(self._laid_again(agreed)), astray=True):
            self.wider.glimpses.clear()
            for each in agreed:
                self._seek(each.second, self._related(each.second))

    def give_up(self, graph: FrameGraph, problem: str) -> None:
        """Go back to a graph from before the newest map was looked for, which could not be done."""
        self.graph = graph
        self.graph.rescale(self.scale)
        self.open[len(self.maps) - 1, len(self.maps) - 1] = f"its place could not be judged: {problem}"

    @property
    def scale(self) -> float:
        """How much wider errors are than the maps' covariances say, in variance, as seen where maps follow each other.

        The place of a map by the end of the one before, against the place by what both show, by their joint covariance.
        """
        shown = sum(self._misfits) / 3.0
        return max(1.0, (PRIOR_SCALE * PRIOR_COUNT + shown) / (PRIOR_COUNT + len(self._misfits)))

    @property
    def told_scale(self) -> float:
        """The same for covariances that are handed out; gates are held narrower, as a false loop costs more than none.

        How a map bends on the whole shows in no overlay of its neighbours. Of 23 simulated drives between straight
        walls the poses have a NEES of 1.6 in the median where 3 is right, and of 7 at worst.
        """
        return BENT * self.scale

    def own_covariances(self) -> np.ndarray:
        """(n, 3, 3) of every frame of the graph, as they are handed out."""
        return BENT * self.graph.own_covariances()

    def finish(self, witness: Witness | None = None) -> None:
        """Ask once more for what was left open, and lay all maps on each other where they are thought to be now.

        witness: as in `seek`, whose one is asked by default.
        """
        self.witness = witness or self.witness
        self._reconsider(everything=True)
        self._relay()
        self.graph.solve(30)
        self._withdraw()

    def _withdraw(self) -> None:
        """Leave open again what does not hold any more, now that all has been said."""
        if not self.graph.relations:
            return
        far = self.graph.distances() > 2.0 * GATE
        held = [
            each for each, gone in zip(self.graph.relations, far, strict=True) if not (each.loop and gone)
        ]
        if len(held) == len(self.graph.relations):
            return
        for each, gone in zip(self.graph.relations, far, strict=True):
            if each.loop and gone:
                self.open[each.first, each.second] = "it was believed, and did not hold"
        self.graph.replace(held)
        self.graph.solve(30)

    def _relay(self) -> None:
        """Every pair that touches, laid on each other anew from where it is now thought to be."""
        known = {
            (relation.first, relation.second): relation for relation in self.graph.relations if relation.loop
        }
        relations = [relation for relation in self.graph.relations if not relation.loop]
        for second in range(len(self.maps)):
            for first in self._loose(second):
                if (first, second) in self.open:
                    continue
                guess, covariance = self.graph.between(first, second)
                found = overlay(self.maps[first], self.maps[second], guess)
                verdict = judged([found] if found is not None else [], guess, covariance, self.scale)
                if verdict is None:
                    continue
                if verdict.why is None or (verdict.is_doubted and (first, second) in known):
                    known[first, second] = self._loop(Glimpse(first, second, verdict.found))
        self.graph.replace([*relations, *(known[pair] for pair in sorted(known))])

    def _lost(self, number: int) -> np.ndarray:
        """The earlier maps on which the drive does not know the place of a map within what is searched about it."""
        earlier = list(range(max(0, number - RECENT)))
        return np.flatnonzero(_are_lost(self.graph.from_each(earlier, number)[1]))

    def _related(self, number: int) -> set[int]:
        """The earlier maps that a map is tied to, and the one before it."""
        return {each.first for each in self.graph.relations if each.second == number} | {number - 1}

    def _all_hold(
        self, places: Sequence[Glimpse], borne_out: Callable[[], bool] = lambda: True, *, astray: bool = False
    ) -> bool:
        """Believe places against the drive, all or none: they, and what held before, must hold then, and be borne out.

        borne_out: asked once the frames have moved. astray: whether these have so far to go that the places are
        taken together, and none is weighed down at first.
        """
        before, kept, held = self.graph.copy(), dict(self.open), self._held()
        for each in places:
            self._take(each)
            if not astray:
                self.graph.solve()
        if astray:
            self.graph.solve(30, robust=False)
            self.graph.solve(30)
        if held | {each.pair for each in places} <= self._held() and borne_out():
            return True
        self.graph, self.open = before, kept
        return False

    def _laid_again(self, agreed: list[Glimpse]) -> Iterator[Overlay]:
        """The maps in a row that places were found for, laid on all earlier ones that they touch where they are now."""
        for second in range(min(each.second for each in agreed), max(each.second for each in agreed) + 1):
            for first in self._near(second):
                if first > second - RECENT:
                    continue
                found = overlay(self.maps[first], self.maps[second], self.graph.between(first, second)[0])
                if found is not None:
                    yield found

    def _seek(self, number: int, looked: set[int]) -> None:
        """Look for the map among all earlier ones but those that were looked at, the surest places first; then ask
        those that were not believed."""
        doubted: list[Glimpse] = []
        waiting = self._loose(number, looked)
        while waiting:
            first = min(waiting, key=waiting.__getitem__)
            looked.add(first)
            del waiting[first]
            verdict = self._lay(first, number)
            if verdict is None:
                continue
            if (
                number == first + 1 and verdict.found.freedom
            ):  # not of points: these say little of how maps bend
                self._misfits.append(min(_misfit(verdict.found, self.maps[first]), FARTHEST_MISFIT))
                self.graph.rescale(self.scale)
            doubted += self._settled(first, number, verdict)
            if number == first + 1 or verdict.why is None:  # the graph says something else now
                waiting = self._loose(number, looked)
        self._vote(doubted)
        if any(contradicts_drive(self.open.get(each.pair, "")) for each in doubted):
            self._reconsider()

    def _settled(self, first: int, second: int, verdict: Verdict) -> list[Glimpse]:
        """Believe a place, or leave it open. Returns it if only the drive stands against it, else nothing."""
        place = Glimpse(first, second, verdict.found)
        if verdict.why is None:
            self._take(place)
            self.graph.solve()
        else:
            self.open[place.pair] = verdict.why
        return [place] if verdict.is_doubted else []

    def _take(self, place: Glimpse) -> None:
        """Tell the graph of a place."""
        self.open.pop(place.pair, None)
        self.graph.add(self._loop(place))

    def _loop(self, place: Glimpse) -> Relation:
        """What the graph is told of one map laid on another: of the next one, what its end does not say already."""
        first, second, covariance = place.first, place.second, place.covariance + FLOOR
        if second == first + 1:
            end = self.maps[first].end_covariance + FLOOR
            information = beside_the_end(end, covariance, place.found.with_end)
        else:
            information = np.linalg.inv(covariance)
        return Relation(first, second, place.pose, information, loop=True)

    def _vote(self, doubted: list[Glimpse]) -> None:
        """Believe places of one map that contradict the drive but not each other: then it is the drive that is wrong.

        Several earlier maps must say the same, over enough contour, and what was believed before must still hold.
        """
        doubted = [each for each in doubted if may_be_tried(each.found, self._off(each))]
        if len(doubted) < VOTES:
            return
        places = np.array([compose(self.graph.frames[each.first], each.pose) for each in doubted])
        apart = places[:, None] - places[None]
        same = (np.hypot(apart[..., 0], apart[..., 1]) < 0.3) & (np.abs(wrap(apart[..., 2])) < 0.06)
        group = [doubted[i] for i in np.flatnonzero(same[int(np.argmax(same.sum(axis=1)))])]
        if enough([each.matched for each in group], VOTES, VOTED_MATCHED):
            self._all_hold(group)

    def _reconsider(self, everything: bool = False) -> None:
        """Ask once more for what was left open, everything or what contradicts the drive.

        A place that contradicts the drive is tried: it is believed if, once the frames have moved, it holds, others
        that were doubted hold with it, and none that was believed gives way. Else all is as it was before.
        """
        while True:
            doubted: list[Glimpse] = []
            for pair in sorted(self.open):
                if pair[0] == pair[1] or not (everything or contradicts_drive(self.open[pair])):
                    continue
                verdict = self._lay(*pair)
                if verdict is not None:
                    doubted += self._settled(*pair, verdict)
            nearest = sorted(doubted, key=self._off)
            if not any(self._tried(each, doubted) for each in nearest[:MOST_TRIED]):
                return

    def _off(self, place: Glimpse) -> float:
        """Squared distance of a place that was found from where the frames have it now."""
        return squared_off(place.found, *self.graph.between(*place.pair), self.scale)

    def _tried(self, place: Glimpse, doubted: list[Glimpse]) -> bool:
        """Believe a doubted place if others bear it out; see `_reconsider`."""

        def borne_out() -> bool:
            others = [each.matched for each in doubted if each is not place and self._off(each) < GATE]
            return enough(others, VOTES - 1, VOTED_MATCHED)

        return may_be_tried(place.found, self._off(place)) and self._all_hold([place], borne_out)

    def _held(self) -> set[tuple[int, int]]:
        """The loops that agree with where the frames are."""
        if not self.graph.relations:
            return set()
        near = self.graph.distances() < GATE
        return {
            (each.first, each.second)
            for each, holds in zip(self.graph.relations, near)
            if each.loop and holds
        }

    def _near(self, second: int) -> list[int]:
        """The earlier maps that a map might touch, wherever in the largest search it lies."""
        shapes = [each.shape for each in self.maps[: second + 1]]
        frames = self.graph.frames[: second + 1]
        centres = frames[:, :2] + rotate(frames[:, 2], np.array([shape.centre for shape in shapes]))
        radii = np.array([shape.radius for shape in shapes])
        apart = np.hypot(*(centres[:second] - centres[second]).T)
        return np.flatnonzero(apart <= radii[:second] + radii[second] + WIDEST).tolist()

    def _loose(self, second: int, looked: Set[int] = frozenset()) -> dict[int, float]:
        """The earlier maps that a map may be laid on, but those that were looked at: how unsure its place is, in m.

        Those are left out that it cannot touch, and on which it may be farther off than is searched: what is found may
        be elsewhere, too.
        """
        near = [first for first in self._near(second) if first not in looked]
        poses, covariances = self.graph.from_each(near, second)
        b = self.maps[second].shape
        spreads = 3.0 * np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
        centres = poses[:, :2] + rotate(poses[:, 2], b.centre)
        loose = {}
        for first, lost, spread, centre in zip(
            near, _are_lost(covariances), spreads.tolist(), centres, strict=True
        ):
            a = self.maps[first].shape
            apart = np.hypot(*(centre - a.centre))
            if not lost and apart <= a.radius + b.radius + min(spread, WIDEST) - 2.0:
                loose[first] = spread
        return loose

    def _lay(self, first: int, second: int) -> Verdict | None:
        """The best place of one map on another, and whether it is believed; None if there is none."""
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
        following = second == first + 1
        verdict = judged(overlays, guess, covariance, self.scale, following=following)
        if verdict is None and self.witness is not None and min(a.shape.length, b.shape.length) < SPARSE:
            end = a.end_covariance + FLOOR if following else None
            return self.witness.by_points(first, second, (guess, covariance, self.scale), (half, turn), end)
        return verdict


def _are_lost(covariances: np.ndarray) -> np.ndarray:
    """(K,) whether places (K, 3, 3) may be farther off than is searched."""
    wide = 9.0 * np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]) > WIDEST**2
    return np.asarray(wide | (9.0 * covariances[:, 2, 2] > FARTHEST_TURN**2))


def _misfit(found: Overlay, last: ClosedMap) -> float:
    """Squared Mahalanobis distance of the next map's place by overlay from the last one's end, which err alike."""
    shared = found.with_end + found.with_end.T
    return squared_off(found, last.end, last.end_covariance - shared)
