"""The seam between filter and data association.

An associator never sees the filter: it is handed the frame and a `Predicted` map to question, keeps what it
wants to remember in a memory of its own, and answers with an `Association`.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from kalmap.records import Association, Sightings


class Predicted(Protocol):
    """The map as the filter expects it at the frame's time; computed when asked."""

    @property
    def count(self) -> int:
        """How many landmarks there are; indices run from 0."""
        ...

    @property
    def positions(self) -> np.ndarray:
        """(N, 2) m."""
        ...

    def innovations(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mahalanobis distance squared and ln det S of every sighting with every candidate: two (M, C)."""
        ...

    def in_view(self, margin: float) -> np.ndarray:
        """(N,) bool: landmarks that the sensor should see now; the margin shrinks its view by that share."""
        ...


class Associator(Protocol):
    """Decides which landmark each sighting of a frame belongs to."""

    @property
    def uses_ids(self) -> bool:
        """Whether it goes by the log's identities: then landmarks carry them, and there is nothing to score."""
        ...

    def start(self) -> Any:
        """A fresh memory: what the associator carries from frame to frame. Made of plain dicts and lists."""
        ...

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> tuple[Association, Any]:
        """Decide a frame. `matched` may name a landmark that the same frame founds (index count, count + 1, ...)."""
        ...
