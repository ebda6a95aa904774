"""A forest whose joins run beside the live filter, which never waits for them."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from typing import Generic

from kalmap.slam.submaps.forest import Forest, Joiner, M, Tree

_NICENESS = 10


class BackgroundForest(Generic[M]):
    """The same trees as a `Forest` fed in the same order, by a worker thread of low priority.

    `maps` are at any time the joined ones so far and, behind them, the closed ones that wait. An error of a join is
    raised by the next call of `close`, `settled` or `trees`.
    """

    def __init__(self, joiner: Joiner[M], trees: tuple[Tree[M], ...] = (), refusals: int = 0) -> None:
        self.joiner = joiner
        self._forest = Forest(joiner, trees, refusals)
        self._waiting: list[M] = []
        self._seen = self._forest.maps
        self._queue: queue.SimpleQueue[M | None] = queue.SimpleQueue()
        self._lock, self._idle = threading.Lock(), threading.Event()
        self._idle.set()
        self._problem: Exception | None = None
        self._thread: threading.Thread | None = None

    def close(self, closed: M) -> None:
        """Hand the next map of the drive over."""
        self._raise()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="kalmap-joins", daemon=True)
            self._thread.start()
        with self._lock:
            self._waiting.append(closed)
            self._idle.clear()
        self._queue.put(closed)

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

    def stop(self) -> None:
        """Let the worker end when it has done what it has."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None

    def _raise(self) -> None:
        if self._problem is not None:
            raise self._problem

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # a system without priorities has none to lower
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        while (closed := self._queue.get()) is not None:
            if self._problem is None:
                try:
                    self._forest.close(closed)
                except Exception as problem:
                    self._problem = problem
            with self._lock:
                if self._problem is None:
                    self._waiting.pop(0)
                    self._seen = self._forest.maps
                if self._problem is not None or not self._waiting:
                    self._idle.set()
