"""A log of scans made worse, as broken drivers and odd devices make it; what they disturb is a log like any other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import msgspec
import numpy as np

from kalmap.records import ConfigError, Event, Log, Odometry, Scan, Skipped

_BAD = (np.nan, np.inf, 0.0)
# m that two neighbours may differ and still be one surface, between which a further beam ends
_ONE_SURFACE = 0.1
_MOST_BEAMS = 100_000
# m, of a range to what is near
_COVER_NOISE = 0.005

_Skip = Callable[[Skipped], None] | None
_Change = Callable[[Event, np.random.Generator], Event | None]


def with_bad_ranges(log: Log, share: float, seed: int) -> Log:
    """The log with that share of all ranges replaced, a third each, by NaN, inf and zero.

    The same seed gives the same log. Raises ConfigError for no share.
    """
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"bad ranges: expected a share, 0 to 1, got {share:g}")
    return _changed(log, partial(_spoilt, share), seed, {"bad_ranges": {"share": share, "seed": seed}})


def with_beams(log: Log, count: int) -> Log:
    """The log with `count` beams in every scan, evenly over the angle that its own cover; one beam looks ahead.

    A new beam ends on the line between its neighbours where these are on one surface (0.1 m apart at most), and
    repeats the nearer one elsewhere. Scans without beams stay. Raises ConfigError for less than 1 or more than 100,000.
    """
    if not 1 <= count <= _MOST_BEAMS:
        raise ConfigError(f"beams: expected 1 to {_MOST_BEAMS}, got {count}")
    return _changed(log, partial(_respread, count), 0, {"beams": count})


def with_cover(log: Log, first_deg: float, last_deg: float, distance: float, seed: int) -> Log:
    """The log of a scanner before whose beams from first to last, deg, something is fixed at `distance`, m.

    It is measured with a noise of 5 mm. Raises ConfigError for a distance that is not positive, or what is not finite.
    """
    if not (np.isfinite([first_deg, last_deg, distance]).all() and distance > 0.0):
        raise ConfigError(
            f"cover: expected angles and a positive distance, got {first_deg:g}, {last_deg:g}, {distance:g}"
        )
    setting = {"first_deg": first_deg, "last_deg": last_deg, "distance": distance, "seed": seed}
    hidden = partial(_hidden, np.deg2rad(first_deg), np.deg2rad(last_deg), distance)
    return _changed(log, hidden, seed, {"cover": setting})


def without_odometry(log: Log) -> Log:
    """The log of a robot whose wheels say nothing."""
    return _changed(log, partial(_dropped, Odometry), 0, {"without": "odometry"})


def without_scans(log: Log) -> Log:
    """The log of a robot whose scanner says nothing."""
    return _changed(log, partial(_dropped, Scan), 0, {"without": "scans"})


def with_clock_jump(log: Log, at: float, by: float) -> Log:
    """The log with `by` s added to every time from `at` s on; where `by` is negative, times come twice.

    Raises ConfigError if either is not finite.
    """
    if not np.isfinite([at, by]).all():
        raise ConfigError(f"clock jump: expected finite times, got {at:g} and {by:g}")
    return _changed(log, partial(_later, at, by), 0, {"clock_jump": {"at": at, "by": by}})


def _changed(log: Log, change: _Change, seed: int, setting: dict[str, Any]) -> Log:
    opened = partial(_events, log.open, change, seed)
    return msgspec.structs.replace(log, open=opened, settings={**log.settings, **setting})


def _events(
    opened: Callable[[_Skip], Iterator[Event]], change: _Change, seed: int, skip: _Skip
) -> Iterator[Event]:
    rng = np.random.default_rng(seed)
    for event in opened(skip):
        changed = change(event, rng)
        if changed is not None:
            yield changed


def _spoilt(share: float, event: Event, rng: np.random.Generator) -> Event:
    if not isinstance(event, Scan):
        return event
    hit, which = rng.random((2, len(event.ranges)))
    bad = np.array(_BAD)[(len(_BAD) * which).astype(int)]
    return msgspec.structs.replace(event, ranges=np.where(hit < share, bad, event.ranges))


def _hidden(first: float, last: float, distance: float, event: Event, rng: np.random.Generator) -> Event:
    if not isinstance(event, Scan):
        return event
    seen = distance + _COVER_NOISE * rng.standard_normal(len(event.ranges))
    before = (event.bearings >= first) & (event.bearings <= last)
    return msgspec.structs.replace(event, ranges=np.where(before, seen, event.ranges))


def _respread(count: int, event: Event, rng: np.random.Generator) -> Event:
    if not isinstance(event, Scan) or not len(event.bearings):
        return event
    order = np.argsort(event.bearings, kind="stable")
    angles, ranges = event.bearings[order], event.ranges[order]
    middle = 0.5 * (angles[0] + angles[-1])
    wanted = np.linspace(angles[0], angles[-1], count) if count > 1 else np.array([middle])
    right = np.clip(np.searchsorted(angles, wanted), 1, max(1, len(angles) - 1)) % len(angles)
    left = np.maximum(right - 1, 0)
    width = angles[right] - angles[left]
    share = np.divide(wanted - angles[left], width, out=np.zeros(count), where=width > 0.0)
    spread = np.where(share < 0.5, ranges[left], ranges[right])
    known = np.isfinite(ranges[left]) & np.isfinite(ranges[right])
    step = np.subtract(ranges[right], ranges[left], out=np.full(count, np.inf), where=known)
    surface = np.abs(step) <= _ONE_SURFACE
    spread[surface] = ranges[left][surface] + share[surface] * step[surface]
    return msgspec.structs.replace(event, ranges=spread, bearings=wanted, intensities=None)


def _dropped(kind: type, event: Event, rng: np.random.Generator) -> Event | None:
    return None if isinstance(event, kind) else event


def _later(at: float, by: float, event: Event, rng: np.random.Generator) -> Event:
    return msgspec.structs.replace(event, time=event.time + by) if event.time >= at else event
