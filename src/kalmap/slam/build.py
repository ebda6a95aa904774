"""From a configuration to a filter."""

from __future__ import annotations

from kalmap.association import Associator, KnownIds, Likelihood
from kalmap.models.motion import motion_from_config
from kalmap.models.sensor import sensor_from_config
from kalmap.perception import Detector
from kalmap.records import AssociationConfig, ConfigError, Log, RunConfig
from kalmap.slam.filters import resolve_filter
from kalmap.slam.landmark import LandmarkSlam


def associator_from_config(config: AssociationConfig) -> Associator:
    """The associator that a configuration describes."""
    if config.method == "known":
        return KnownIds()
    if config.method != "likelihood":
        raise ConfigError(f"association.method: {config.method!r} is none of known, likelihood")
    return Likelihood(
        gate=config.gate,
        new_gate=config.new_gate,
        confirm=config.confirm,
        confirm_window=config.confirm_window,
    )


def slam_from_config(config: RunConfig, log: Log, detector: Detector | None = None) -> LandmarkSlam:
    """The filter for this log. Raises ConfigError where settings contradict each other."""
    lineariser, scope = resolve_filter(config.filter)
    return LandmarkSlam(
        motion_from_config(config.motion),
        sensor_from_config(config.sensor),
        lineariser,
        associator_from_config(config.association),
        scope=scope,
        coordinates=config.filter.coordinates,
        use=config.filter.use,
        start=log.start,
        start_covariance=log.start_covariance,
        detector=detector,
    )
