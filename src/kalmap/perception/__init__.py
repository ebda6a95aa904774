"""What laser scans show: landmarks in them, and the free and occupied space that they sweep."""

from kalmap.perception.build import detector_from_config
from kalmap.perception.detector import Detector
from kalmap.perception.grid import occupancy_grid
from kalmap.perception.poles import ReflectorDetector
from kalmap.perception.trees import TreeDetector

__all__ = ["Detector", "ReflectorDetector", "TreeDetector", "detector_from_config", "occupancy_grid"]
