"""`map.kalmap`: kalmap's own map file, with the joint covariance, exact to the last bit.

The file is an uncompressed zip, as `.npz` is, of `header.json` and one `.npy` member an array. It is
read with `numpy.lib.format` and without pickle. Written twice from the same estimate and provenance,
the bytes are the same.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data.files import json_ready, write_atomically
from kalmap.records import Estimate, EstimationError, Landmarks, LogError

FORMAT = "kalmap-map"
VERSION = 1

_DTYPES = {
    "mean": "<f8",
    "covariance": "<f8",
    "landmark_ids": "<i8",
    "landmark_sightings": "<i8",
    "landmark_existence": "<f8",
}
# A joint covariance may be this asymmetric, relative to its largest variance, by rounding alone.
_ASYMMETRY = 1e-9
# What zipfile raises on damaged files; the last three where a broken entry asks for what it cannot do.
_DAMAGES = (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError, RuntimeError, zlib.error)


class SavedMap(msgspec.Struct, frozen=True):
    """A map as it was saved: pose, biases and landmarks with their joint covariance.

    time: s. coordinates: "additive" or "invariant", as in `Estimate`.
    mean: (n,) pose (x m, y m, heading rad), biases, landmarks (x, y each), n = 3 + B + 2 N.
    packed: (n (n + 1) / 2,) the covariance's lower triangle, row by row.
    bias_names: B names. landmark_ids, landmark_sightings: (N,) int64; landmark_existence: (N,).
    provenance: what the writer said about where the map comes from. header: all of the file's header.
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

    def covariance(self) -> np.ndarray:
        """The joint covariance (n, n), dense and exactly symmetric."""
        return unpack_lower(self.packed, len(self.mean))

    def estimate(self) -> Estimate:
        """The map as an `Estimate`, with arrays of its own."""
        mean, covariance = self.mean.copy(), self.covariance()
        first = 3 + len(self.bias_names)
        rows = first + 2 * np.arange(len(self.landmark_ids))[:, None] + np.arange(2)
        landmarks = Landmarks(
            ids=self.landmark_ids.copy(),
            positions=mean[rows],
            covariances=covariance[rows[:, :, None], rows[:, None, :]],
            sightings=self.landmark_sightings.copy(),
            existence=self.landmark_existence.copy(),
        )
        deviations = np.sqrt(np.diagonal(covariance)[3:first])
        biases = {
            name: (float(value), float(deviation))
            for name, value, deviation in zip(self.bias_names, mean[3:first], deviations, strict=True)
        }
        return Estimate(
            time=self.time,
            pose=mean[:3].copy(),
            covariance=covariance[:3, :3].copy(),
            landmarks=landmarks,
            biases=biases,
            joint=lambda: (mean.copy(), covariance.copy()),
            coordinates=self.coordinates,
        )


def write_map(path: Path | str, estimate: Estimate, provenance: dict[str, Any] | None = None) -> None:
    """Write an estimate as a native map file, all of it or nothing. See `map_bytes`."""
    write_atomically(Path(path), map_bytes(estimate, provenance))


def map_bytes(estimate: Estimate, provenance: dict[str, Any] | None = None) -> bytes:
    """The content of a native map file.

    provenance: anything JSON can hold: kalmap's version, the log, the configuration.
    The covariance's lower triangle is what is kept. Raises `EstimationError` if the joint mean or
    covariance is not finite, not symmetric or not of the size that biases and landmarks ask for.
    """
    mean, covariance = estimate.joint()
    landmarks = estimate.landmarks
    _check_joint(mean, covariance, 3 + len(estimate.biases) + 2 * len(landmarks))
    if not np.isfinite(estimate.time):
        raise EstimationError("the map cannot be saved: its time is not finite")
    header = {
        "format": f"{FORMAT}/{VERSION}",
        "coordinates": estimate.coordinates,
        "time": float(estimate.time),
        "units": {"length": "m", "angle": "rad", "time": "s"},
        "frame": "map",
        "order": "x, y, heading, biases, then x, y of each landmark",
        "covariance": "lower triangle, row by row",
        "biases": list(estimate.biases),
        "size": len(mean),
        "landmarks": len(landmarks),
        "provenance": json_ready(provenance or {}),
    }
    arrays = {
        "mean": mean,
        "covariance": pack_lower(covariance),
        "landmark_ids": landmarks.ids,
        "landmark_sightings": landmarks.sightings,
        "landmark_existence": landmarks.existence,
    }
    return _zip_bytes(header, arrays)


def read_map_file(path: Path | str) -> SavedMap:
    """Read a native map file.

    Raises `LogError`, naming the file and the part, if it is missing, is no kalmap map, is cut off or
    damaged, or was written in a newer format.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            header = _read_header(archive, path)
            arrays = {name: _read_array(archive, name, path) for name in _DTYPES}
    except FileNotFoundError as error:
        raise LogError("no such file", file=path) from error
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}", file=path) from error
    except _DAMAGES as error:
        raise LogError(f"not a kalmap map, or cut off or damaged: {error}", file=path) from error
    return _saved_map(header, arrays, path)


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


def _zip_bytes(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> bytes:
    """The file's content. Member dates are fixed, so that equal maps are equal files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("header.json"), msgspec.json.encode(header))
        for name, values in arrays.items():
            member = io.BytesIO()
            plain = np.ascontiguousarray(values, dtype=_DTYPES[name])
            np.lib.format.write_array(member, plain, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue())
    return stream.getvalue()


def _read_header(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    """The decoded header, of a format and version that this reader knows."""
    try:
        header = msgspec.json.decode(archive.read("header.json"), type=dict[str, Any])
    except KeyError as error:
        raise LogError("not a kalmap map: the zip file has no header.json", file=path) from error
    except msgspec.MsgspecError as error:
        raise LogError(f"not JSON: {error}", file=path, field="header.json") from error
    name, _, version = str(header.get("format", "")).partition("/")
    if name != FORMAT or not version.isdecimal():
        raise LogError(f"unknown format {header.get('format')!r}", file=path, field="format")
    if int(version) > VERSION:
        problem = f"written in format {version} by a newer kalmap; this one reads up to {VERSION}"
        raise LogError(problem, file=path, field="format")
    return header


def _read_array(archive: zipfile.ZipFile, name: str, path: Path) -> np.ndarray:
    """One member as a one-dimensional array of the type that the format fixes."""
    try:
        # Read whole, so that zipfile compares the checksum before anything is believed.
        member = io.BytesIO(archive.read(f"{name}.npy"))
        values = np.lib.format.read_array(member, allow_pickle=False)
    except KeyError as error:
        raise LogError("missing", file=path, field=name) from error
    except (ValueError, EOFError) as error:
        raise LogError(f"damaged: {error}", file=path, field=name) from error
    if values.dtype != np.dtype(_DTYPES[name]) or values.ndim != 1:
        problem = f"expected a row of {_DTYPES[name]}, found {values.dtype} {values.shape}"
        raise LogError(problem, file=path, field=name)
    return values


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
    count = len(arrays["landmark_ids"])
    n = 3 + len(names) + 2 * count
    lengths = {"mean": n, "covariance": n * (n + 1) // 2}
    for name, values in arrays.items():
        if len(values) != lengths.get(name, count):
            problem = f"expected {lengths.get(name, count)} numbers, found {len(values)}"
            raise LogError(problem, file=path, field=name)
    for name in ("mean", "covariance"):
        if not np.isfinite(arrays[name]).all():
            raise LogError("not finite", file=path, field=name)
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
    )
