"""From a configuration to a filter."""

from __future__ import annotations

from typing import Any, get_args

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
from kalmap.perception import detector_from_config
from kalmap.records import AssociationConfig, ConfigError, FiniteSetConfig, Log, RunConfig
from kalmap.records.config import AssociationName, ManagementName, SetMethod
from kalmap.slam.contours.slam import ContourSlam
from kalmap.slam.filters import resolve_filter
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.mixture import MixtureSlam
from kalmap.slam.submaps.divide import DivideAndConquer

SET_METHODS: tuple[str, ...] = get_args(SetMethod)
WEIGHED_METHODS = ("rb-phd", "srckf-phd")
ASSOCIATIONS: tuple[str, ...] = get_args(AssociationName)

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
        return Counter(detection=config.detection, admit=config.confirm)
    if name == "existence":
        return Existence(detection=config.detection, admit=config.existence)
    if name == "keep":
        return Keep()
    known = ", ".join(get_args(ManagementName))
    raise ConfigError(f"association.management: {name!r} is none of {known}")


def check_method(config: RunConfig) -> None:
    """Raise ConfigError where the settings of the method contradict each other."""
    sets = config.finite_set
    if sets.method is None or sets.method == "pmbm":
        resolve_filter(config.filter)
    if config.contour.method is not None and sets.method is not None:
        raise ConfigError(f"contour.method: {sets.method} maps landmarks, {config.contour.method} contours")
    if config.divide.on and sets.method is not None:
        raise ConfigError(
            f"divide.on: {sets.method} keeps its map as a random finite set, which is not divided"
        )
    if config.divide.on and config.association.method == "mda":
        raise ConfigError(
            "divide.on: mda looks back over frames of maps that may be closed: take another association"
        )
    if sets.method is not None and sets.weighting is not None and sets.method not in WEIGHED_METHODS:
        raise ConfigError(
            f"finite_set.weighting: {sets.method} weighs its particles in one way only; "
            f"{sets.weighting} is for {' and '.join(WEIGHED_METHODS)}"
        )


def slam_from_config(
    config: RunConfig, log: Log
) -> LandmarkSlam | FiniteSetSlam | MixtureSlam | DivideAndConquer | ContourSlam:
    """The estimator for this log. Raises ConfigError where settings contradict each other."""
    check_method(config)
    if config.contour.method is not None:
        return _contour_slam(config, log)
    if config.finite_set.method == "pmbm":
        return _mixture(config, log)
    if config.finite_set.method is not None:
        return FiniteSetSlam(
            motion_from_config(config.motion),
            sensor_from_config(config.sensor),
            config.finite_set,
            start=log.start,
            start_covariance=log.start_covariance,
            seed=config.seed,
            extent=config.association.extent,
            detector=detector_from_config(config.perception),
        )
    slam = _landmark_slam(config, log)
    return DivideAndConquer(slam, config.divide) if config.divide.on else slam


def _contour_slam(config: RunConfig, log: Log) -> ContourSlam:
    lineariser, scope = resolve_filter(config.filter)
    if scope == "full":
        raise ConfigError(
            "filter.scope: a sample's distance reads pose and sample alone: take the reduced filter"
        )
    return ContourSlam(
        motion_from_config(config.motion),
        config.sensor,
        config.contour,
        lineariser,
        config.filter.coordinates,
        start=log.start,
        start_covariance=log.start_covariance,
    )


def _landmark_slam(config: RunConfig, log: Log) -> LandmarkSlam:
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
        detector=detector_from_config(config.perception),
    )


def _mixture(config: RunConfig, log: Log) -> MixtureSlam:
    """Explanations side by side, by the filter and the association that are set, with the rates of the sets."""
    sets = config.finite_set
    association = msgspec.structs.replace(
        config.association,
        method="pmb",
        detection=min(max(sets.detection, 1e-6), 1.0 - 1e-6),
        false_rate=max(sets.clutter, 1e-3),
        new_rate=sets.new_rate,
    )
    alone = msgspec.structs.replace(config, association=association, finite_set=FiniteSetConfig())
    return MixtureSlam(_landmark_slam(alone, log), sets.particles)
