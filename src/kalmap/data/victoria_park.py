"""ACFR Victoria Park: a car in a park, trees, 26 min (Guivant and Nebot, IEEE T-RA 17(3), 2001).

Variants: `ids` (detections with the identity of an off-line solution), `detections` (all of them,
without identity, with the trunk's diameter), `ascii` (the same from `measurements.dat`, with the
re-calibrated steering of `DRS.txt`) and `scans` (raw laser). Bearings in the files have pi / 2 straight
ahead. The MATLAB files count time from one clock, the ASCII files from 20.967 s later; each variant
keeps the clock of its files. The off-line solution's identities stand beside the other variants as
`Log.sighting_truth`, to judge an association by. It names 46860 of the 52974 detections; what the others
are (clutter, poor features) nobody says.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from kalmap.data import ute
from kalmap.data.blocks import Detector, StreamEvents
from kalmap.data.mat import cells, load_mat, matrix, vector
from kalmap.data.streams import (
    FixStream,
    Malformed,
    OdometryStream,
    ScanStream,
    SightingStream,
    Streams,
    find_faults,
    identities,
)
from kalmap.data.text import read_table, read_text
from kalmap.records import Log, LogError, Reference, SightingTruth

VARIANTS = ("ids", "detections", "ascii", "scans")
ODOMETRY, GPS = "aa3_dr.mat", "aa3_gpsx.mat"
IDENTIFIED, UNIDENTIFIED = "data_sensor_clean_clean.mat", "VictoriaParkSinSincronizar.mat"
ARCHIVE, DETECTIONS = "victoria_park_ascii.zip", "measurements.dat"
BATCH, BATCH_TIMES = "LS_result_VicPark_original_cov_global_minimum.mat", "VicPark_pose_times.txt"
ASCII_ZERO = 20.967
"""s: the instant, on the clock of the MATLAB files, that the ASCII files count from."""


def open_victoria_park(folder: Path, variant: str | None, detector: Detector | None) -> Log:
    """The log in `folder`. Raises `LogError` if a file that the variant needs is missing."""
    variant = variant or "ids"
    if variant not in VARIANTS:
        raise LogError(f"no variant {variant!r}; there are {', '.join(VARIANTS)}", file=folder)
    ascii_clock = variant in ("ascii", "scans")
    files = _files(folder, variant)
    for path in files:
        if not path.is_file():
            raise LogError(f"not found; the variant {variant!r} needs it", file=path)
    fixes = _ascii_fixes(folder) if ascii_clock else _fixes(folder)
    zero = ASCII_ZERO if ascii_clock else 0.0
    references = [
        *_batch(folder, zero),
        *([] if fixes is None else [gps_reference(fixes)]),
    ]
    return Log(
        name="victoria-park",
        source=str(folder),
        defaults=ute.defaults(ute.TREES, "trees", identified=variant == "ids"),
        open=StreamEvents(lambda: _streams(folder, variant), detector if variant == "scans" else None),
        references=tuple(references),
        files=tuple(map(str, files)),
        sighting_truth=None if variant == "ids" else _sighting_truth(folder, zero),
    )


def gps_reference(fixes: FixStream, landmarks: np.ndarray | None = None) -> Reference:
    """The fixes of the antenna, and surveyed landmarks (N, 2) in the same frame if there are any."""
    finite = np.isfinite(fixes.values[:, :2]).all(axis=1) & np.isfinite(fixes.times)
    poles = np.zeros((0, 2)) if landmarks is None else landmarks
    return Reference(
        frame="other",
        kind="gps" if landmarks is None else "gps+survey",
        point=np.array(ute.MOUNT),
        times=fixes.times[finite],
        positions=fixes.values[finite, :2],
        headings=np.full(int(finite.sum()), np.nan),
        landmark_ids=np.arange(len(poles)),
        landmarks=poles,
    )


def _files(folder: Path, variant: str) -> list[Path]:
    gps = [folder / GPS] if (folder / GPS).is_file() else []
    if variant == "ids":
        return [folder / ODOMETRY, folder / IDENTIFIED, *gps]
    if variant == "detections":
        return [folder / UNIDENTIFIED, *gps]
    unpacked = [folder / name for name in ("DRS.txt", "GPS.txt")]
    source = unpacked if unpacked[0].is_file() else [folder / ARCHIVE]
    if variant == "ascii":
        return [*source, folder / DETECTIONS]
    return source if source[0].name == ARCHIVE else [*source, folder / "LASER.txt"]


def _streams(folder: Path, variant: str) -> Streams:
    if variant == "ids":
        return Streams(odometry=_odometry(folder), sightings=_identified(folder), fixes=_fixes(folder))
    if variant == "detections":
        return _unidentified(folder)
    odometry, fixes = _ascii_odometry(folder), _ascii_fixes(folder)
    if variant == "ascii":
        return Streams(odometry=odometry, sightings=_ascii_detections(folder), fixes=fixes)
    return Streams(odometry=odometry, scans=_ascii_scans(folder), fixes=fixes)


def _odometry(folder: Path) -> OdometryStream:
    path = folder / ODOMETRY
    variables = load_mat(path, ("time", "speed", "steering"))
    times = vector(variables, "time", path) / 1000.0
    columns = [vector(variables, name, path, len(times)) for name in ("speed", "steering")]
    return held(path, times, columns)


def held(path: Path, times: np.ndarray, columns: list[np.ndarray]) -> OdometryStream:
    """The car's odometry: times (n,) s, columns speed m/s and steering rad, (n,) each."""
    return OdometryStream(
        file=str(path),
        times=times,
        records=np.arange(1, len(times) + 1),
        names=("speed", "steering"),
        values=np.column_stack(columns),
    )


def _identified(folder: Path) -> SightingStream:
    path = folder / IDENTIFIED
    rows = matrix(load_mat(path, (path.stem,)), path.stem, path, columns=6)
    return SightingStream(
        file=str(path),
        times=rows[:, 0] / 1000.0,
        records=np.arange(1, len(rows) + 1),
        values=np.column_stack([rows[:, 1], ute.ahead(rows[:, 2])]),
        ids=identities(rows[:, 5]),
    )


def _sighting_truth(folder: Path, zero: float) -> SightingTruth | None:
    """The identities of the detections, on the clock that counts from `zero`; None without their file."""
    stream = _identified(folder) if (folder / IDENTIFIED).is_file() else None
    if stream is None or stream.ids is None:
        return None
    good, _ = find_faults(stream)
    good &= stream.ids >= 0
    return SightingTruth(stream.times[good] - zero, stream.values[good], stream.ids[good])


def _unidentified(folder: Path) -> Streams:
    path = folder / UNIDENTIFIED
    variables = load_mat(path, ("time", "u", "TLsr", "zt"))
    times = vector(variables, "time", path)
    commands = matrix(variables, "u", path, rows=2, columns=len(times))
    stamps = vector(variables, "TLsr", path)
    scans = cells(variables, "zt", path, len(stamps))
    fixes = _fixes(folder)
    sightings = _detections(path, stamps, scans)
    return Streams(odometry=held(path, times, list(commands)), sightings=sightings, fixes=fixes)


def _detections(path: Path, stamps: np.ndarray, scans: list[np.ndarray]) -> SightingStream:
    """Scans of (3, n) range, bearing, diameter; a scan without detections is one `empty` record."""
    nothing = np.full((3, 1), np.nan)
    malformed, blocks, row = {}, [], 0
    for scan in scans:
        if scan.size and (scan.ndim != 2 or scan.shape[0] != 3):
            malformed[row] = Malformed("zt", f"expected 3 rows, found {' x '.join(map(str, scan.shape))}")
        blocks.append(scan if scan.size and row not in malformed else nothing)
        row += blocks[-1].shape[1]
    sizes = np.array([block.shape[1] for block in blocks], dtype=np.int64)
    rows = np.hstack(blocks).T if blocks else np.zeros((0, 3))
    empty = np.repeat([block is nothing for block in blocks], sizes).astype(bool)
    empty[list(malformed)] = False
    return SightingStream(
        file=str(path),
        times=np.repeat(stamps, sizes),
        records=np.repeat(np.arange(1, len(scans) + 1), sizes),
        malformed=malformed,
        values=np.column_stack([rows[:, 0], ute.ahead(rows[:, 1])]),
        attributes={"diameter": np.ascontiguousarray(rows[:, 2])},
        empty=empty,
    )


def _fixes(folder: Path) -> FixStream | None:
    path = folder / GPS
    if not path.is_file():
        return None
    variables = load_mat(path, ("timeGps", "Lo_m", "La_m"))
    times = vector(variables, "timeGps", path) / 1000.0
    east, north = (vector(variables, name, path, len(times)) for name in ("Lo_m", "La_m"))
    return fix_stream(path, times, east, north)


def fix_stream(path: Path, times: np.ndarray, east: np.ndarray, north: np.ndarray) -> FixStream:
    """GPS fixes without heading, all (n,)."""
    values = np.column_stack([east, north, np.full(len(times), np.nan)])
    return FixStream(file=str(path), times=times, records=np.arange(1, len(times) + 1), values=values)


def _ascii_text(folder: Path, name: str) -> tuple[str, str]:
    """The text of an ASCII file, from the folder or from the archive, and where it stands."""
    if (folder / name).is_file():
        return read_text(folder / name), str(folder / name)
    return read_text(folder / ARCHIVE, name), f"{folder / ARCHIVE}/{name}"


def _ascii_odometry(folder: Path) -> OdometryStream:
    text, file = _ascii_text(folder, "DRS.txt")
    table = read_table(text, ("time", "speed", "steering"))
    return OdometryStream(
        file=file,
        times=table.values[:, 0],
        records=table.records,
        malformed=table.malformed,
        names=("speed", "steering"),
        values=np.ascontiguousarray(table.values[:, 1:]),
    )


def _ascii_fixes(folder: Path) -> FixStream:
    text, file = _ascii_text(folder, "GPS.txt")
    table = read_table(text, ("time", "north", "east"))
    heading = np.full(len(table.values), np.nan)
    return FixStream(
        file=file,
        times=table.values[:, 0],
        records=table.records,
        malformed=table.malformed,
        values=np.column_stack([table.values[:, 2], table.values[:, 1], heading]),
    )


def _ascii_detections(folder: Path) -> SightingStream:
    path = folder / DETECTIONS
    table = read_table(read_text(path), ("time", "range", "bearing", "diameter"))
    return SightingStream(
        file=str(path),
        times=table.values[:, 0],
        records=table.records,
        malformed=table.malformed,
        values=np.column_stack([table.values[:, 1], ute.ahead(table.values[:, 2])]),
        attributes={"diameter": np.ascontiguousarray(table.values[:, 3])},
    )


def _ascii_scans(folder: Path) -> ScanStream:
    """`LASER.txt`: records of a time and 361 ranges, with tabs and no line breaks between them."""
    text, file = _ascii_text(folder, "LASER.txt")
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers = np.fromstring(text, sep=" ")
        except (ValueError, DeprecationWarning):
            numbers = _parse_words(text.split())
    width = ute.BEAMS + 1
    count, rest = divmod(len(numbers), width)
    rows = np.full((count + (rest > 0), width), np.nan)
    rows.ravel()[: len(numbers)] = numbers
    short = Malformed(f"range {rest}", f"is missing: expected {width} numbers, found {rest}")
    return ScanStream(
        file=file,
        times=rows[:, 0].copy(),
        records=np.arange(1, len(rows) + 1),
        malformed={count: short} if rest else {},
        ranges=ute.returns(rows[:, 1:]),
        bearings=ute.BEAM_BEARINGS,
    )


def _parse_words(words: list[str]) -> np.ndarray:
    """Numbers, NaN where a word is none: the record that holds it is then found faulty."""

    def number(word: str) -> float:
        try:
            return float(word)
        except ValueError:
            return float("nan")

    return np.array([number(word) for word in words])


def _batch(folder: Path, zero: float) -> list[Reference]:
    """The batch least-squares solution, in the frame of the start pose; empty without its files."""
    path, times_path = folder / BATCH, folder / BATCH_TIMES
    if not (path.is_file() and times_path.is_file()):
        return []
    poses, ids, landmarks = batch_solution(path)
    table = read_table(read_text(times_path), ("pose", "time"))
    if len(table.values) != len(poses) or table.malformed:
        raise LogError(f"expected the times of {len(poses)} poses", file=times_path)
    return [
        Reference(
            kind="batch",
            times=table.values[:, 1] / 1000.0 - zero,
            positions=np.ascontiguousarray(poses[:, :2]),
            headings=poses[:, 2].copy(),
            landmark_ids=ids,
            landmarks=landmarks,
        )
    ]


def batch_solution(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Xstate_LS`: poses (K, 3) from the start pose (0, 0, 0) on, ids (N,), landmarks (N, 2)."""
    state = matrix(load_mat(path, ("Xstate_LS",)), "Xstate_LS", path, columns=3)
    values, of_pose = state[:, 0], state[:, 1] == 1
    if of_pose.sum() % 3 or (~of_pose).sum() % 2:
        raise LogError("expected poses of 3 and features of 2 numbers", file=path, field="Xstate_LS")
    poses = np.vstack([np.zeros(3), values[of_pose].reshape(-1, 3)])
    ids = identities(state[~of_pose, 2])[::2]
    return poses, ids, values[~of_pose].reshape(-1, 2)
