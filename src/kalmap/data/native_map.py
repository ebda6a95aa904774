"""`map.kalmap`: kalmap's own map file, with the joint covariance, exact to the last bit.

See `map_archive` for the container, which is read without pickle. Written twice from the same estimate and provenance,
the bytes are the same. Version 1 holds landmarks; a map of contours is written as version 2, which adds the samples of
the contours behind the landmarks, and which may hold blocks in place of the joint covariance where that does not exist.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmap.data.files import json_ready, write_atomically
from kalmap.data.map_archive import Arrays, Header, archive_bytes, read_archive
from kalmap.data.saved_map import BLOCKS, JOINT, SavedMap, pack_lower
from kalmap.records import Contours, Estimate, EstimationError, LogError

FORMAT = "kalmap-map"
VERSION = 2

_DTYPES = {
    "mean": "<f8",
    "covariance": "<f8",
    "landmark_ids": "<i8",
    "landmark_sightings": "<i8",
    "landmark_existence": "<f8",
}
_CONTOUR_DTYPES = {"contour_normals": "<f8", "contour_sightings": "<i8", "contour_runs": "<i8"}
# A joint covariance may be this asymmetric, relative to its largest variance, by rounding alone.
_ASYMMETRY = 1e-9
# m, how far a sample's position and its place in the joint mean may be apart by rounding.
_APART = 1e-6


def write_map(path: Path | str, estimate: Estimate, provenance: dict[str, Any] | None = None) -> None:
    """Write an estimate as a native map file, all of it or nothing. See `map_bytes`."""
    write_atomically(Path(path), map_bytes(estimate, provenance))


def map_bytes(estimate: Estimate, provenance: dict[str, Any] | None = None) -> bytes:
    """The content of a native map file.

    provenance: anything JSON can hold: kalmap's version, the log, the configuration.
    The covariance's lower triangle is what is kept; of a map of contours whose `joint` raises `EstimationError`,
    because it is too large to have one, the blocks of pose and samples, and the header says why. Raises
    `EstimationError` if mean or covariance is not finite, not symmetric or not of the size that biases, landmarks and
    samples ask for.
    """
    if not np.isfinite(estimate.time):
        raise EstimationError("the map cannot be saved: its time is not finite")
    contours, landmarks = estimate.contours, estimate.landmarks
    mean, packed, told = _kept(estimate)
    header = {
        "format": f"{FORMAT}/{1 if contours is None else VERSION}",
        "coordinates": estimate.coordinates,
        "time": float(estimate.time),
        "units": {"length": "m", "angle": "rad", "time": "s"},
        "frame": "map",
        "order": "x, y, heading, biases, then x, y of each landmark",
        **told,
        "biases": list(estimate.biases),
        "size": len(mean),
        "landmarks": len(landmarks),
        "provenance": json_ready(provenance or {}),
    }
    arrays = {
        "mean": mean,
        "covariance": packed,
        "landmark_ids": landmarks.ids,
        "landmark_sightings": landmarks.sightings,
        "landmark_existence": landmarks.existence,
    }
    if contours is not None:
        header |= {"order": f"{header['order']}, then x, y of each sample", "contours": len(contours)}
        arrays |= _contour_arrays(contours, mean)
    return archive_bytes(header, arrays, _DTYPES | _CONTOUR_DTYPES)


def read_map_file(path: Path | str) -> SavedMap:
    """Read a native map file.

    Raises `LogError`, naming the file and the part, if it is missing, is no kalmap map, is cut off or
    damaged, or was written in a newer format.
    """
    path = Path(path)
    header, arrays = read_archive(path, _check_header, _expected)
    return _saved_map(header, arrays, path)


def _check_joint(mean: np.ndarray, covariance: np.ndarray, size: int) -> None:
    """Raise `EstimationError` unless mean and covariance are finite, symmetric and of this size."""
    if mean.shape != (size,) or covariance.shape != (size, size):
        raise EstimationError(
            f"the map cannot be saved: pose, biases and landmarks need {size} numbers, "
            f"the joint mean has shape {mean.shape} and the covariance {covariance.shape}"
        )
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise EstimationError("the map cannot be saved: its joint mean or covariance is not finite")
    largest = np.abs(np.diagonal(covariance)).max()
    if np.abs(covariance - covariance.T).max() > _ASYMMETRY * largest:
        raise EstimationError("the map cannot be saved: its joint covariance is not symmetric")


def _kept(estimate: Estimate) -> tuple[np.ndarray, np.ndarray, Header]:
    """The mean, what is kept of its covariance, and how the header calls that."""
    try:
        mean, covariance = estimate.joint()
    except EstimationError as error:
        if estimate.contours is None:
            raise
        return *_blocks(estimate), {"covariance": BLOCKS, "without_joint": str(error)}
    _check_joint(mean, covariance, 3 + len(estimate.biases) + 2 * _places(estimate))
    return mean, pack_lower(covariance), {"covariance": JOINT}


def _places(estimate: Estimate) -> int:
    """How many positions the map holds."""
    return len(estimate.landmarks) + (0 if estimate.contours is None else len(estimate.contours))


def _blocks(estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Mean, and what there is of its covariance without the joint one: see `BLOCKS`."""
    values = [value for value, _ in estimate.biases.values()]
    first = 3 + len(values)
    head = np.zeros((first, first))
    head[:3, :3] = estimate.covariance
    head[np.arange(3, first), np.arange(3, first)] = [
        deviation**2 for _, deviation in estimate.biases.values()
    ]
    maps = [each for each in (estimate.landmarks, estimate.contours) if each is not None]
    covariances = np.concatenate([each.covariances for each in maps])
    mean = np.concatenate([estimate.pose, values, *(each.positions.ravel() for each in maps)])
    if not (np.isfinite(mean).all() and np.isfinite(head).all() and np.isfinite(covariances).all()):
        raise EstimationError("the map cannot be saved: its mean or covariance is not finite")
    return mean, np.concatenate([pack_lower(head), covariances.reshape(-1, 4)[:, [0, 1, 3]].ravel()])


def _contour_arrays(contours: Contours, mean: np.ndarray) -> Arrays:
    count = len(contours)
    saved = mean[len(mean) - 2 * count :].reshape(-1, 2)
    if count and not np.abs(saved - contours.positions).max() <= _APART:
        raise EstimationError("the map cannot be saved: its samples are not where its joint mean has them")
    if not np.isfinite(contours.normals).all():
        raise EstimationError("the map cannot be saved: a normal is not finite")
    return {
        "contour_normals": contours.normals.ravel(),
        "contour_sightings": contours.sightings,
        "contour_runs": contours.runs,
    }


def _check_header(header: Header, path: Path) -> None:
    """Raise `LogError` unless the header is of a format and version that this reader knows."""
    name, _, version = str(header.get("format", "")).partition("/")
    if name != FORMAT or not version.isdecimal():
        raise LogError(f"unknown format {header.get('format')!r}", file=path, field="format")
    if int(version) > VERSION:
        problem = f"written in format {version} by a newer kalmap; this one reads up to {VERSION}"
        raise LogError(problem, file=path, field="format")
    if header.get("covariance", JOINT) not in (JOINT, BLOCKS):
        raise LogError(f"unknown layout {header['covariance']!r}", file=path, field="covariance")


def _expected(header: Header) -> dict[str, str]:
    """The arrays that a header promises."""
    return _DTYPES | (_CONTOUR_DTYPES if "contours" in header else {})


def _saved_map(header: dict[str, Any], arrays: dict[str, np.ndarray], path: Path) -> SavedMap:
    """Put the parts together and check that they fit each other."""
    names, time, coordinates = header.get("biases"), header.get("time"), header.get("coordinates")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise LogError("expected a list of names", file=path, field="biases")
    provenance = header.get("provenance", {})
    if not isinstance(provenance, dict):
        raise LogError("expected names and values", file=path, field="provenance")
    if not isinstance(time, int | float) or isinstance(time, bool):
        raise LogError("expected a number of seconds", file=path, field="time")
    if coordinates not in ("additive", "invariant"):
        raise LogError(f"unknown coordinates {coordinates!r}", file=path, field="coordinates")
    _check_lengths(header, arrays, len(names), path)
    for name in ("mean", "covariance", "contour_normals"):
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise LogError("not finite", file=path, field=name)
    normals = arrays.get("contour_normals")
    return SavedMap(
        time=float(time),
        coordinates=coordinates,
        mean=arrays["mean"],
        packed=arrays["covariance"],
        bias_names=tuple(names),
        landmark_ids=arrays["landmark_ids"],
        landmark_sightings=arrays["landmark_sightings"],
        landmark_existence=arrays["landmark_existence"],
        provenance=provenance,
        header=header,
        contour_normals=None if normals is None else normals.reshape(-1, 2),
        contour_sightings=arrays.get("contour_sightings"),
        contour_runs=arrays.get("contour_runs"),
    )


def _check_lengths(header: Header, arrays: Arrays, biases: int, path: Path) -> None:
    """Raise `LogError` unless all arrays are as long as each other and the header ask for."""
    landmarks, samples = len(arrays["landmark_ids"]), len(arrays.get("contour_runs", ()))
    first, places = 3 + biases, landmarks + samples
    n = first + 2 * places
    blocks = header.get("covariance") == BLOCKS
    lengths = {
        "mean": n,
        "covariance": first * (first + 1) // 2 + 3 * places if blocks else n * (n + 1) // 2,
        "contour_normals": 2 * samples,
        "contour_sightings": samples,
        "contour_runs": samples,
    }
    for name, values in arrays.items():
        if len(values) != lengths.get(name, landmarks):
            problem = f"expected {lengths.get(name, landmarks)} numbers, found {len(values)}"
            raise LogError(problem, file=path, field=name)
