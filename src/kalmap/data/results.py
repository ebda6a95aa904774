"""The result folder: trajectory, landmarks, map, metrics and manifest, each written whole or not at all.

No file ever holds a NaN: estimates that are not finite are refused with a name, metrics and existence
probabilities that do not exist are null (JSON) or empty (CSV).
"""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data.files import json_text, write_atomically
from kalmap.data.native_map import map_bytes
from kalmap.records import (
    Estimate,
    EstimationError,
    JointTooLargeError,
    KalmapError,
    Landmarks,
    LogError,
    Manifest,
    Trace,
    Trajectory,
)

MANIFEST = "manifest.json"
METRICS = "metrics.json"
TRAJECTORY_CSV = "trajectory.csv"
TRAJECTORY_TUM = "trajectory.tum"
LANDMARKS_CSV = "landmarks.csv"
LANDMARKS_GEOJSON = "landmarks.geojson"
MAP = "map.kalmap"

_TRAJECTORY_COLUMNS = ("time", "x", "y", "heading", "p_xx", "p_xy", "p_xt", "p_yy", "p_yt", "p_tt")
_LANDMARK_COLUMNS = ("id", "x", "y", "p_xx", "p_xy", "p_yy", "sightings", "existence")
_UPPER_3 = np.triu_indices(3)


def write_result(
    folder: Path | str,
    *,
    estimate: Estimate,
    trace: Trace,
    metrics: Mapping[str, Any],
    manifest: Manifest,
) -> dict[str, Path]:
    """Write all files of a result and return their paths by name.

    The folder is made if it is missing. Raises `KalmapError` if it holds files but no kalmap manifest,
    `EstimationError` if the trajectory or the map is not finite; then nothing has been written.

    While the files are being written the manifest says that the result is not complete. A map whose joint covariance
    is too large to be written goes without a native map; its landmarks have their own covariances.
    """
    folder = Path(folder)
    _check_finite(estimate, trace)
    provenance = {
        "kalmap": manifest.kalmap,
        "log": manifest.log,
        "source": manifest.source,
        "data_sha256": manifest.data_sha256,
        "seed": manifest.seed,
        "config": manifest.config,
    }
    contents = {
        TRAJECTORY_TUM: _tum(trace).encode(),
        TRAJECTORY_CSV: _trajectory_csv(trace).encode(),
        LANDMARKS_CSV: _landmarks_csv(estimate.landmarks).encode(),
        LANDMARKS_GEOJSON: _landmarks_geojson(estimate).encode(),
        METRICS: json_text(metrics).encode(),
    }
    with contextlib.suppress(JointTooLargeError):
        contents[MAP] = map_bytes(estimate, provenance)
    check_result_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if MAP not in contents:
        (folder / MAP).unlink(missing_ok=True)  # of an earlier result
    unfinished = msgspec.structs.replace(manifest, completed=False, error="writing the result was cut off")
    write_manifest(folder, unfinished)
    for name, content in contents.items():
        write_atomically(folder / name, content)
    write_manifest(folder, manifest)
    return {name: folder / name for name in (*contents, MANIFEST)}


def write_landmarks(folder: Path, estimate: Estimate, provenance: dict[str, Any]) -> None:
    """Write a map alone, as `write_result` does: csv, GeoJSON and the native map."""
    contents = {
        LANDMARKS_CSV: _landmarks_csv(estimate.landmarks).encode(),
        LANDMARKS_GEOJSON: _landmarks_geojson(estimate).encode(),
        MAP: map_bytes(estimate, provenance),
    }
    for name, content in contents.items():
        write_atomically(folder / name, content)


def check_result_folder(folder: Path | str) -> None:
    """Raise `KalmapError` unless a result may be written here.

    It may where there is nothing, an empty folder, or an earlier kalmap result. To be asked before a
    long run starts.
    """
    folder = Path(folder)
    if not folder.exists() and not folder.is_symlink():
        return
    if not folder.is_dir():
        raise KalmapError(f"{folder}: cannot hold a result, it is not a folder")
    if any(folder.iterdir()) and not _is_kalmap_manifest(folder / MANIFEST):
        raise KalmapError(f"{folder}: holds files that are no kalmap result; name another folder or empty it")


def write_manifest(folder: Path | str, manifest: Manifest) -> None:
    """Write `manifest.json` alone, into a folder that exists: for a run that ended without a result."""
    write_atomically(Path(folder) / MANIFEST, json_text(manifest).encode())


def read_manifest(folder: Path | str) -> Manifest:
    """Read a result folder's manifest. Raises `LogError` if it is missing or is no kalmap manifest."""
    return _decode(Path(folder) / MANIFEST, Manifest)


def read_metrics(folder: Path | str) -> dict[str, Any]:
    """Read a result folder's metrics. Raises `LogError` if they are missing or not a JSON object."""
    return _decode(Path(folder) / METRICS, dict[str, Any])


def read_trajectory_csv(path: Path | str) -> Trajectory:
    """Read a `trajectory.csv`, exactly as it was written.

    Raises `LogError`, naming file, row (the header is 1) and field, for what is not such a file.
    """
    path = Path(path)
    rows = _csv_rows(path, _TRAJECTORY_COLUMNS)
    table = np.array([_numbers(path, number, row) for number, row in rows]).reshape(-1, 10)
    covariances = np.empty((len(table), 3, 3))
    covariances[:, _UPPER_3[0], _UPPER_3[1]] = table[:, 4:]
    covariances[:, _UPPER_3[1], _UPPER_3[0]] = table[:, 4:]
    return Trajectory(times=table[:, 0].copy(), poses=table[:, 1:4].copy(), covariances=covariances)


def _check_finite(estimate: Estimate, trace: Trace) -> None:
    """Raise `EstimationError` that names the first number of a result that is not finite."""
    for name, values in (("time", trace.times), ("pose", trace.poses), ("covariance", trace.covariances)):
        bad = _bad_rows(values)
        if len(bad):
            raise EstimationError(
                f"the result cannot be saved: {name} at trace row {bad[0] + 1} is not finite"
            )
    landmarks = estimate.landmarks
    for name, values in (("position", landmarks.positions), ("covariance", landmarks.covariances)):
        bad = _bad_rows(values)
        if len(bad):
            identity = landmarks.ids[bad[0]]
            raise EstimationError(f"the result cannot be saved: {name} of landmark {identity} is not finite")


def _bad_rows(values: np.ndarray) -> np.ndarray:
    return np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))


def _tum(trace: Trace) -> str:
    """Time, position and unit quaternion of a rotation about z, as evo and the TUM tools read it."""
    half = 0.5 * trace.poses[:, 2]
    rows = zip(trace.times, trace.poses[:, 0], trace.poses[:, 1], np.sin(half), np.cos(half), strict=True)
    return "".join(f"{t:.9f} {x:.9g} {y:.9g} 0 0 0 {z:.9g} {w:.9g}\n" for t, x, y, z, w in rows)


def _trajectory_csv(trace: Trace) -> str:
    upper = trace.covariances[:, _UPPER_3[0], _UPPER_3[1]]
    return _csv_text(_TRAJECTORY_COLUMNS, np.column_stack([trace.times, trace.poses, upper]).tolist())


def _landmarks_csv(landmarks: Landmarks) -> str:
    covariances = landmarks.covariances.reshape(-1, 4)[:, [0, 1, 3]]
    numbers = np.column_stack([landmarks.positions, covariances]).tolist()
    tails = zip(
        landmarks.ids.tolist(), numbers, landmarks.sightings.tolist(), _existence(landmarks), strict=True
    )
    rows = ([identity, *row, sightings, existence] for identity, row, sightings, existence in tails)
    return _csv_text(_LANDMARK_COLUMNS, rows)


def _landmarks_geojson(estimate: Estimate) -> str:
    """A FeatureCollection in local metres, which it says: RFC 7946 itself would mean WGS84."""
    landmarks = estimate.landmarks
    columns: tuple[Sequence[Any], ...] = (
        landmarks.ids.tolist(),
        landmarks.positions.tolist(),
        landmarks.covariances.tolist(),
        landmarks.sightings.tolist(),
        _existence(landmarks),
    )
    features = [
        {
            "type": "Feature",
            "id": identity,
            "geometry": {"type": "Point", "coordinates": position},
            "properties": {"covariance": covariance, "sightings": sightings, "existence": existence},
        }
        for identity, position, covariance, sightings, existence in zip(*columns, strict=True)
    ]
    return json_text(
        {
            "type": "FeatureCollection",
            "coordinates_frame": "local metres",
            "time": estimate.time,
            "features": features,
        }
    )


def _existence(landmarks: Landmarks) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in landmarks.existence.tolist()]


def _csv_text(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Comma-separated text; `csv` writes floats with as many digits as bring them back exactly."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()


def _read_text(path: Path) -> str:
    """The file's text. Raises `LogError` if it cannot be read."""
    try:
        return path.read_bytes().decode()
    except FileNotFoundError as error:
        raise LogError("no such file", file=path) from error
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}", file=path) from error
    except UnicodeDecodeError as error:
        raise LogError("not a text file", file=path) from error


def _csv_rows(path: Path, columns: Sequence[str]) -> list[tuple[int, list[str]]]:
    """The rows below the header with their numbers in the file, all of them of the right length."""
    rows = [(number, row) for number, row in enumerate(csv.reader(io.StringIO(_read_text(path))), 1) if row]
    if not rows or tuple(rows[0][1]) != tuple(columns):
        raise LogError(f"expected the columns {','.join(columns)}", file=path, record=1)
    for number, row in rows[1:]:
        if len(row) != len(columns):
            raise LogError(f"expected {len(columns)} fields, found {len(row)}", file=path, record=number)
    return rows[1:]


def _numbers(path: Path, number: int, row: list[str]) -> list[float]:
    values = []
    for column, text in zip(_TRAJECTORY_COLUMNS, row, strict=True):
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise LogError(
                f"expected a finite number, found {text!r}", file=path, record=number, field=column
            )
        values.append(value)
    return values


def _decode(path: Path, kind: Any) -> Any:
    try:
        return msgspec.json.decode(_read_text(path), type=kind)
    except msgspec.MsgspecError as error:
        raise LogError(f"not what kalmap writes: {error}", file=path) from error


def _is_kalmap_manifest(path: Path) -> bool:
    try:
        content = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return False
    return str(content.get("format", "")).startswith("kalmap-manifest/")
