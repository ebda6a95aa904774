"""What the run loop asks of an estimator, whatever its family."""

from __future__ import annotations

import os
from typing import Protocol

import numpy as np

from kalmap.models import MotionModel, SensorModel
from kalmap.records import Estimate, Event, Frame, Sightings
from kalmap.slam.window import Revisions


class Slam(Protocol):
    """Landmark SLAM by the Kalman family or by random finite sets.

    labels: whether it says which landmark each sighting belongs to, without being told; then frame_labels (M,) are
    those of the last frame, and frame_revisions those that it revised. frame_nis: NaN where there is none;
    frame_used: how many sightings it is of. explain: keep the reasons of a frame's association in frame_decision.
    """

    explain: bool

    @property
    def numbers_per_sighting(self) -> int:
        """How many numbers of the NIS each sighting that is used brings."""
        ...

    @property
    def labels(self) -> bool: ...

    @property
    def frame_nis(self) -> float: ...

    @property
    def frame_used(self) -> int: ...

    @property
    def frame_sightings(self) -> Sightings | None: ...

    @property
    def frame_labels(self) -> np.ndarray: ...

    @property
    def frame_decision(self) -> Frame | None: ...

    @property
    def frame_revisions(self) -> Revisions: ...

    @property
    def association_seconds(self) -> float: ...

    @property
    def motion(self) -> MotionModel: ...

    @property
    def sensor(self) -> SensorModel: ...

    @property
    def time(self) -> float: ...

    @property
    def pose(self) -> np.ndarray: ...

    @property
    def pose_covariance(self) -> np.ndarray: ...

    @property
    def landmark_count(self) -> int: ...

    @property
    def frames_taken(self) -> int: ...

    @property
    def attribute_names(self) -> tuple[str, ...]:
        """Which attributes of sightings it reads."""
        ...

    def step(self, event: Event) -> None:
        """Take one event. One that cannot be used raises EventError and changes nothing."""
        ...

    def estimate(self) -> Estimate: ...

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """The labels of all frames so far, as they are seen now."""
        ...

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that it knows, so that a resumed run ends bit for bit like one that never stopped."""
        ...

    def twin(self) -> Slam:
        """A fresh estimator with the same settings."""
        ...
