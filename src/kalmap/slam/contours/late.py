"""Scans that are stamped later than they were taken, or earlier: the odometry of the time when they were.

A driver stamps a scan when it has it, and an odometry when it reads it; a tenth of a second between the two is usual,
and at 2 rad/s it is 11 degrees. The vehicle of a contour map is where it was when scans were taken: `latency` seconds
before their stamps, by the odometry's clock. What the latency is, the map estimates (as Li & Mourikis 2014 do for a
camera and an inertial unit).
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose, exponential, inverse, logarithm, rotate
from kalmap.models.motion import BuiltInMotion
from kalmap.records import Odometry
from kalmap.slam.engines import BadSampleError

MOST = 0.5
"""s, beyond which no latency is believed."""
KEPT = 2.0
"""s, how far back the odometry is kept."""
SPAN = 0.1
"""s, over which a speed is taken at least: stamps come early and late by some hundredths."""
INSTANT = 1e-4
"""s: odometry that takes less, or says nothing of how long it took, has no speed."""


class Late(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The newest odometry, K rows by its stamps, and up to where it has been handed on.

    begins, ends: (K,) s. poses: (K, 3) of the vehicle at the beginnings, in some fixed frame; ways: (K, 3) twists m, m,
    rad that lead from there to the ends. covariances: (K, 3, 3) of the ways. now: s, the last stamp; NaN before the
    first. told: s, the stamp up to which the filter has moved, less the latency.
    """

    begins: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    ends: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    poses: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3)))
    ways: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3)))
    covariances: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 3, 3)))
    now: float = math.nan
    told: float = math.nan

    def after(self, event: Odometry, motion: BuiltInMotion) -> Late:
        """With an event's samples laid between the last stamp and its own; they must take more than an `INSTANT`."""
        took = float(event.durations.sum())
        begin = event.time - took if math.isnan(self.now) else max(self.now, event.time - took)
        edges = np.concatenate([[0.0], np.cumsum(event.durations)]) * ((event.time - begin) / took)
        pose = self.position(self.now) if len(self.ends) else np.zeros(3)
        poses, ways, covariances = [], [], []
        for k, (values, duration) in enumerate(zip(event.values, event.durations.tolist(), strict=True)):
            step = motion.increment(values, np.zeros(0), duration)
            poses.append(pose)
            ways.append(logarithm(step))
            pose = compose(pose, step)
            stated = None if event.covariance is None else event.covariance[k]
            own = (
                stated
                if stated is not None and len(stated) == 3
                else motion.control_covariance(values, duration)
            )
            covariances.append(own if own.shape == (3, 3) else np.zeros((3, 3)))
        kept = self.ends > (-np.inf if math.isnan(self.now) else self.now - KEPT)
        return Late(
            np.concatenate([self.begins[kept], begin + edges[:-1]]),
            np.concatenate([self.ends[kept], begin + edges[1:]]),
            np.concatenate([self.poses[kept], np.array(poses)]),
            np.concatenate([self.ways[kept], np.array(ways)]),
            np.concatenate([self.covariances[kept], np.array(covariances)]),
            event.time,
            begin if math.isnan(self.told) else self.told,
        )

    def position(self, instant: float) -> np.ndarray:
        """(3,) the vehicle at an instant. Before the first row it stood; after the last it goes on as it went."""
        if not len(self.ends):
            return np.zeros(3)
        last = len(self.ends) - 1
        row = last if instant >= self.now else int(np.searchsorted(self.ends, instant))
        begin, end = float(self.begins[row]), float(self.ends[row])
        share = min(max((instant - begin) / (end - begin), 0.0), 1.0) if end > begin else 1.0
        pose = compose(self.poses[row], exponential(share * self.ways[row]))
        if instant > self.now:
            pose = compose(pose, exponential((instant - self.now) * self.twist(self.now)))
        return np.asarray(pose)

    def twist(self, instant: float, span: float = SPAN) -> np.ndarray:
        """(3,) m/s, m/s, rad/s of the vehicle at an instant, on the average of `span` s about then."""
        if not len(self.ends):
            return np.zeros(3)
        span = max(span, SPAN)
        end = min(instant + 0.5 * span, self.now)
        way = compose(inverse(self.position(end - span)), self.position(end))
        return np.asarray(logarithm(way) / span)

    def noise(self, start: float, end: float) -> np.ndarray:
        """(3, 3) m^2, m^2, rad^2, of the way between two instants: of each row the share that lies there."""
        lengths = np.maximum(self.ends - self.begins, 1e-12)
        shares = (np.minimum(self.ends, end) - np.maximum(self.begins, start)) / lengths
        return np.asarray(np.einsum("k,kij->ij", np.clip(shares, 0.0, 1.0), self.covariances))


def moved(
    before: Late, after: Late, stamp: float, latency: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The way (3,) from where the filter is to where the vehicle was `latency` s before a stamp, and its covariance.

    before, after: what is known without the newest odometry and with it; where the filter is it has by the former. Also
    (3,) m, m, rad in the vehicle's frame: what a second more of latency would change of the way.
    """
    kept = min(max(latency, -MOST), MOST)
    start, end = before.told - kept, stamp - kept
    way = compose(inverse(before.position(start)), after.position(end))
    covariance = after.noise(min(start, before.now), min(end, after.now))
    if kept != latency:
        return way, covariance, np.zeros(3)
    first, last = before.twist(start), after.twist(end)
    swept = first[:2] + first[2] * np.array([-way[1], way[0]])
    return way, covariance, np.array([*(swept - rotate(way[2], last[:2])), first[2] - last[2]])


def check_samples(event: Odometry) -> None:
    """Raise BadSampleError unless the samples are finite and none takes less than no time."""
    finite = np.isfinite(event.values).all() and np.isfinite(event.durations).all()
    if not finite or (event.durations < 0.0).any():
        raise BadSampleError("an odometry sample is not finite or has a negative duration")
    if event.covariance is not None and not np.isfinite(event.covariance).all():
        raise BadSampleError("the covariance of an odometry sample is not finite")


class Clock:
    """Hands a filter the odometry of the time when scans were taken.

    Without a latency the events are handed on as they are. Odometry that takes no time, as across a jump of the clock,
    is handed on at once, with all that was still to come.
    """

    def __init__(self, motion: BuiltInMotion) -> None:
        self.motion = motion
        self.late = Late()

    def shifted(self, event: Odometry, latency: float) -> tuple[Odometry, np.ndarray, Late]:
        """The odometry up to the event's stamp less the latency, the latency's effect (3,), and what is known then.

        Raises BadSampleError for an event that cannot be used.
        """
        check_samples(event)
        late = self.late
        if not len(event.values):
            return event, np.zeros(3), late
        if float(event.durations.sum()) < INSTANT or event.time <= late.now:
            return self._at_once(event, latency), np.zeros(3), Late()
        after = late.after(event, self.motion)
        before = msgspec.structs.replace(late, told=after.told) if math.isnan(late.told) else late
        way, covariance, effect = moved(before, after, event.time, latency)
        after = msgspec.structs.replace(after, told=event.time)
        if latency == 0.0 and (math.isnan(late.now) or late.told == late.now):
            return event, effect, after
        return _event(event, way, covariance), effect, after

    def up_to(self, stamp: float, latency: float) -> tuple[Odometry, np.ndarray, Late] | None:
        """The odometry up to a scan that is stamped after the last event, as far as it is known; None if it is not."""
        late = self.late
        stamp = min(stamp, late.now + max(latency, 0.0))
        if math.isnan(late.told) or not stamp > late.told:
            return None
        way, covariance, effect = moved(late, late, stamp, latency)
        event = Odometry(stamp, np.zeros((1, 3)), np.array([stamp - late.told]))
        return _event(event, way, covariance), effect, msgspec.structs.replace(late, told=stamp)

    def _at_once(self, event: Odometry, latency: float) -> Odometry:
        """An event behind all that is known and has not been handed on."""
        late = self.late
        if not len(late.ends) or latency == 0.0:
            return event
        way, covariance, _ = moved(late, late, late.now + latency, latency)
        given = event.covariance
        if given is None:
            given = np.array([self.motion.control_covariance(each, 0.0) for each in event.values])
        return msgspec.structs.replace(
            event,
            values=np.concatenate([way[None], event.values]),
            durations=np.concatenate([[0.0], event.durations]),
            covariance=np.concatenate([covariance[None], given]),
        )


def _event(event: Odometry, way: np.ndarray, covariance: np.ndarray) -> Odometry:
    """An event with one sample in the place of its own."""
    took = np.array([event.durations.sum()])
    return msgspec.structs.replace(event, values=way[None], durations=took, covariance=covariance[None])
