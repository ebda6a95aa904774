"""Scan to sightings: detectors of landmarks in laser scans."""

from kalmap.perception.detector import Detector
from kalmap.perception.poles import ReflectorDetector

__all__ = ["Detector", "ReflectorDetector"]
