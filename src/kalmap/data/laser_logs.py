"""Which raw laser log a file or folder is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kalmap.data.carmen import is_carmen, open_carmen
from kalmap.records import Log, LogError

LOOKED_FOR = "*.clf or *.log, also packed (CARMEN)"

Opened = tuple[str, Callable[[], Log]]


def laser_file(path: Path) -> Opened | None:
    """The raw laser log in a file, by its name; None if it is none."""
    if is_carmen(path):
        return "CARMEN", lambda: open_carmen(path)
    return None


def laser_folder(folder: Path) -> Opened | None:
    """The raw laser log in a folder; a raw CARMEN log (.clf) goes before a .log, which may be a corrected one."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    found = [path for path in files if is_carmen(path)]
    raw = [path for path in found if ".clf" in path.name.lower()] or found
    if not raw:
        return None
    if len(raw) > 1:
        names = ", ".join(path.name for path in raw)
        raise LogError(f"holds several CARMEN logs, name one of them: {names}", file=folder)
    return laser_file(raw[0])
