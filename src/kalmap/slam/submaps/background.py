"""A forest whose joins run beside the live filter, which never waits for them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic

from kalmap.slam.in_order import InOrder
from kalmap.slam.submaps.forest import Forest, Joiner, M, Tree


class BackgroundForest(Generic[M]):
    """The same trees as a `Forest` fed in the same order, by a worker thread of low priority.

    `maps` are at any time the joined ones so far and, behind them, the closed ones that wait. An error of a join is
    raised by the next call of `close` or `settled`. The worker lives while there is something to do.
    """

    def __init__(self, joiner: Joiner[M], trees: Iterable[Tree[M]] = (), refusals: int = 0) -> None:
        self.joiner = joiner
        self._forest = Forest(joiner, trees, refusals)
        self._seen = self._forest.maps
        self._worker: InOrder[M] = InOrder(self._forest.close, self._look)

    def close(self, closed: M) -> None:
        """Hand the next map of the drive over."""
        self._worker.hand(closed)

    @property
    def maps(self) -> tuple[M, ...]:
        """All maps in the order of the drive, joined as far as the worker has come."""
        with self._worker.lock:
            return (*self._seen, *self._worker.waiting)

    def settled(self) -> Forest[M]:
        """The forest, once the worker has done all that there is."""
        self._worker.wait()
        return self._forest

    def _look(self) -> None:
        self._seen = self._forest.maps
