"""The map as a filter expects it: what it lets an associator ask."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.association import Expected
from kalmap.gaussian import Belief, NotPositiveError
from kalmap.kernels import candidates as kernel
from kalmap.models import SensorModel
from kalmap.records import Frame, Sightings, Why
from kalmap.slam.engines import Engine
from kalmap.slam.region import LandmarkIndex

_HIDING_WIDTH = 0.6  # m: a trunk, a person; what is seen may hide what is within half of this of its ray
_HIDING_DEPTH = 1.0  # m behind what is seen, so that a landmark does not hide itself


class PredictedMap:
    """See `kalmap.association.Predicted`. A view of the filter at the frame's time, good for that frame only."""

    __slots__ = (
        "_belief",
        "_engine",
        "_index",
        "_noises",
        "_sensor",
        "_sensor_pose",
        "_sightings",
        "_z",
        "explain",
    )

    def __init__(
        self,
        engine: Engine,
        belief: Belief,
        sensor: SensorModel,
        index: LandmarkIndex,
        sightings: Sightings,
        noises: np.ndarray,
        explain: bool = False,
    ) -> None:
        self._engine, self._belief, self._sensor, self._index = engine, belief, sensor, index
        self._sightings, self._z, self._noises = sightings, sightings.values, noises
        self.explain = explain
        self._sensor_pose: tuple[float, float, float] | None = None

    @property
    def count(self) -> int:
        """How many landmarks there are."""
        return (self._belief.n - self._belief.robot) // 2

    @property
    def sensor_pose(self) -> tuple[float, float, float]:
        """x m, y m and heading rad of the sensor in the map."""
        if self._sensor_pose is None:
            mount = getattr(self._sensor, "mount", (0.0, 0.0, 0.0))
            x, y, heading = self._belief.mean[:3].tolist()
            cosine, sine = math.cos(heading), math.sin(heading)
            self._sensor_pose = (
                x + cosine * mount[0] - sine * mount[1],
                y + sine * mount[0] + cosine * mount[1],
                heading + mount[2],
            )
        return self._sensor_pose

    @property
    def pose(self) -> np.ndarray:
        """(3,) the robot's predicted pose, a copy."""
        return self._belief.mean[:3].copy()

    @property
    def max_range(self) -> float:
        """How far the sensor sees, m; inf for one that does not say."""
        return float(getattr(self._sensor, "max_range", math.inf))

    @property
    def min_range(self) -> float:
        """Nearer than this the sensor sees nothing, m."""
        return float(getattr(self._sensor, "min_range", 0.0))

    @property
    def half_view(self) -> float:
        """Half the sensor's field of view, rad; pi for one that does not say."""
        return 0.5 * float(getattr(self._sensor, "field_of_view", 2.0 * math.pi))

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the robot's position along its widest axis, m."""
        p = self._belief.packed
        xx, xy, yy = float(p[0]), float(p[1]), float(p[2])
        return math.sqrt(max(0.0, 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)))

    def look(self, why: Why, ids: list[int]) -> Frame:
        """What was looked at, as the audit trail keeps it, before the frame changes anything.

        ids: lasting number of every landmark; it takes the place of the indices.
        """
        indices = np.unique(why.pairs[:, 1])
        belief, begin = self._belief, self._belief.robot + 2 * indices
        numbers = np.array([ids[i] for i in indices.tolist()], dtype=np.int64)
        pairs = why.pairs.copy()
        pairs[:, 1] = numbers[np.searchsorted(indices, pairs[:, 1])]
        expected, _, spreads = self._engine.expect(belief, begin)
        return Frame(
            number=0,
            time=self._sightings.time,
            pose=self.pose,
            sensor=np.array(self.sensor_pose),
            values=self._z.copy(),
            labels=np.zeros(len(self._z), dtype=np.int64),
            trial=np.zeros(len(self._z), dtype=np.bool_),
            why=msgspec.structs.replace(why, pairs=pairs),
            landmarks=numbers,
            positions=self.positions(indices),
            spreads=_in_the_plane(expected, spreads, self.sensor_pose[2]),
            noises=self._noises.copy(),
        )

    @property
    def noises(self) -> np.ndarray:
        """(M, 2, 2) the sensor's noise of each sighting."""
        return self._noises

    def positions(self, indices: np.ndarray) -> np.ndarray:
        """(K, 2) m, a copy."""
        begin = self._belief.robot + 2 * indices
        return np.stack([self._belief.mean[begin], self._belief.mean[begin + 1]], axis=1)

    def within(self, reach: float, front: float) -> np.ndarray:
        """Indices, ascending, of landmarks within `reach` m of the sensor and more than `front` m ahead of it."""
        return self._index.within(self._belief, self.sensor_pose, reach, front)

    def expect(self, indices: np.ndarray) -> Expected:
        """How these landmarks (C,) should look now."""
        return Expected(indices, *self._engine.expect(self._belief, self._belief.robot + 2 * indices))

    def distances(self, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
        """Mahalanobis distance squared and ln det S of every sighting with every candidate: two (M, C)."""
        return distances_between(self._z, self._noises, expected)

    def cross(self, expected: Expected) -> np.ndarray:
        """(C, C, 2, 2) covariances between the candidates' expected sightings, sensor noise left out."""
        belief, count = self._belief, len(expected.indices)
        out = np.empty((count, count, 2, 2))
        begin = belief.robot + 2 * expected.indices
        kernel.cross_blocks(belief.packed, belief.phi, begin, expected.matrices, out)
        own = np.arange(count)
        out[own, own] = expected.spreads
        return out

    def separations(self, first: np.ndarray, second: np.ndarray, extent: float) -> np.ndarray:
        """(K,) squared Mahalanobis distance of pairs of landmarks, `extent` m wide, from being one and the same."""
        belief, out = self._belief, np.empty(len(first))
        begin, other = belief.robot + 2 * first, belief.robot + 2 * second
        kernel.separations(belief.mean, belief.packed, begin, other, extent, out)
        return out

    def joint(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (2 K,) and covariance (2 K, 2 K) of landmarks."""
        begin = self._belief.robot + 2 * indices
        entries = np.stack([begin, begin + 1], axis=1).ravel()
        return self._belief.mean[entries], self._belief.block(entries)

    def hidden(self, expected: Expected) -> np.ndarray:
        """(C,) bool: something stands before the landmark, by the scan if the frame has one, else by its sightings."""
        out, scan = np.empty(len(expected.indices), dtype=np.bool_), self._sightings.scan
        if scan is None:
            kernel.hidden_by_sightings(self._z, expected.z, 0.5 * _HIDING_WIDTH, _HIDING_DEPTH, out)
        else:
            kernel.hidden_by_beams(scan.ranges, scan.bearings, expected.z, _HIDING_DEPTH, out)
        return out


def distances_between(z: np.ndarray, noises: np.ndarray, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
    """Mahalanobis distance squared and ln det S of sightings (M, 2) with candidates (C): two (M, C)."""
    shape = (len(z), len(expected.indices))
    squared, log_volume = np.empty(shape), np.empty(shape)
    if kernel.distances(z, noises, expected.z, expected.spreads, squared, log_volume):
        raise NotPositiveError("the innovation covariance is not positive definite")
    return squared, log_volume


def _in_the_plane(z: np.ndarray, spreads: np.ndarray, heading: float) -> np.ndarray:
    """(C, 2, 2) covariances of (range, bearing) as covariances of the point in the map's frame, to first order."""
    direction = z[:, 1] + heading
    cosine, sine, distance = np.cos(direction), np.sin(direction), z[:, 0]
    jacobian = np.stack([np.stack([cosine, -distance * sine], 1), np.stack([sine, distance * cosine], 1)], 1)
    turned = jacobian @ spreads @ np.swapaxes(jacobian, 1, 2)
    return 0.5 * (turned + np.swapaxes(turned, 1, 2))
