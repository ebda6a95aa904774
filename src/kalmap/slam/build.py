"""From a configuration to a filter."""

from __future__ import annotations

from typing import Any

import msgspec

from kalmap.association import (
    Associator,
    Attribute,
    Counter,
    Djnn,
    Existence,
    Jcbb,
    Keep,
    KnownIds,
    Likelihood,
    Mda,
    Merging,
    Nearest,
    Pmb,
    Region,
    Trial,
)
from kalmap.association.management import BuiltInManagement
from kalmap.models.motion import motion_from_config
from kalmap.models.sensor import sensor_from_config
from kalmap.perception import Detector, detector_from_config
from kalmap.records import AssociationConfig, ConfigError, Log, RunConfig
from kalmap.slam.filters import resolve_filter
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.landmark import LandmarkSlam

ASSOCIATIONS = ("known", "nearest", "likelihood", "jcbb", "mda", "djnn", "pmb")

_OWN_MANAGEMENT = {"djnn": "counter"}


def associator_from_config(config: AssociationConfig) -> Associator:
    """The associator that a configuration describes."""
    if config.method == "known":
        return KnownIds()
    shared: dict[str, Any] = {
        "gate": config.gate,
        "new_gate": config.new_gate,
        "extent": config.extent,
        "ambiguity": config.ambiguity,
        "region": Region(local=config.local, reliable_range=config.reliable_range),
        "management": _management(config),
        "merging": Merging() if config.merge else None,
        "attributes": tuple(Attribute(**msgspec.structs.asdict(each)) for each in config.attributes),
    }
    if config.method == "nearest":
        return Nearest(one_to_one=config.one_to_one, **shared)
    if config.method == "likelihood":
        return Likelihood(**shared)
    if config.method == "jcbb":
        return Jcbb(joint_gate=config.joint_gate, work=config.work, **shared)
    if config.method == "djnn":
        return Djnn(interference=config.interference, widen=config.widen, **shared)
    if config.method == "mda":
        return Mda(
            window=config.window,
            detection=config.detection,
            false_rate=config.false_rate,
            new_rate=config.new_rate,
            **shared,
        )
    if config.method == "pmb":
        return Pmb(
            detection=config.detection, false_rate=config.false_rate, new_rate=config.new_rate, **shared
        )
    raise ConfigError(f"association.method: {config.method!r} is none of {', '.join(ASSOCIATIONS)}")


def _management(config: AssociationConfig) -> BuiltInManagement:
    name = config.management or _OWN_MANAGEMENT.get(config.method, "existence")
    if name == "trial":
        return Trial(confirm=config.confirm, window=config.confirm_window)
    if name == "counter":
        return Counter(admit=config.confirm)
    if name == "existence":
        return Existence(detection=config.detection, admit=config.existence)
    return Keep()


def slam_from_config(
    config: RunConfig, log: Log, detector: Detector | None = None
) -> LandmarkSlam | FiniteSetSlam:
    """The filter for this log. Raises ConfigError where settings contradict each other.

    detector: turns scans into sightings; None builds the one that the configuration names.
    """
    if config.finite_set.method is not None:
        return FiniteSetSlam(
            motion_from_config(config.motion),
            sensor_from_config(config.sensor),
            config.finite_set,
            start=log.start,
            start_covariance=log.start_covariance,
            seed=config.seed,
            extent=config.association.extent,
            detector=detector or detector_from_config(config.perception),
        )
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
        detector=detector or detector_from_config(config.perception),
    )
