"""What an estimator says: a frozen snapshot, and the trace of a whole run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from kalmap.records.contours import Contours, Sweeps, Trajectory
from kalmap.records.decisions import Why


class Landmarks(msgspec.Struct, frozen=True):
    """The landmarks of a map.

    ids: (N,) int64, the log's identity where association was known, else a running number from 0.
    positions: (N, 2) m. covariances: (N, 2, 2) m^2. sightings: (N,) int64, how often each was used.
    existence: (N,) probability that it is real; 1 where the method does not estimate it.
    """

    ids: np.ndarray
    positions: np.ndarray
    covariances: np.ndarray
    sightings: np.ndarray
    existence: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


class Estimate(msgspec.Struct, frozen=True):
    """A snapshot. Nothing in it changes when the estimator goes on.

    time: s. pose: (3,) x m, y m, heading rad; covariance: (3, 3).
    biases: name -> (value, standard deviation) of the constant errors estimated as states.
    landmarks: see `Landmarks`.
    joint: returns mean (n,) and covariance (n, n) of pose, biases and landmarks, in this order. A
        snapshot too: asked for after the estimator has moved on, it raises `EstimationError`.
    coordinates: "additive" or "invariant": the error that the covariance is consistent in.
    contours: the map of an estimator that maps contours from scans; None for one of landmarks.
    trajectory: the whole drive as it is seen now, loops closed, for every scan or frame; None where none is kept.
    sweeps: the scans that the map rests on, each where it is thought to be taken now; None where none are kept.
    counts: name -> what else the estimator has to tell in numbers (loops closed, local maps, ...), for the metrics.
    """

    time: float
    pose: np.ndarray
    covariance: np.ndarray
    landmarks: Landmarks
    biases: dict[str, tuple[float, float]]
    joint: Callable[[], tuple[np.ndarray, np.ndarray]]
    coordinates: str = "additive"
    contours: Contours | None = None
    trajectory: Trajectory | None = None
    sweeps: Callable[[], Sweeps] | None = None
    counts: dict[str, float] | None = None


class Trace(msgspec.Struct, frozen=True):
    """The course of a run, one row for each instant at which the estimator was asked (F rows).

    times: (F,) s. poses: (F, 3). covariances: (F, 3, 3).
    nis: (F,) normalised innovation squared of the frame, NaN where nothing was used; nis_dof: (F,) its
        degrees of freedom. landmarks: (F,) how many were in the map. sightings: (F,) how many were used.
    step_seconds: (S,) time that each odometry sample took; a frame's update counts to the sample before it.
    step_times: (S,) s, the end of each of these samples.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    landmarks: np.ndarray
    sightings: np.ndarray
    step_seconds: np.ndarray
    step_times: np.ndarray


def final_course(estimate: Estimate, trace: Trace) -> Trajectory:
    """The drive as it is seen at the end; where the estimator keeps none, as it was said at the time."""
    return estimate.trajectory or Trajectory(trace.times, trace.poses, trace.covariances)


class Association(msgspec.Struct, frozen=True, gc=False):
    """What an associator decided about one frame.

    matched: (M,) int64: the landmark's index in the map, `NEW` (found one) or `SPURIOUS` (leave unused).
    on_trial: the landmarks that this frame founds stay out of the map and correct nothing until they are confirmed.
    confirmed, retired: indices of landmarks that the associator now believes in, or wants removed.
    merged: (kept, dropped) indices of landmarks that are one and the same.
    change: what its memory takes in once the filter has carried this out; nobody else's business.
    why: the reasons, if they were asked for.
    """

    matched: np.ndarray
    on_trial: bool = False
    confirmed: tuple[int, ...] = ()
    retired: tuple[int, ...] = ()
    merged: tuple[tuple[int, int], ...] = ()
    change: Any = None
    why: Why | None = None


NEW = -1
SPURIOUS = -2


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What a result was made from and how: saved as `manifest.json` beside it."""

    format: str = "kalmap-manifest/1"
    kalmap: str
    python: str
    platform: str
    packages: dict[str, str]
    command: str
    log: str
    source: str
    data_sha256: dict[str, str]
    seed: int
    config: Any
    log_settings: Any = None
    started: str
    finished: str
    completed: bool
    interrupted: bool
    error: str | None
    skipped: list[dict[str, Any]]
    skipped_total: int
