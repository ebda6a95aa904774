"""From a configuration to a detector."""

from __future__ import annotations

from typing import Any

from kalmap.perception.detector import Detector
from kalmap.perception.poles import ReflectorDetector
from kalmap.perception.trees import TreeDetector
from kalmap.records import ConfigError, PerceptionConfig


def detector_from_config(config: PerceptionConfig) -> Detector:
    """The detector that a configuration describes. Raises ConfigError for one that does not exist."""
    limits: dict[str, Any] = {} if config.max_range is None else {"max_range": config.max_range}
    if config.detector == "trees":
        spared: dict[str, Any] = {} if config.clearance is None else {"clearance": config.clearance}
        return TreeDetector(**limits, **spared)
    if config.detector != "reflectors":
        raise ConfigError(f"perception.detector: {config.detector!r} is none of reflectors, trees")
    if config.clearance is not None:
        raise ConfigError("perception.clearance: reflectors are told by their brightness; it is for trees")
    return ReflectorDetector(**limits)
