"""What a sighting tells beside its place: size, brightness, colour, class."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from kalmap.records import ConfigError, EventError, Sightings

_UNSEEN = [0, 0.0]
_LEAST_VARIANCE = 1e-100  # where the noise is in proportion and the value is 0


class Attribute(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A further measurement that tells landmarks apart, as an extra likelihood beside the place.

    name: of the sightings' attribute. sigma, ratio: standard deviation of one measurement, absolute and as a
    share of the value (the variances add); a landmark's own value is the mean of its sightings. classes:
    instead, the values are labels (a colour, a kind) and a sighting shows its landmark's label, the first it
    was seen with, with probability `sure`.
    """

    name: str
    sigma: float = 0.1
    ratio: float = 0.0
    classes: bool = False
    sure: float = 0.95

    def __post_init__(self) -> None:
        if not (self.sigma >= 0.0 and self.ratio >= 0.0 and self.sigma + self.ratio > 0.0):
            raise ConfigError(
                f"association.attributes: {self.name}: sigma and ratio must be 0 or more, one of them more"
            )
        if not 0.5 < self.sure < 1.0:
            raise ConfigError(f"association.attributes: {self.name}: sure must lie between 0.5 and 1")

    def cost(self, known: list[list[float]], indices: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(M, C): -2 ln of the likelihood ratio of each value with each landmark, 0 where either is unknown.

        known: for every landmark [sightings, mean]. Squared deviations for measurements; for labels 0 where
        they agree and 2 ln(sure / (1 - sure)) where they do not.
        """
        table = np.array([known[i] for i in indices.tolist()], dtype=float).reshape(-1, 2)
        seen = table[None, :, 0] > 0
        usable = seen & np.isfinite(values)[:, None]
        if self.classes:
            penalty = 2.0 * math.log(self.sure / (1.0 - self.sure))
            return np.where(usable & (values[:, None] != table[None, :, 1]), penalty, 0.0)
        variance = self.sigma**2 + (self.ratio * table[:, 1]) ** 2
        variance = np.maximum(variance * (1.0 + 1.0 / np.maximum(table[:, 0], 1.0)), _LEAST_VARIANCE)
        with np.errstate(invalid="ignore"):
            return np.where(usable, (values[:, None] - table[None, :, 1]) ** 2 / variance, 0.0)

    def values(self, sightings: Sightings) -> np.ndarray:
        """(M,) of a frame. Raises EventError if the log does not have it."""
        found = (sightings.attributes or {}).get(self.name)
        if found is None or len(found) != len(sightings.values):
            there = ", ".join(sightings.attributes or {}) or "none"
            raise EventError(
                f"expected an attribute for each sighting; the log has {there}",
                time=sightings.time,
                field=self.name,
            )
        return np.asarray(found, dtype=float)

    def learn(self, known: list[list[float]], index: int, value: float) -> None:
        """Take one more value of a landmark in."""
        if math.isfinite(value):
            count, mean = known[index]
            if not self.classes or count == 0:
                mean += (value - mean) / (count + 1)
            known[index] = [count + 1, mean]

    def pool(self, known: list[list[float]], keep: int, drop: int) -> None:
        """Take in what is known of a landmark that turned out to be the same."""
        (count, mean), (more, other) = known[keep], known[drop]
        if count + more > 0:
            pooled = mean if self.classes and count else (count * mean + more * other) / (count + more)
            known[keep] = [count + more, pooled]


def unknown() -> list[Any]:
    """What is known of a landmark that has just been founded."""
    return list(_UNSEEN)
