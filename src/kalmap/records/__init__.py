"""The nouns everyone shares: events, logs, settings, estimates, traces and errors."""

from kalmap.records.config import (
    AssociationConfig,
    AttributeConfig,
    ContourConfig,
    DivideConfig,
    FilterConfig,
    FiniteSetConfig,
    MotionConfig,
    PerceptionConfig,
    RunConfig,
    SensorConfig,
)
from kalmap.records.contours import Contours, Sweeps, Trajectory
from kalmap.records.decisions import REASONS, Frame, Managed, Reason, Why
from kalmap.records.errors import (
    ConfigError,
    EstimationError,
    EventError,
    JointTooLargeError,
    KalmapError,
    LogError,
)
from kalmap.records.estimate import (
    NEW,
    SPURIOUS,
    Association,
    Estimate,
    Landmarks,
    Manifest,
    Trace,
    final_course,
)
from kalmap.records.events import Event, Fix, Odometry, Scan, Sightings
from kalmap.records.grid import OccupancyGrid
from kalmap.records.log import Log, Reference, Relations, SightingTruth, Skipped

__all__ = [
    "NEW",
    "REASONS",
    "SPURIOUS",
    "Association",
    "AssociationConfig",
    "AttributeConfig",
    "ConfigError",
    "ContourConfig",
    "Contours",
    "DivideConfig",
    "Estimate",
    "EstimationError",
    "Event",
    "EventError",
    "FilterConfig",
    "FiniteSetConfig",
    "Fix",
    "Frame",
    "JointTooLargeError",
    "KalmapError",
    "Landmarks",
    "Log",
    "LogError",
    "Managed",
    "Manifest",
    "MotionConfig",
    "OccupancyGrid",
    "Odometry",
    "PerceptionConfig",
    "Reason",
    "Reference",
    "Relations",
    "RunConfig",
    "Scan",
    "SensorConfig",
    "SightingTruth",
    "Sightings",
    "Skipped",
    "Sweeps",
    "Trace",
    "Trajectory",
    "Why",
    "final_course",
]
