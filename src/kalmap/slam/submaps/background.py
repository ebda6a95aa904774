"""A forest whose joins run beside the live filter, which never waits for them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterable
from typing import Generic

from kalmap.slam.submaps.forest import Forest, Joiner, M, Tree

_NICENESS = 10


class BackgroundForest(Generic[M]):
    """The same trees as a `Forest` fed in the same order, by a worker thread of low priority.

    `maps` are at any time the joined ones so far and, behind them, the closed ones that wait. An error of a join is
    raised by the next call of `close` or `settled`. The worker lives while there is something to do.
    """

    def __init__(self, joiner: Joiner[M], trees: Iterable[Tree[M]] = (), refusals: int = 0) -> None:
        self.joiner = joiner
        self._forest = Forest(joiner, trees, refusals)
        self._waiting: list[M] = []
        self._seen = self._forest.maps
        self._lock, self._idle = threading.Lock(), threading.Event()
        self._idle.set()
        self._problem: Exception | None = None

    def close(self, closed: M) -> None:
        """Hand the next map of the drive over."""
        self._raise()
        with self._lock:
            self._waiting.append(closed)
            resting = self._idle.is_set()
            self._idle.clear()
        if resting:
            threading.Thread(target=self._work, name="kalmap-joins", daemon=True).start()

    @property
    def maps(self) -> tuple[M, ...]:
        """All maps in the order of the drive, joined as far as the worker has come."""
        with self._lock:
            return (*self._seen, *self._waiting)

    def settled(self) -> Forest[M]:
        """The forest, once the worker has done all that there is."""
        self._idle.wait()
        self._raise()
        return self._forest

    def _raise(self) -> None:
        if self._problem is not None:
            raise self._problem

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # a system without priorities has none to lower
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        while True:
            with self._lock:
                if not self._waiting or self._problem is not None:
                    self._idle.set()
                    return
                closed = self._waiting[0]
            try:
                self._forest.close(closed)
            except Exception as problem:
                self._problem = problem
            with self._lock:
                self._seen = self._forest.maps
                del self._waiting[0]
