"""Which raw laser log a file or folder is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kalmap.data.carmen import is_carmen, open_carmen
from kalmap.data.coreslam import is_coreslam, open_coreslam
from kalmap.data.drive import DriveEvents
from kalmap.data.laser_check import drive_notes
from kalmap.data.ros_bags import is_bag
from kalmap.records import Log, LogError

BAG = "ROS bag"

LOOKED_FOR = """\
*.clf or *.log, also packed (CARMEN), \
*.dat of 707 columns (CoreSLAM), \
*.bag (ROS 1), metadata.yaml, *.db3 or *.mcap (ROS 2)"""

Opened = tuple[str, Callable[[], Log]]


def laser_file(path: Path, scan_topic: str | None, odometry_topic: str | None) -> Opened | None:
    """The raw laser log in a file, or in the folder of a ROS 2 bag; None if it is none."""
    if is_bag(path):
        from kalmap.data.ros_drive import open_bag

        return BAG, lambda: open_bag(path, scan_topic, odometry_topic)
    if path.is_file() and is_carmen(path):
        return "CARMEN", lambda: open_carmen(path)
    if path.is_file() and is_coreslam(path):
        return "CoreSLAM", lambda: open_coreslam(path)
    return None


def laser_folder(folder: Path, scan_topic: str | None, odometry_topic: str | None) -> Opened | None:
    """The raw laser log in a folder; a raw CARMEN log (.clf) goes before a .log, which may be a corrected one.

    Raises LogError where it holds several.
    """
    if is_bag(folder):
        return laser_file(folder, scan_topic, odometry_topic)
    found = [
        path
        for path in sorted(folder.iterdir())
        if is_bag(path) or (path.is_file() and (is_carmen(path) or is_coreslam(path)))
    ]
    found = [path for path in found if ".clf" in path.name.lower()] or found
    if not found:
        return None
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise LogError(f"holds several laser logs, name one of them: {names}", file=folder)
    return laser_file(found[0], scan_topic, odometry_topic)


def reader_notes(log: Log) -> tuple[str, ...]:
    """What the reader of a raw laser log decided that its user should know: which topic, which mounting."""
    return drive_notes(log.open.drive) if isinstance(log.open, DriveEvents) else ()
