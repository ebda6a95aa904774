"""Records that can be used but hardly be true, and clocks that stutter: findings for `check_log`."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from kalmap.data.streams import FixStream, OdometryStream, ScanStream, SightingStream, Stream
from kalmap.records import SensorConfig

FASTEST = 50.0
"""m/s: no vehicle in a landmark log drives faster."""
GAP_PERIODS = 5.0
"""A gap is this many median periods long."""
JUMP = 600.0
"""s: a gap longer than this is a jump of the clock (fixes excepted: GPS may be gone for long)."""
SLACK = 4.0
"""Standard deviations of the sensor's noise that a sighting may lie beyond its reach or view."""
NAMED = 3
"""How many records of a finding are named."""


class Finding(msgspec.Struct, frozen=True):
    """Something to know about a stream. count: how many records. first: the first few, to look up."""

    severity: Literal["problem", "note"]
    stream: str
    what: str
    count: int
    first: tuple[str, ...] = ()


def implausible(name: str, stream: Stream, good: np.ndarray, sensor: SensorConfig) -> list[Finding]:
    """Findings among the good records of a stream: stamps, gaps, and values out of their limits."""
    findings = _clock(name, stream, good)
    if isinstance(stream, OdometryStream):
        findings += _odometry(name, stream, good)
    elif isinstance(stream, SightingStream):
        findings += _sightings(name, stream, good, sensor)
    elif isinstance(stream, ScanStream):
        blind = good & ~np.isfinite(stream.ranges).any(axis=1)
        findings += _among("note", name, "scan without any return", stream, blind, None)
    return findings


def _clock(name: str, stream: Stream, good: np.ndarray) -> list[Finding]:
    times = stream.times[good]
    rows = np.flatnonzero(good)
    steps = np.diff(times)
    findings = []
    if not isinstance(stream, SightingStream):
        # A frame of sightings is made of records of one stamp; elsewhere that is a stutter.
        again = np.zeros(len(good), dtype=bool)
        again[rows[1:][steps == 0]] = True
        findings += _among("note", name, "repeated time stamp", stream, again, stream.times)
    moving = steps[steps > 0]
    if not len(moving):
        return findings
    limit = GAP_PERIODS * float(np.median(moving))
    jumps = (steps > max(JUMP, limit)) & (not isinstance(stream, FixStream))
    for severity, what, where in (
        ("problem", "the clock jumps", jumps),
        ("note", f"gap of more than {GAP_PERIODS:g} periods ({limit:.4g} s)", (steps > limit) & ~jumps),
    ):
        at = np.flatnonzero(where)
        longest = at[np.argsort(-steps[at], kind="stable")][:NAMED]
        first = tuple(
            f"record {stream.records[rows[k]]}: {steps[k]:.4g} s from {times[k]:.13g} s" for k in longest
        )
        if len(at):
            findings.append(Finding(severity, name, what, len(at), first))  # type: ignore[arg-type]
    return findings


def _odometry(name: str, stream: OdometryStream, good: np.ndarray) -> list[Finding]:
    findings = []
    for column, field in enumerate(stream.names):
        values = stream.values[:, column]
        if field == "speed":
            fast = good & (np.abs(values) > FASTEST)
            findings += _among("problem", name, f"speed beyond {FASTEST:g} m/s", stream, fast, values)
        elif field == "steering":
            beyond = good & (np.abs(values) >= np.pi / 2)
            findings += _among("problem", name, "steering beyond a right angle", stream, beyond, values)
    if stream.names[0] == "dx" and stream.durations is not None:
        distance = np.hypot(stream.values[:, 0], stream.values[:, 1])
        far = good & (distance > FASTEST * stream.durations) & (stream.durations > 0)
        findings += _among("problem", name, f"movement faster than {FASTEST:g} m/s", stream, far, distance)
    return findings


def _sightings(name: str, stream: SightingStream, good: np.ndarray, sensor: SensorConfig) -> list[Finding]:
    seen = good if stream.empty is None else good & ~stream.empty
    ranges, bearings = stream.values.T
    with np.errstate(invalid="ignore"):
        blur = SLACK * np.hypot(sensor.sigma_range, sensor.sigma_range_ratio * sensor.max_range)
        far = seen & (ranges > sensor.max_range + blur)
        aside = np.abs((bearings + np.pi) % (2 * np.pi) - np.pi)
        half = sensor.field_of_view_deg / 2 + SLACK * sensor.sigma_bearing_deg
        outside = seen & (aside > np.deg2rad(half))
    reach = f"range beyond the sensor's {sensor.max_range:g} m"
    view = f"bearing outside the field of view of {sensor.field_of_view_deg:g} deg"
    findings = [
        *_among("note", name, reach, stream, far, ranges),
        *_among("note", name, view, stream, outside, bearings),
    ]
    if stream.ids is None:
        return findings
    nameless = seen & (stream.ids < 0)
    findings += _among("note", name, "sighting without identity (id -1)", stream, nameless, None)
    frames = np.column_stack([stream.times, stream.ids])
    named = np.flatnonzero(seen & (stream.ids >= 0))
    _, first = np.unique(frames[named], axis=0, return_index=True)
    twice = np.zeros(len(good), dtype=bool)
    twice[np.delete(named, first)] = True
    return findings + _among("note", name, "identity twice in one frame", stream, twice, stream.ids)


def _among(
    severity: Literal["problem", "note"],
    name: str,
    what: str,
    stream: Stream,
    where: np.ndarray,
    values: np.ndarray | None,
) -> list[Finding]:
    """One finding for the records `where` is True, if there are any; `values` are quoted."""
    rows = np.flatnonzero(where)
    if not len(rows):
        return []
    first = tuple(
        f"record {stream.records[k]}" + ("" if values is None else f": {values[k]:.13g}")
        for k in rows[:NAMED]
    )
    return [Finding(severity, name, what, len(rows), first)]
