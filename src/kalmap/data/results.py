"""The result folder: trajectory, landmarks or contours, map, metrics and manifest, each written whole or not at all.

No file ever holds a NaN: estimates that are not finite are refused with a name, metrics and existence
probabilities that do not exist are null (JSON) or empty (CSV).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.data.contour_files import contours_csv, contours_geojson
from kalmap.data.files import csv_text, json_text, read_text, write_atomically
from kalmap.data.native_map import map_bytes
from kalmap.data.nav2 import map_yaml, pgm_bytes
from kalmap.data.trajectory_files import by_stamp, trajectory_csv, tum_text
from kalmap.records import (
    Estimate,
    EstimationError,
    JointTooLargeError,
    KalmapError,
    Landmarks,
    LogError,
    Manifest,
    OccupancyGrid,
    Trace,
    Trajectory,
)

MANIFEST = "manifest.json"
METRICS = "metrics.json"
TRAJECTORY_CSV = "trajectory.csv"
TRAJECTORY_TUM = "trajectory.tum"
ONLINE_CSV = "trajectory-online.csv"
LANDMARKS_CSV = "landmarks.csv"
LANDMARKS_GEOJSON = "landmarks.geojson"
CONTOURS_CSV = "contours.csv"
CONTOURS_GEOJSON = "contours.geojson"
MAP = "map.kalmap"
GRID_IMAGE, GRID_YAML = "map.pgm", "map.yaml"
# What some results hold and others do not.
_OPTIONAL = (
    ONLINE_CSV,
    LANDMARKS_CSV,
    LANDMARKS_GEOJSON,
    CONTOURS_CSV,
    CONTOURS_GEOJSON,
    GRID_IMAGE,
    GRID_YAML,
)

_LANDMARK_COLUMNS = ("id", "x", "y", "p_xx", "p_xy", "p_yy", "sightings", "existence")


def write_result(
    folder: Path | str,
    *,
    estimate: Estimate,
    trace: Trace,
    metrics: Mapping[str, Any],
    manifest: Manifest,
    grid: OccupancyGrid | None = None,
) -> dict[str, Path]:
    """Write all files of a result and return their paths by name.

    Where the estimate holds the whole drive as it is seen at the end, that is the trajectory, in the order of the log's
    own stamps, and what was said at the time is `trajectory-online.csv`. A map of contours has files of contours in
    place of those of landmarks. grid: adds it as Nav2 reads it. Files that an earlier result has left here and this one
    does not have are removed.

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
        **_trajectories(estimate, trace),
        **_map_files(estimate, grid),
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
    for name in _OPTIONAL:
        if name not in contents:
            (folder / name).unlink(missing_ok=True)
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


def write_contours(folder: Path, estimate: Estimate, provenance: dict[str, Any]) -> None:
    """Write a map of contours alone, as `write_result` does: csv, GeoJSON and the native map."""
    if estimate.contours is None:
        raise ValueError("the estimate holds no contours")
    contents = {
        CONTOURS_CSV: contours_csv(estimate.contours).encode(),
        CONTOURS_GEOJSON: contours_geojson(estimate.contours, estimate.time).encode(),
        MAP: map_bytes(estimate, provenance),
    }
    for name in (LANDMARKS_CSV, LANDMARKS_GEOJSON):  # of an earlier result
        (folder / name).unlink(missing_ok=True)
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


def _trajectories(estimate: Estimate, trace: Trace) -> dict[str, bytes]:
    """The drive as it is seen at the end, and as it was at the time where that differs."""
    online = Trajectory(trace.times, trace.poses, trace.covariances)
    final = online if estimate.trajectory is None else by_stamp(estimate.trajectory)
    contents = {TRAJECTORY_TUM: tum_text(final).encode(), TRAJECTORY_CSV: trajectory_csv(final).encode()}
    if estimate.trajectory is not None:
        contents[ONLINE_CSV] = trajectory_csv(online).encode()
    return contents


def _map_files(estimate: Estimate, grid: OccupancyGrid | None) -> dict[str, bytes]:
    """The map as other programs read it."""
    if estimate.contours is None:
        contents = {
            LANDMARKS_CSV: _landmarks_csv(estimate.landmarks).encode(),
            LANDMARKS_GEOJSON: _landmarks_geojson(estimate).encode(),
        }
    else:
        contents = {
            CONTOURS_CSV: contours_csv(estimate.contours).encode(),
            CONTOURS_GEOJSON: contours_geojson(estimate.contours, estimate.time).encode(),
        }
    if grid is not None:
        contents |= {GRID_IMAGE: pgm_bytes(grid), GRID_YAML: map_yaml(grid, GRID_IMAGE).encode()}
    return contents


def _check_finite(estimate: Estimate, trace: Trace) -> None:
    """Raise `EstimationError` that names the first number of a result that is not finite."""
    for course, where in ((trace, "trace"), (estimate.trajectory, "trajectory")):
        if course is not None:
            courses = {"time": course.times, "pose": course.poses, "covariance": course.covariances}
            _refuse_bad(courses, f"at {where} row", range(1, len(course.times) + 1))
    landmarks, contours = estimate.landmarks, estimate.contours
    places = {"position": landmarks.positions, "covariance": landmarks.covariances}
    _refuse_bad(places, "of landmark", landmarks.ids)
    if contours is not None:
        samples = {
            "position": contours.positions,
            "covariance": contours.covariances,
            "normal": contours.normals,
        }
        _refuse_bad(samples, "of sample", range(1, len(contours) + 1))


def _refuse_bad(named: Mapping[str, np.ndarray], where: str, numbers: Sequence[int] | np.ndarray) -> None:
    for name, values in named.items():
        bad = _bad_rows(values)
        if len(bad):
            place = f"{where} {numbers[bad[0]]}"
            raise EstimationError(f"the result cannot be saved: {name} {place} is not finite")


def _bad_rows(values: np.ndarray) -> np.ndarray:
    return np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))


def _landmarks_csv(landmarks: Landmarks) -> str:
    covariances = landmarks.covariances.reshape(-1, 4)[:, [0, 1, 3]]
    numbers = np.column_stack([landmarks.positions, covariances]).tolist()
    tails = zip(
        landmarks.ids.tolist(), numbers, landmarks.sightings.tolist(), _existence(landmarks), strict=True
    )
    rows = ([identity, *row, sightings, existence] for identity, row, sightings, existence in tails)
    return csv_text(_LANDMARK_COLUMNS, rows)


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


def _decode(path: Path, kind: Any) -> Any:
    try:
        return msgspec.json.decode(read_text(path), type=kind)
    except msgspec.MsgspecError as error:
        raise LogError(f"not what kalmap writes: {error}", file=path) from error


def _is_kalmap_manifest(path: Path) -> bool:
    try:
        content = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return False
    return str(content.get("format", "")).startswith("kalmap-manifest/")
