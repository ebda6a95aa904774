"""A log made harder: false sightings among those that it has."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from kalmap.records import ConfigError, Event, Log, Scan, Sightings, Skipped

NO_LANDMARK = -1


def with_clutter(log: Log, mean: float, seed: int) -> Log:
    """The log with on average `mean` false sightings more in every frame, a Poisson number.

    They are uniform in range and bearing over what the log's sensor sees (its default settings), have id -1 and, of
    every attribute, the value of a sighting drawn from the frame (NaN in an empty one). The same seed gives the same
    log. Its default settings of sets expect so much more. Raises ConfigError for a mean below 0 or beyond 1000, and
    when the log turns out to hold scans.
    """
    if not 0.0 <= mean <= 1000.0:
        raise ConfigError(f"clutter: expected 0 to 1000 false sightings a frame, got {mean:g}")
    sensor = log.defaults.sensor
    depth, view = sensor.max_range - sensor.min_range, math.radians(sensor.field_of_view_deg)

    def disturbed(skip: Callable[[Skipped], None] | None) -> Iterator[Event]:
        rng = np.random.default_rng(seed)
        for event in log.open(skip):
            if isinstance(event, Scan):
                raise ConfigError(
                    "clutter: the log holds scans; false sightings can be added to sightings only"
                )
            if not isinstance(event, Sightings):
                yield event
                continue
            shares = rng.random((rng.poisson(mean), 2))
            false = np.column_stack([sensor.max_range - depth * shares[:, 0], view * (shares[:, 1] - 0.5)])
            yield _joined(event, false, rng)

    settings = {**log.settings, "clutter": {"mean": mean, "seed": seed}}
    sets = log.defaults.finite_set
    sets = msgspec.structs.replace(sets, clutter=sets.clutter + mean)
    defaults = msgspec.structs.replace(log.defaults, finite_set=sets)
    return msgspec.structs.replace(log, open=disturbed, settings=settings, defaults=defaults)


def _joined(frame: Sightings, false: np.ndarray, rng: np.random.Generator) -> Sightings:
    """The frame with false sightings in it, shuffled."""
    order = rng.permutation(len(frame.values) + len(false))
    changes: dict[str, Any] = {"values": np.concatenate([frame.values, false])[order]}
    if frame.ids is not None:
        ids = np.concatenate([frame.ids, np.full(len(false), NO_LANDMARK)])
        changes["ids"] = ids[order]
    if frame.covariance is not None:
        like = frame.covariance.mean(axis=0) if len(frame.covariance) else np.diag([1.0, 1.0])
        changes["covariance"] = np.concatenate([frame.covariance, np.tile(like, (len(false), 1, 1))])[order]
    if frame.attributes is not None:
        changes["attributes"] = {
            name: np.concatenate([values, _drawn(values, len(false), rng)])[order]
            for name, values in frame.attributes.items()
        }
    return msgspec.structs.replace(frame, **changes)


def _drawn(values: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    if not len(values):
        return np.full(count, np.nan)
    return np.asarray(rng.choice(values, count))
