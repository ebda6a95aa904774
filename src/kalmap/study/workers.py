"""Cases side by side in worker processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from kalmap.records import ConfigError, KalmapError

Task = TypeVar("Task")
Result = TypeVar("Result")

_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")


def carry_out(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[tuple[int, Result]]:
    """Yield (index, work(task)) as they are done, in any order.

    work: a function of a module, since workers are new processes ("spawn": a fork would copy numba's and
        BLAS's threads half). workers: how many, None for one a processor; 1 stays in this process.

    Only as many tasks as there are workers are under way at a time, so Ctrl-C ends within one task.
    Raises what `work` raises, and `KalmapError` if a worker process dies.
    """
    count = worker_count(workers)
    if count == 1 or len(tasks) < 2:
        for index, task in enumerate(tasks):
            yield index, work(task)
        return
    try:
        with _one_thread_each(), _pool(min(count, len(tasks))) as pool:
            yield from _in_pool(pool, work, tasks, count)
    except BrokenProcessPool as problem:
        raise KalmapError(
            "a worker process died. Out of memory? A script that starts workers needs the line "
            "`if __name__ == '__main__':` around its work; workers=1 needs neither"
        ) from problem


def worker_count(workers: int | None) -> int:
    """How many workers are meant; None is one for each processor."""
    if workers is not None and workers < 1:
        raise ConfigError(f"workers: expected 1 or more, got {workers}")
    return workers or os.cpu_count() or 1


def _pool(count: int) -> ProcessPoolExecutor:
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        count, mp_context=spawn, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
    )


def _in_pool(
    pool: ProcessPoolExecutor, work: Callable[[Task], Result], tasks: Sequence[Task], count: int
) -> Iterator[tuple[int, Result]]:
    waiting = iter(enumerate(tasks))
    under_way: dict[Future[Result], int] = {}

    def start() -> None:
        for index, task in waiting:
            under_way[pool.submit(partial(_interruptible, work), task)] = index
            return

    for _ in range(count):
        start()
    while under_way:
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            index = under_way.pop(future)
            start()
            yield index, future.result()


def _interruptible(work: Callable[[Task], Result], task: Task) -> Result:
    """An idle worker ignores Ctrl-C (its parent will end it); a busy one drops its task."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return work(task)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Workers started inside inherit one BLAS thread each: they would only take turns on the processors."""
    before = {name: os.environ.get(name) for name in _BLAS_THREADS}
    os.environ.update(dict.fromkeys(_BLAS_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
