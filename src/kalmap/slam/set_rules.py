"""From the settings of a finite-set filter to what its kernels read; and the rates that it learns as it goes."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.ellipses import chi_square_2
from kalmap.kernels import set_layout as layout
from kalmap.models import RangeBearing
from kalmap.records import ConfigError, FiniteSetConfig

INTENSITIES = ("rb-phd", "srckf-phd")
METHODS = (*INTENSITIES, "mh-fastslam", "pmb")
RINGS = 8
_LEAST = 1e-6  # a probability of 0 or 1, or no clutter at all, leaves nothing to weigh an exception with
_LEAST_CLUTTER = 1e-4  # false sightings a frame
_WORTH = 30.0  # features that the stated probability of detection counts as, in every ring
_WORTH_FRAMES = 10.0  # frames that the stated clutter counts as
_MEMORY = 0.995  # what a frame leaves of the weight of those before it

_WEIGHTINGS = {
    "empty": layout.EMPTY,
    "single-feature": layout.SINGLE_FEATURE,
    "single-cluster": layout.SINGLE_CLUSTER,
    "multi-feature": layout.MULTI_FEATURE,
}


class Rates(msgspec.Struct):
    """Probability of detection in rings of range, and false sightings a frame, learnt with an exponential memory.

    stated (RINGS,): probabilities of the settings; could, were (RINGS,): features that could be sighted and those
    that were; frames, false_: frames and sightings that no landmark explains. All hold
    what the settings state at first, and fall back to it where nothing comes.
    """

    stated: np.ndarray
    clutter: float
    could: np.ndarray
    were: np.ndarray
    frames: float
    false_: float

    def take(self, could: np.ndarray, were: np.ndarray, unexplained: float) -> None:
        """A frame's tallies (RINGS,), and how many of its sightings no landmark explains."""
        prior = (1.0 - _MEMORY) * _WORTH
        self.could = _MEMORY * self.could + prior + could
        self.were = _MEMORY * self.were + prior * self.stated + np.minimum(were, could)
        share = (1.0 - _MEMORY) * _WORTH_FRAMES
        self.frames = _MEMORY * self.frames + share + 1.0
        self.false_ = _MEMORY * self.false_ + share * self.clutter + unexplained

    @property
    def profile(self) -> np.ndarray:
        """(RINGS,) probability of detection."""
        return np.clip(self.were / self.could, _LEAST, 1.0 - _LEAST)

    @property
    def false_rate(self) -> float:
        """False sightings a frame."""
        return max(self.false_ / self.frames, _LEAST_CLUTTER)


def checked_config(config: FiniteSetConfig) -> FiniteSetConfig:
    """The settings. Raises ConfigError for one without a meaning, or a method that particles do not carry out."""
    if config.method not in METHODS:
        raise ConfigError(f"finite_set.method: {config.method} is none of {', '.join(METHODS)}")
    values = msgspec.structs.asdict(config)
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"finite_set.{name}: expected a finite number, got {value}")
    try:
        return msgspec.convert(values, FiniteSetConfig)
    except msgspec.ValidationError as problem:
        raise ConfigError(f"finite_set: {problem}") from problem


def rates_from_config(config: FiniteSetConfig) -> Rates:
    """The rates that the settings state."""
    far = config.detection if config.detection_far is None else config.detection_far
    stated = config.detection + (far - config.detection) * (np.arange(RINGS) + 0.5) / RINGS
    return Rates(
        stated,
        config.clutter,
        np.full(RINGS, _WORTH),
        _WORTH * stated,
        _WORTH_FRAMES,
        _WORTH_FRAMES * config.clutter,
    )


def rules_from_config(config: FiniteSetConfig, sensor: RangeBearing) -> np.ndarray:
    """The vector that the kernels read; `set_rates` fills what is learnt."""
    rules = np.zeros(layout.RULES)
    rules[layout.GATE] = chi_square_2(config.gate)
    rules[layout.PRUNE], rules[layout.MERGE] = config.prune, config.merge
    rules[layout.CAP], rules[layout.FEATURE] = config.cap, config.feature
    rules[layout.WEIGHTING] = weighting_of(config)
    rules[layout.MIN_RANGE], rules[layout.MAX_RANGE] = sensor.min_range, sensor.max_range
    rules[layout.HALF_VIEW] = 0.5 * sensor.field_of_view if sensor.field_of_view < 2.0 * math.pi else 4.0
    rules[layout.RINGS], rules[layout.DEPTH] = RINGS, config.occlusion
    rules[layout.BRANCHES] = config.branches
    return rules


def set_rates(rules: np.ndarray, rates: Rates, new_rate: float, sensor: RangeBearing) -> None:
    """Write the clutter's density and the share of new landmarks among what no landmark explains."""
    clutter = rates.false_rate
    rules[layout.CLUTTER_RATE] = clutter
    rules[layout.CLUTTER] = clutter / (
        (sensor.max_range - sensor.min_range) * min(sensor.field_of_view, 2.0 * math.pi)
    )
    rules[layout.BIRTH] = new_rate / (new_rate + clutter)


def weighting_of(config: FiniteSetConfig) -> int:
    """The kernels' number of a weighting. SRCKF-PHD's single feature is integrated by the cubature rule."""
    if config.method == "srckf-phd" and config.weighting == "single-feature":
        return layout.CUBATURE_FEATURE
    return _WEIGHTINGS[config.weighting or "multi-feature"]
