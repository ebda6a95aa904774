"""kalmap: 2-D SLAM from logs, with trajectory, map and honest covariances, without ROS.

Names are imported when they are first asked for, so that `kalmap --help` starts at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from kalmap._version import __version__

_HOMES = {
    "kalmap.slam": ("LandmarkSlam", "run", "slam_from_config"),
    "kalmap.gaussian": ("CentralDifference", "Cubature", "Jacobian", "Unscented"),
    "kalmap.models": ("Ackermann", "Bias", "Increments", "RangeBearing", "Unicycle", "VelocitySteering"),
    "kalmap.association": ("Djnn", "Jcbb", "KnownIds", "Likelihood", "Mda", "Nearest"),
    "kalmap.perception": ("ReflectorDetector", "TreeDetector"),
    "kalmap.records": (
        "Estimate", "Fix", "KalmapError", "Landmarks", "Log", "Odometry", "RunConfig", "Scan", "Sightings", "Trace",
    ),
    "kalmap.data": ("open_log", "write_csv_log"),
    "kalmap.evaluation": ("evaluate",),
}  # fmt: skip
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'kalmap' has no attribute {name!r}")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return __all__
