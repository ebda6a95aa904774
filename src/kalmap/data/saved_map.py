"""A map as a native map file holds it, and how its covariance is laid out there."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from kalmap.records import Contours, Estimate, EstimationError, Landmarks

JOINT = "lower triangle, row by row"
BLOCKS = "lower triangle of pose and biases, row by row, then xx, xy, yy of each landmark and sample"


class SavedMap(msgspec.Struct, frozen=True):
    """A map as it was saved: pose, biases, landmarks and samples of contours with their joint covariance.

    time: s. coordinates: "additive" or "invariant", as in `Estimate`.
    mean: (n,) pose (x m, y m, heading rad), biases, landmarks, samples (x, y each), n = 3 + B + 2 L + 2 N.
    packed: (n (n + 1) / 2,) the covariance's lower triangle, row by row; or, where `header["covariance"]` is
    `BLOCKS`, that of pose and biases and then (L + N) times xx, xy, yy.
    bias_names: B names. landmark_ids, landmark_sightings: (L,) int64; landmark_existence: (L,).
    provenance: what the writer said about where the map comes from. header: all of the file's header.
    contour_normals: (N, 2), contour_sightings, contour_runs: (N,) int64, as in `Contours`; None in a map of landmarks.
    """

    time: float
    coordinates: str
    mean: np.ndarray
    packed: np.ndarray
    bias_names: tuple[str, ...]
    landmark_ids: np.ndarray
    landmark_sightings: np.ndarray
    landmark_existence: np.ndarray
    provenance: dict[str, Any]
    header: dict[str, Any]
    contour_normals: np.ndarray | None = None
    contour_sightings: np.ndarray | None = None
    contour_runs: np.ndarray | None = None

    @property
    def has_joint(self) -> bool:
        """Whether the file holds the joint covariance, and not only its blocks."""
        return self.header.get("covariance") != BLOCKS

    def covariance(self) -> np.ndarray:
        """The joint covariance (n, n), dense and exactly symmetric. Raises `EstimationError` where it was not saved."""
        if not self.has_joint:
            raise EstimationError("the map was saved without its joint covariance")
        return unpack_lower(self.packed, len(self.mean))

    def estimate(self) -> Estimate:
        """The map as an `Estimate`, with arrays of its own. Its `joint` raises as `covariance` does."""
        first, mean = 3 + len(self.bias_names), self.mean.copy()
        whole = self.covariance() if self.has_joint else None
        head, blocks = self._parts() if whole is None else _parts_of(whole, first)
        positions = mean[first:].reshape(-1, 2)
        count = len(self.landmark_ids)
        landmarks = Landmarks(
            ids=self.landmark_ids.copy(),
            positions=positions[:count].copy(),
            covariances=blocks[:count],
            sightings=self.landmark_sightings.copy(),
            existence=self.landmark_existence.copy(),
        )
        deviations = np.sqrt(np.diagonal(head)[3:])
        biases = {
            name: (float(value), float(deviation))
            for name, value, deviation in zip(self.bias_names, mean[3:first], deviations, strict=True)
        }

        def joint() -> tuple[np.ndarray, np.ndarray]:
            return mean.copy(), self.covariance() if whole is None else whole.copy()

        return Estimate(
            time=self.time,
            pose=mean[:3].copy(),
            covariance=head[:3, :3].copy(),
            landmarks=landmarks,
            biases=biases,
            joint=joint,
            coordinates=self.coordinates,
            contours=self._contours(positions[count:], blocks[count:]),
        )

    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariance of pose and biases, and (L + N, 2, 2) of the positions, from a file of blocks."""
        first = 3 + len(self.bias_names)
        size = first * (first + 1) // 2
        blocks = self.packed[size:].reshape(-1, 3)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        return unpack_lower(self.packed[:size], first), blocks

    def _contours(self, positions: np.ndarray, covariances: np.ndarray) -> Contours | None:
        if self.contour_normals is None or self.contour_sightings is None or self.contour_runs is None:
            return None
        return Contours(
            positions=positions.copy(),
            covariances=covariances,
            normals=self.contour_normals.copy(),
            sightings=self.contour_sightings.copy(),
            runs=self.contour_runs.copy(),
        )


def pack_lower(covariance: np.ndarray) -> np.ndarray:
    """The lower triangle (n (n + 1) / 2,) of a symmetric matrix (n, n), row by row."""
    n = len(covariance)
    packed = np.empty(n * (n + 1) // 2)
    for row in range(n):
        start = row * (row + 1) // 2
        packed[start : start + row + 1] = covariance[row, : row + 1]
    return packed


def unpack_lower(packed: np.ndarray, n: int) -> np.ndarray:
    """The symmetric matrix (n, n) whose lower triangle was packed."""
    covariance = np.empty((n, n))
    for row in range(n):
        start = row * (row + 1) // 2
        covariance[row, : row + 1] = packed[start : start + row + 1]
        covariance[: row + 1, row] = covariance[row, : row + 1]
    return covariance


def _parts_of(covariance: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """The first rows and columns of a joint covariance, and the (.., 2, 2) blocks of positions on its diagonal."""
    rows = np.arange(first, len(covariance)).reshape(-1, 2)
    return covariance[:first, :first], covariance[rows[:, :, None], rows[:, None, :]]
