"""Scans that are stamped later than they were taken, or earlier: the odometry of the time when they were.

A driver stamps a scan when it has it, and an odometry when it reads it; a tenth of a second between the two clocks is
usual, and at 2 rad/s it is 11 degrees. The vehicle of a contour map is where it was when the scan was taken: `latency`
seconds before the stamp. Its motion from scan to scan is that of the odometry so many seconds earlier, and
what the latency is, the map estimates (as the time offset of a camera and an inertial unit, Li & Mourikis 2014).
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose, exponential, inverse, logarithm, rotate
from kalmap.models.motion import BuiltInMotion
from kalmap.records import Odometry

MOST = 0.5
"""s, beyond which no latency is believed."""
KEPT = 2.0
"""s, how far back the odometry is kept."""
LEAST_SPAN = 0.1
"""s, over which a speed is taken at least: stamps come early and late by some hundredths."""

_Part = tuple[
    np.ndarray, float, np.ndarray | None
]  # increment (3,), duration s, covariance (3, 3) where it is stated


class Late(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The newest odometry, as rows between instants of a clock that counts its durations.

    begins, ends: (K,) s. ways: (K, 3) twists m, m, rad that lead from each row's beginning to its end. covariances:
    (K, 3, 3), NaN where the log states none. now: s.
    """

    begins: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    ends: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    ways: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3)))
    covariances: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3, 3)))
    now: float = 0.0

    def after(self, event: Odometry, motion: BuiltInMotion) -> Late:
        """With an event behind the others. Samples without a duration are no part of it."""
        begins, ends, ways, covariances = [], [], [], []
        now = self.now
        for k, (values, duration) in enumerate(zip(event.values, event.durations.tolist(), strict=True)):
            if duration > 0.0:
                begins.append(now)
                now += duration
                ends.append(now)
                ways.append(logarithm(motion.increment(values, np.zeros(0), duration)))
                stated = None if event.covariance is None else event.covariance[k]
                three = stated is not None and stated.shape == (3, 3)
                covariances.append(stated if three else np.full((3, 3), np.nan))
        if not begins:
            return self
        kept = self.ends > now - KEPT
        return Late(
            np.concatenate([self.begins[kept], begins]),
            np.concatenate([self.ends[kept], ends]),
            np.concatenate([self.ways[kept], ways]),
            np.concatenate([self.covariances[kept], covariances]),
            now,
        )

    def twist(self, instant: float, span: float = LEAST_SPAN) -> np.ndarray:
        """(3,) m/s, m/s, rad/s of the vehicle at an instant of the clock, on the average of `span` s about then."""
        if not len(self.ends):
            return np.zeros(3)
        span = max(span, LEAST_SPAN)
        end = min(instant + 0.5 * span, self.now)
        way = np.zeros(3)
        for increment, _, _ in self._parts(end - span, end):
            way = compose(way, increment)
        return np.asarray(logarithm(way) / span)

    def _parts(self, start: float, end: float) -> list[_Part]:
        """What of every row lies between two instants. Before the first row the vehicle stood."""
        parts = []
        first = int(np.searchsorted(self.ends, start, side="right"))
        for begin, stop, way, covariance in zip(
            self.begins[first:], self.ends[first:], self.ways[first:], self.covariances[first:], strict=True
        ):
            if begin >= end:
                break
            share = (min(end, stop) - max(start, begin)) / (stop - begin)
            stated = None if np.isnan(covariance[0, 0]) else share * covariance
            parts.append((exponential(share * way), share * (stop - begin), stated))
        return parts


def shifted(
    before: Late, after: Late, event: Odometry, latency: float, motion: BuiltInMotion
) -> tuple[Odometry, np.ndarray]:
    """The odometry from one moment `latency` s ago to the next, and what a second more of latency would change of it.

    before, after: what is known without the event and with it. The latter is (3,) m, m, rad in the vehicle's frame as
    it was before the event. Where scans are taken after their stamps the speed is thought to stay as it is.
    """
    latency = min(max(latency, -MOST), MOST)
    start, end = before.now - latency, after.now - latency
    if after is before:
        return event, np.zeros(3)
    if latency > 0.0:
        moved = _merged(after._parts(start, end), event, motion)
        first, last = after.twist(start), after.twist(end)
    else:
        first, last = before.twist(before.now), after.twist(after.now)
        moved = _ahead(event, -latency * first, -latency * last) if latency < 0.0 else event
    way = np.zeros(3)
    for values, duration in zip(moved.values, moved.durations.tolist(), strict=True):
        way = compose(way, motion.increment(values, np.zeros(0), duration))
    swept = first[:2] + first[2] * np.array([-way[1], way[0]])
    effect = np.array([*(swept - rotate(way[2], last[:2])), first[2] - last[2]])
    return moved, effect


def _ahead(event: Odometry, before: np.ndarray, after: np.ndarray) -> Odometry:
    """The event's way from a little after its start to as long after its end; twists (3,) m, m, rad of the two."""
    way = inverse(exponential(before))
    for values in event.values:
        way = compose(way, values)
    covariance = None if event.covariance is None else event.covariance.sum(axis=0)[None]
    return msgspec.structs.replace(
        event,
        values=compose(way, exponential(after))[None],
        durations=np.array([event.durations.sum()]),
        covariance=covariance,
    )


def _merged(parts: list[_Part], event: Odometry, motion: BuiltInMotion) -> Odometry:
    """Parts as one event: those in a row whose covariance nobody states are one sample."""
    rows: list[_Part] = []
    for increment, duration, stated in parts:
        if rows and stated is None and rows[-1][2] is None:
            increment, duration = compose(rows[-1][0], increment), rows.pop()[1] + duration
        rows.append((increment, duration, stated))
    covariance = None
    if any(stated is not None for _, _, stated in rows):
        covariance = np.array(
            [motion.control_covariance(way, took) if stated is None else stated for way, took, stated in rows]
        )
    values = np.array([row[0] for row in rows], dtype=float).reshape(-1, 3)
    durations = np.array([row[1] for row in rows], dtype=float)
    return msgspec.structs.replace(event, values=values, durations=durations, covariance=covariance)


def speaks_of_time(event: Odometry) -> bool:
    """Whether the samples are finite and say how long they took."""
    finite = np.isfinite(event.values).all() and np.isfinite(event.durations).all()
    return bool(finite and (event.durations >= 0.0).all() and math.fsum(event.durations.tolist()) > 0.0)
