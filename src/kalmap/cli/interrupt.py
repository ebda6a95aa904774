"""Ctrl-C that waits for the event at hand, so that what is written is a whole state of the filter."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def stop_between_events() -> Iterator[Callable[[], None]]:
    """Yields a function to call between events: it raises KeyboardInterrupt if Ctrl-C came since.

    A second Ctrl-C does not wait. Where the signal is ignored or is somebody else's, nothing changes.
    """
    asked = False

    def ask(*_: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    def stop_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield stop_if_asked
        return
    signal.signal(signal.SIGINT, ask)
    try:
        yield stop_if_asked
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
