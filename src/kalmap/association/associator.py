"""The seam between filter and data association.

An associator never sees the filter: it is handed the frame and a `Predicted` map to question, keeps what it
wants to remember in a memory of its own, and answers with an `Association`.
"""

from __future__ import annotations

from typing import Any, Protocol

import msgspec
import numpy as np

from kalmap.records import Association, Sightings


class Expected(msgspec.Struct, frozen=True):
    """How candidate landmarks should look from where the robot is thought to be.

    indices: (C,) in the map. z: (C, 2) range m, bearing rad. matrices: (C, 2, 5) their regression matrices on
    the errors of (pose, landmark). spreads: (C, 2, 2) covariances of z, the sensor's noise left out.
    """

    indices: np.ndarray
    z: np.ndarray
    matrices: np.ndarray
    spreads: np.ndarray

    def take(self, columns: np.ndarray) -> Expected:
        """The chosen candidates, by column or by mask."""
        return Expected(self.indices[columns], self.z[columns], self.matrices[columns], self.spreads[columns])

    def widened(self, extent: float) -> Expected:
        """The same for things that are no points: from another side they seem to be about `extent` m elsewhere."""
        if extent <= 0.0:
            return self
        spreads = self.spreads.copy()
        spreads[:, 0, 0] += extent**2
        spreads[:, 1, 1] += (extent / np.maximum(self.z[:, 0], extent)) ** 2
        return Expected(self.indices, self.z, self.matrices, spreads)


class Predicted(Protocol):
    """The map as the filter expects it at the frame's time; computed when asked, for what is asked."""

    @property
    def count(self) -> int:
        """How many landmarks there are; indices run from 0."""
        ...

    @property
    def explain(self) -> bool:
        """Whether the association is to say why."""
        ...

    @property
    def sensor_pose(self) -> tuple[float, float, float]:
        """x m, y m, heading rad of the sensor in the map."""
        ...

    @property
    def max_range(self) -> float:
        """How far the sensor sees, m."""
        ...

    @property
    def min_range(self) -> float:
        """Nearer than this it sees nothing, m."""
        ...

    @property
    def half_view(self) -> float:
        """Half its field of view, rad."""
        ...

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the robot's position along its widest axis, m."""
        ...

    @property
    def noises(self) -> np.ndarray:
        """(M, 2, 2) noise of each sighting."""
        ...

    def positions(self, indices: np.ndarray) -> np.ndarray:
        """(K, 2) m."""
        ...

    def within(self, reach: float, front: float) -> np.ndarray:
        """Indices, ascending, of landmarks within `reach` m of the sensor and more than `front` m ahead of it."""
        ...

    def expect(self, indices: np.ndarray) -> Expected:
        """How these landmarks should look now."""
        ...

    def distances(self, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
        """Mahalanobis distance squared and ln det S of every sighting with every candidate: two (M, C)."""
        ...

    def cross(self, expected: Expected) -> np.ndarray:
        """(C, C, 2, 2) covariances between the candidates' expected sightings, sensor noise left out."""
        ...

    def separations(self, first: np.ndarray, second: np.ndarray, extent: float) -> np.ndarray:
        """(K,) squared Mahalanobis distance of pairs of landmarks, `extent` m wide, from being one and the same."""
        ...

    def joint(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (2 K,) and covariance (2 K, 2 K) of landmarks."""
        ...

    def hidden(self, expected: Expected) -> np.ndarray:
        """(C,) bool: something seen in this frame stands before the landmark."""
        ...


class Associator(Protocol):
    """Decides which landmark each sighting of a frame belongs to.

    `associate` changes nothing; once the filter has carried the decision out, `settle` brings the memory up to
    it. An associator may look back: see `kalmap.association.Mda`.
    """

    @property
    def uses_ids(self) -> bool:
        """Whether it goes by the log's identities: then landmarks carry them, and there is nothing to score."""
        ...

    def start(self) -> Any:
        """A fresh memory: what the associator carries from frame to frame. Made of plain dicts and lists."""
        ...

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> Association:
        """Decide a frame. `matched` may name a landmark that the same frame founds (index count, count + 1, ...)."""
        ...

    def settle(self, memory: Any, association: Association) -> None:
        """Bring the memory, in place, to the map after this decision."""
        ...

    def fits(self, memory: Any, count: int) -> bool:
        """Whether a memory speaks of exactly `count` landmarks."""
        ...
