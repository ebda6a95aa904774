"""A local map: where its drive ended and its landmarks, jointly Gaussian, in the frame of its own start.

A local map begins at zero uncertainty where the one before it ended and shares no measurement with it, so the two
are independent (conditional independence, Paz, Tardos & Neira 2008). A map that was joined from others is again
one; it also says where each of them began.
"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.records import EstimationError


def _none() -> np.ndarray:
    return np.zeros((0, 3))


def _no_aliases() -> np.ndarray:
    return np.zeros((0, 2), dtype=np.int64)


class LocalMap(msgspec.Struct, frozen=True, eq=False):
    """A closed map. Nothing in it is ever changed.

    end: (3,) T_start_end, x m, y m, heading rad. ids, sightings: (N,) int64; landmarks: (N, 2) m, in the frame of
    the start. frames: (K, 3) T_start_part, where its second, third, ... part began. covariance: (n, n) of frames, end,
    landmarks in this order, n = 3 K + 3 + 2 N; None where the map is kept in information form.
    end_covariance: (3, 3), always there. parts: what it was joined from; empty for one that never was.
    squared, degrees: how far (Mahalanobis distance squared) the parts had to give way in all joins so far, and in how
    many dimensions. aliases: (A, 2) int64: each number that was dropped in a join -> the one that it was joined with.
    """

    end: np.ndarray
    ids: np.ndarray
    landmarks: np.ndarray
    sightings: np.ndarray
    covariance: np.ndarray | None
    end_covariance: np.ndarray
    frames: np.ndarray = msgspec.field(default_factory=_none)
    parts: tuple[Part, ...] = ()
    squared: float = 0.0
    degrees: int = 0
    aliases: np.ndarray = msgspec.field(default_factory=_no_aliases)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def size(self) -> int:
        """n: how many numbers its state has."""
        return 3 * len(self.frames) + 3 + 2 * len(self.ids)

    @property
    def mean(self) -> np.ndarray:
        """(n,) frames, end, landmarks; a copy."""
        return np.concatenate([self.frames.ravel(), self.end, self.landmarks.ravel()])

    @property
    def leaves(self) -> tuple[Part, ...]:
        """The maps that were never joined, in the order of the drive; its own only leaf is a map itself."""
        return self.parts or (Part(self, np.arange(len(self.ids))),)

    @property
    def starts(self) -> np.ndarray:
        """(K + 1, 3) T_start_part of all parts; the first is the identity."""
        return np.concatenate([np.zeros((1, 3)), self.frames])

    def dense(self) -> np.ndarray:
        """(n, n). Raises EstimationError where the map is kept in information form."""
        if self.covariance is None:
            raise EstimationError("a map in information form holds no joint covariance")
        return self.covariance


class Part(msgspec.Struct, frozen=True, eq=False):
    """A map that was never joined, inside one that was. rows: (N,) where the latter has each of its landmarks."""

    map: LocalMap
    rows: np.ndarray


def local_map(
    mean: np.ndarray, covariance: np.ndarray, ids: np.ndarray, sightings: np.ndarray | None = None
) -> LocalMap:
    """A map from the state of a filter that started at the origin: mean (3 + 2 N,), covariance, ids (N,).

    Raises EstimationError unless they are finite and fit together, NotPositiveError for a negative variance.
    """
    mean, covariance = np.asarray(mean, dtype=float), np.array(covariance, dtype=float)
    ids = np.asarray(ids, dtype=np.int64)
    n = 3 + 2 * len(ids)
    if mean.shape != (n,) or covariance.shape != (n, n) or len(np.unique(ids)) != len(ids):
        raise EstimationError(
            f"a local map of {len(ids)} landmarks needs {n} numbers and as many ids, each once; "
            f"not {mean.shape} and {covariance.shape}"
        )
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise EstimationError("a local map's mean or covariance is not finite")
    if (np.diagonal(covariance) < 0.0).any():
        raise NotPositiveError("a local map has a negative variance")
    covariance = 0.5 * (covariance + covariance.T)
    counts = np.ones(len(ids), dtype=np.int64) if sightings is None else np.asarray(sightings, dtype=np.int64)
    return LocalMap(
        end=mean[:3].copy(),
        ids=ids,
        landmarks=mean[3:].reshape(-1, 2).copy(),
        sightings=counts,
        covariance=covariance,
        end_covariance=covariance[:3, :3].copy(),
    )
