"""Work that is done in order beside the live filter, which never waits for it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")
_NICENESS = 10


class InOrder(Generic[T]):
    """A thread of low priority that lives while there is something to do.

    work: done with each item in turn. done: called when an item is done and ceases to wait, both at once for whoever
    holds `lock`. Whatever goes wrong is raised by the next call of `hand` or `wait`; what waits then is not done.
    """

    def __init__(self, work: Callable[[T], None], done: Callable[[], None]) -> None:
        self._work, self._done = work, done
        self.lock = threading.Lock()
        self.waiting: list[T] = []
        self._idle = threading.Event()
        self._idle.set()
        self._problem: Exception | None = None

    def hand(self, item: T) -> None:
        """Hand over what is to be done."""
        self._raise()
        with self.lock:
            self.waiting.append(item)
            resting = self._idle.is_set()
            self._idle.clear()
        if resting:
            threading.Thread(target=self._run, name="kalmap-joins", daemon=True).start()

    def wait(self) -> None:
        """Until all that was handed over is done."""
        self._idle.wait()
        self._raise()

    def _raise(self) -> None:
        if self._problem is not None:
            raise self._problem

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # a system without priorities has none to lower
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        while True:
            with self.lock:
                if not self.waiting or self._problem is not None:
                    self._idle.set()
                    return
                item = self.waiting[0]
            try:
                self._work(item)
            except Exception as problem:  # a thread has nobody to tell: the next call does
                self._problem = problem
            with self.lock:
                self._done()
                del self.waiting[0]
