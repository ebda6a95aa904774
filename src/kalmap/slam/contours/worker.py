"""What is done with closed maps beside the live filter: their scans laid on them once more, and the loops."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.slam.contours.closed import ClosedMap
from kalmap.slam.contours.leg import Leg
from kalmap.slam.contours.live import LiveMap
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.seen import prepare
from kalmap.slam.contours.witness import Witness
from kalmap.slam.in_order import InOrder

LEAST_FOUND = 10  # samples that a scan must find to be laid on a map once more
STRAY = np.diag(
    [0.03**2, 0.03**2, np.radians(1.0) ** 2]
)  # how far a scan may be from where the filter had it; less where that was sure: no prior, but a guard
LEAST_STRAY = 0.01 * STRAY


class Joined(msgspec.Struct):
    """All closed maps: their loops, the legs of the drive that they cover, and what these can be asked."""

    loops: Loops
    legs: list[Leg]
    witness: Witness | None = None

    def close(self, live: LiveMap, leg: Leg) -> None:
        """Take a local map that has been closed, and the scans that it was made from.

        Where its place among the others cannot be judged, it keeps the one behind the last, and the reason is kept.
        """
        self.loops.append(closed(live))
        self.legs.append(leg)
        graph = self.loops.graph.copy()
        try:
            self.legs[-1] = relaid(live, leg)
            self.witness = self.witness or Witness(self.legs, live.rules)
            self.loops.seek(self.witness)
        except (ArithmeticError, ValueError) as problem:  # not positive definite, or singular
            self.loops.give_up(graph, str(problem))


class Placed(msgspec.Struct, frozen=True, eq=False):
    """The frame of the newest map that has been joined, number count - 1: pose (3,) and covariance (3, 3).

    scale: of what maps say of their ends, see `Loops.told_scale`.
    """

    count: int
    pose: np.ndarray
    covariance: np.ndarray
    scale: float


def closed(live: LiveMap) -> ClosedMap:
    """The map as it is left, without the scanner's calibration."""
    mean, covariance = live.map()
    return ClosedMap(mean, covariance, live.normals.copy(), live.sightings.copy(), live.rules.contour.spacing)


def relaid(live: LiveMap, leg: Leg) -> Leg:
    """Every scan of the leg laid on the finished map: where it was taken is known better now than at the time.

    Not so for a vehicle that never moved.
    """
    if not live.length:
        return leg
    poses = leg.poses.copy()
    calibration = live.calibration.mean
    known = leg.covariances + LEAST_STRAY
    priors = STRAY @ np.linalg.inv(STRAY + known) @ known  # the parallel sum of both
    for row, scan in enumerate(leg.scans):
        prior = 0.5 * (priors[row] + priors[row].T)
        pose, found = live.place(prepare(scan, live.rules, calibration, leg.twists[row]), poses[row], prior)
        if (found >= 0).sum() >= LEAST_FOUND:
            poses[row] = pose
    return msgspec.structs.replace(leg, poses=poses)


class Worker:
    """Closes maps at once, or in a thread of low priority that the live filter does not wait for.

    placed: where the newest joined map lies, as far as the worker has come. An error is raised by the next call.
    """

    def __init__(self, joined: Joined, background: bool) -> None:
        self._joined, self._background = joined, background
        self._thread: InOrder[tuple[LiveMap, Leg]] = InOrder(lambda each: joined.close(*each), self._look)
        self.placed = _placed(joined)

    def close(self, live: LiveMap, leg: Leg) -> None:
        """Hand over a local map that is finished; it must not be changed any more."""
        if self._background:
            self._thread.hand((live, leg))
            return
        self._joined.close(live, leg)
        self._look()

    def settled(self) -> Joined:
        """All that was handed over, done."""
        self._thread.wait()
        return self._joined

    def _look(self) -> None:
        self.placed = _placed(self._joined)


def _placed(joined: Joined) -> Placed:
    loops = joined.loops
    count, scale = len(loops.maps), loops.told_scale
    if not count:
        return Placed(0, np.zeros(3), np.zeros((3, 3)), scale)
    return Placed(count, loops.graph.frames[-1].copy(), loops.own_covariances()[-1].copy(), scale)
