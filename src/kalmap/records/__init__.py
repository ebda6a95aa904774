"""The nouns everyone shares: events, logs, settings, estimates, traces and errors."""

from kalmap.records.config import (
    AssociationConfig,
    FilterConfig,
    MotionConfig,
    RunConfig,
    SensorConfig,
)
from kalmap.records.errors import ConfigError, EstimationError, EventError, KalmapError, LogError
from kalmap.records.estimate import NEW, SPURIOUS, Association, Estimate, Landmarks, Manifest, Trace
from kalmap.records.events import Event, Fix, Odometry, Scan, Sightings
from kalmap.records.log import Log, Reference, Skipped

__all__ = [
    "NEW",
    "SPURIOUS",
    "Association",
    "AssociationConfig",
    "ConfigError",
    "Estimate",
    "EstimationError",
    "Event",
    "EventError",
    "FilterConfig",
    "Fix",
    "KalmapError",
    "Landmarks",
    "Log",
    "LogError",
    "Manifest",
    "MotionConfig",
    "Odometry",
    "Reference",
    "RunConfig",
    "Scan",
    "SensorConfig",
    "Sightings",
    "Skipped",
    "Trace",
]
