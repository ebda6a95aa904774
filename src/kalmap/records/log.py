"""A log: where it comes from, what moved, and an iterable of time-ordered events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from kalmap.records.config import RunConfig
from kalmap.records.events import Event


class Skipped(msgspec.Struct, frozen=True):
    """One bad record that a tolerant run passed over."""

    file: str
    record: int | str
    field: str
    problem: str


class Relations(msgspec.Struct, frozen=True):
    """Pairs of instants between which the true motion is known (Kuemmerle et al. 2009).

    first, second: (R,) s, stamps as the log itself printed them (`Scan.stamp`). poses: (R, 3) m, m, rad of the vehicle
    at `second` as seen from the vehicle at `first`.
    """

    first: np.ndarray
    second: np.ndarray
    poses: np.ndarray


class Reference(msgspec.Struct, frozen=True):
    """What is known from outside, to judge a result by. Never fed to an estimator.

    frame: "map" if it is in the estimate's own frame (start pose of the run), so that errors need no
        alignment; "other" if a rigid alignment must come first.
    point: (2,) m, the point of the vehicle (forward, left) that `positions` speak of; usually (0, 0).
    times: (K,) s; positions: (K, 2) m; headings: (K,) rad, NaN where unknown.
    landmark_ids: (N,) int64; landmarks: (N, 2) m. Without ids in the log, they are numbered from 0.
    kind: "truth", "gps", "batch", "survey" or "relations", as the reports name it.
    relations: motions between pairs of instants, where those are known instead of, or beside, positions.
    walls: (S, 4) m, true contours as segments from x, y to x, y, where the world is known.
    """

    frame: str = "map"
    kind: str = "truth"
    point: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(2))
    times: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    positions: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 2)))
    headings: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0))
    landmark_ids: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 2)))
    relations: Relations | None = None
    walls: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 4)))


class SightingTruth(msgspec.Struct, frozen=True):
    """Which landmark each sighting really was, from outside: for logs whose sightings do not carry it themselves.

    times: (K,) s, ascending; values: (K, 2) range m, bearing rad; ids: (K,) int64, 0 or more. A sighting of the log
    is one of these if it was made at the same time and lies near it (`kalmap.evaluation.sighting_identities`).
    """

    times: np.ndarray
    values: np.ndarray
    ids: np.ndarray


class Log(msgspec.Struct, frozen=True):
    """A log that can be iterated as often as wanted; each pass reads lazily from the start.

    name: short, for titles ("victoria-park", "mrclam-6-robot-3", "course-35").
    source: the path or world it came from.
    defaults: the settings that this vehicle and sensor class start from.
    open: yields the events in order of time. It is handed `skip`, a function that a reader calls with
        a `Skipped` for each bad record it passes over, or None: then a bad record raises `LogError`.
    references: what to compare with, the first one first.
    start: (3,) pose at the first event, in the map frame; start_covariance (3, 3).
    files: every file that the events depend on, for the manifest's data hash.
    settings: what the log itself was opened or simulated with, for the manifest (variant, robot, world, ...).
    truth_ids: True if `ids` of the sightings are the truth about association.
    false_ids: True if a sighting with id -1 is known to be no landmark (clutter, something that moves); False if -1
        only means that nobody says.
    sighting_truth: identities from outside, where the sightings carry none.
    """

    name: str
    source: str
    defaults: RunConfig
    open: Callable[[Callable[[Skipped], None] | None], Iterator[Event]]
    references: tuple[Reference, ...] = ()
    start: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(3))
    start_covariance: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((3, 3)))
    files: tuple[str, ...] = ()
    truth_ids: bool = True
    false_ids: bool = False
    sighting_truth: SightingTruth | None = None
    settings: dict[str, Any] = msgspec.field(default_factory=dict)

    def __iter__(self) -> Iterator[Event]:
        return self.open(None)
