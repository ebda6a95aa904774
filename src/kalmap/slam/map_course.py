"""How a map of random finite sets came about: where its landmarks were at some hundreds of instants."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.kernels import set_layout as layout
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.set_map import covariances

_INSTANTS = 200  # at least so many are kept of a run with as many frames, at most twice as many


class Mixture(msgspec.Struct, frozen=True, eq=False):
    """A mixture of C Gaussians. weights (C,): expected landmarks; means (C, 2) m; covariances (C, 2, 2) m^2."""

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray


class MapCourse(msgspec.Struct, frozen=True, eq=False):
    """The landmarks at K instants. times: (K,) s. places: K arrays (N_k, 2), m. mixture: the whole last map."""

    times: np.ndarray
    places: list[np.ndarray]
    mixture: Mixture


class CourseKeeper:
    """Keeps every frame's map at first, then every second one's, every fourth one's, so that there are never many."""

    def __init__(self, slam: FiniteSetSlam) -> None:
        self.slam = slam
        self.times: list[float] = []
        self.places: list[np.ndarray] = []
        self._stride = 1
        self._frames = 0

    def frame(self) -> None:
        """A frame has been taken."""
        self._frames += 1
        if (self._frames - 1) % self._stride:
            return
        self.times.append(self.slam.time)
        self.places.append(self.slam.landmark_places())
        if len(self.times) > 2 * _INSTANTS:
            self.times, self.places = self.times[::2], self.places[::2]
            self._stride *= 2

    def course(self) -> MapCourse:
        """What was kept, and the map as it is now."""
        rows = self.slam.map()
        mixture = Mixture(rows[:, layout.WEIGHT], rows[:, [layout.X, layout.Y]], covariances(rows))
        return MapCourse(np.array(self.times), list(self.places), mixture)
