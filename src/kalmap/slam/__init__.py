"""SLAM proper: the landmark filters and the run loop."""

from kalmap.slam.build import ASSOCIATIONS, SET_METHODS, WEIGHED_METHODS, check_method, slam_from_config
from kalmap.slam.filters import FILTERS, resolve_filter
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.run import Outcome, run

__all__ = [
    "ASSOCIATIONS",
    "FILTERS",
    "SET_METHODS",
    "WEIGHED_METHODS",
    "LandmarkSlam",
    "Outcome",
    "check_method",
    "resolve_filter",
    "run",
    "slam_from_config",
]
