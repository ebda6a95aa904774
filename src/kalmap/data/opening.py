"""Recognises a log by what its folder or file holds, and opens it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kalmap.data import car_park, csv_layout, dlr, laser_logs, mrclam
from kalmap.data import victoria_park as park
from kalmap.data.blocks import Detector
from kalmap.data.csv_read import open_csv
from kalmap.data.mat import variable_names
from kalmap.records import Log, LogError

PARK_FILES = (park.ODOMETRY, park.UNIDENTIFIED, park.ARCHIVE, "DRS.txt")

LOOKED_FOR = f"""\
{" or ".join(PARK_FILES)} (ACFR Victoria Park), \
{car_park.DATA} (ACFR car park), \
RobotK_Odometry.dat with or without .xz (MRCLAM), \
{dlr.CORRECTED} or {dlr.ORIGINAL} (DLR), \
{csv_layout.ODOMETRY} (csv layout), \
{laser_logs.LOOKED_FOR}"""


def open_log(
    path: str | Path,
    *,
    robot: int | None = None,
    variant: str | None = None,
    detector: Detector | None = None,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
) -> Log:
    """The log in a folder or file, whatever its format.

    robot: which robot of a MRCLAM folder, by default the first; see `mrclam_robots` for all.
    variant: of Victoria Park "ids" (default), "detections", "ascii" or "scans"; of the car park
        "sightings" (default) or "scans".
    detector: turns scans into sightings; without one the scans themselves are events. Logs of raw scans take none.
    scan_topic, odometry_topic: of a ROS bag; by default the only ones of their type, else /scan and /odom, else those
        with most messages, else the transform from odom to the robot.

    Raises `LogError` if no format is recognised, or a file, robot or variant is missing. Bad records
    come up only when the log is iterated.
    """
    path = Path(path)
    if not path.exists():
        raise LogError("no such file or folder", file=path)
    topics = scan_topic, odometry_topic
    opened = (
        _open_folder(path, robot, variant, detector, topics)
        if path.is_dir()
        else _open_file(path, variant, detector, topics)
    )
    if opened is None:
        raise LogError(f"no log recognised. Looked for {LOOKED_FOR}. {_contents(path)}", file=path)
    format_name, start = opened
    if robot is not None and format_name != "MRCLAM":
        raise LogError(f"robot {robot} was asked for, but this is a log of one vehicle", file=path)
    if variant is not None and format_name not in ("Victoria Park", "car park"):
        raise LogError(f"variant {variant!r} was asked for, but {format_name} logs have none", file=path)
    if topics != (None, None) and format_name != laser_logs.BAG:
        raise LogError(f"a topic was asked for, but {format_name} logs have none", file=path)
    return start()


Opened = tuple[str, Callable[[], Log]]
Topics = tuple[str | None, str | None]


def _open_folder(
    folder: Path, robot: int | None, variant: str | None, detector: Detector | None, topics: Topics
) -> Opened | None:
    if (folder / csv_layout.ODOMETRY).is_file():
        return "csv", lambda: open_csv(folder)
    if any((folder / name).is_file() for name in PARK_FILES):
        return "Victoria Park", lambda: park.open_victoria_park(folder, variant, detector)
    if (folder / car_park.DATA).is_file():
        return "car park", lambda: car_park.open_car_park(folder / car_park.DATA, variant, detector)
    circles = next((folder / n for n in (dlr.CORRECTED, dlr.ORIGINAL) if (folder / n).is_file()), None)
    if circles is not None:
        return "DLR", lambda: dlr.open_dlr(circles)
    if mrclam.mrclam_robots(folder):
        return "MRCLAM", lambda: mrclam.open_mrclam(folder, robot)
    return laser_logs.laser_folder(folder, *topics)


def _open_file(path: Path, variant: str | None, detector: Detector | None, topics: Topics) -> Opened | None:
    folder = path.parent
    if path.name == csv_layout.ODOMETRY:
        return "csv", lambda: open_csv(folder)
    variants = {
        park.ODOMETRY: "ids",
        park.IDENTIFIED: "ids",
        park.UNIDENTIFIED: "detections",
        park.DETECTIONS: "ascii",
        park.ARCHIVE: "scans",
        "LASER.txt": "scans",
    }
    if path.name in variants:
        chosen = variant or variants[path.name]
        return "Victoria Park", lambda: park.open_victoria_park(folder, chosen, detector)
    if path.name in (dlr.CORRECTED, dlr.ORIGINAL) or _begins_with_step(path):
        return "DLR", lambda: dlr.open_dlr(path)
    laser = laser_logs.laser_file(path, *topics)
    if laser is not None:
        return laser
    if path.name == car_park.DATA or {"Time_VS", "Laser"} <= set(variable_names(path)):
        return "car park", lambda: car_park.open_car_park(path, variant, detector)
    return None


def _begins_with_step(path: Path) -> bool:
    """Whether the first line of a text that is no comment is a step of a `map.circles`."""
    try:
        with path.open("rb") as stream:
            lines = stream.read(1 << 14).splitlines()
    except OSError:
        return False
    return next((line for line in lines if line and not line.startswith(b"#")), b"").startswith(b"STEP ")


def _contents(path: Path) -> str:
    if not path.is_dir():
        names = variable_names(path)
        return f"The file holds the variables {', '.join(names)}." if names else "The file is none of these."
    names = sorted(p.name + ("/" if p.is_dir() else "") for p in path.iterdir())
    if not names:
        return "The folder is empty."
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return f"The folder holds {', '.join(names[:12])}{more}."
