"""Scan to sightings: detectors of landmarks in laser scans."""

from kalmap.perception.build import detector_from_config
from kalmap.perception.detector import Detector
from kalmap.perception.poles import ReflectorDetector
from kalmap.perception.trees import TreeDetector

__all__ = ["Detector", "ReflectorDetector", "TreeDetector", "detector_from_config"]
