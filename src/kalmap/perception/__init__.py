"""What laser scans show: landmarks, pieces of contour, and the free and occupied space that they sweep."""

from kalmap.perception.build import detector_from_config
from kalmap.perception.contours import CutConfig, EndKind, Pieces, cut_scan, cut_settings, share_on_contours
from kalmap.perception.detector import Detector
from kalmap.perception.grid import occupancy_grid
from kalmap.perception.poles import ReflectorDetector
from kalmap.perception.trees import TreeDetector

__all__ = [
    "CutConfig",
    "Detector",
    "EndKind",
    "Pieces",
    "ReflectorDetector",
    "TreeDetector",
    "cut_scan",
    "cut_settings",
    "detector_from_config",
    "occupancy_grid",
    "share_on_contours",
]
