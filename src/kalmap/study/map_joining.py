"""Two finished maps into one: read, match, join, and write what came of it."""

from __future__ import annotations

import hashlib
import platform
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap._version import __version__
from kalmap.data.files import json_text, write_atomically
from kalmap.data.native_map import SavedMap, read_map_file
from kalmap.data.results import check_result_folder, write_landmarks, write_manifest
from kalmap.records import Estimate, Landmarks, LogError, Manifest
from kalmap.slam.submaps.local_map import LocalMap, local_map
from kalmap.slam.submaps.matching import Matched, match_by_id, match_by_place
from kalmap.study.contour_joining import ContourJoinReport, join_contour_files
from kalmap.view import save_figures
from kalmap.view.join_figure import JoinView, join_figure


class JoinReport(msgspec.Struct, frozen=True):
    """What a join came to, for `join.json`.

    x, y m, heading_deg and their sigmas: where the second map's frame lies in the first's. pairs: ids of the first, of
    the second. joint_distance: sum of squares of the pairs, degrees: of freedom. chance: that so many pairs are an
    accident; None where identities were given. renamed: ids of the second map that are new in the joined one.
    """

    x: float
    y: float
    heading_deg: float
    sigma_x: float
    sigma_y: float
    sigma_heading_deg: float
    landmarks: int
    pairs: list[tuple[int, int]]
    joint_distance: float
    degrees: int
    chance: float | None
    renamed: list[tuple[int, int]]

    def found(self) -> str:
        """What holds the maps together, in words."""
        chance = "" if self.chance is None else f", 1 in {1.0 / max(self.chance, 1e-99):.0e} by chance"
        return (
            f"{len(self.pairs)} pairs of landmarks (joint distance {self.joint_distance:.1f} in {self.degrees} "
            f"dimensions{chance}); {self.landmarks} landmarks in all"
        )


def join_files(
    first: Path, second: Path, folder: Path, *, by_id: bool, figures: bool = True
) -> JoinReport | ContourJoinReport:
    """Join two native maps, of landmarks or of contours, and write the joined one beside what it rests on.

    The result is in the first map's frame and its pose is the second's robot. Raises LogError for files that are no
    maps, NoMatchError where it cannot be told how the maps lie, KalmapError if the folder holds something else.
    """
    started = datetime.now(UTC)
    check_result_folder(folder)
    saved = (read_map_file(first), read_map_file(second))
    if first.read_bytes() == second.read_bytes():
        raise LogError("is the same map as the first: joined, it would count twice", file=second)
    if any(each.contour_normals is not None for each in saved):
        return _join_contours(
            saved, (first, second), folder, _manifest((first, second), by_id, started), figures
        )
    matched, report, estimate = join_saved(saved[0], saved[1], (first, second), by_id=by_id)
    folder.mkdir(parents=True, exist_ok=True)
    manifest = _manifest((first, second), by_id, started)
    write_manifest(folder, msgspec.structs.replace(manifest, completed=False, error="writing was cut off"))
    write_landmarks(folder, estimate, {"kalmap": __version__, "joined_from": manifest.data_sha256})
    write_atomically(folder / "join.json", json_text(report).encode())
    if figures:
        save_figures(folder / "figures", {"join": join_figure(_view(matched, list(saved), (first, second)))})
    write_manifest(folder, msgspec.structs.replace(manifest, finished=_now()))
    return report


def _join_contours(
    saved: tuple[SavedMap, SavedMap],
    names: tuple[Path, Path],
    folder: Path,
    manifest: Manifest,
    figures: bool,
) -> ContourJoinReport:
    for each, name in zip(saved, names, strict=True):
        if each.contour_normals is None:
            raise LogError(
                "holds landmarks and no contours, the other map contours", file=name, field="contours"
            )
    return join_contour_files(saved, names, folder, manifest, figures)


def join_saved(
    first: SavedMap, second: SavedMap, names: tuple[Path, Path], *, by_id: bool
) -> tuple[Matched, JoinReport, Estimate]:
    """Two maps in memory; names: of their files, for what there is to say of them."""
    maps = [_as_local(saved, name) for saved, name in zip((first, second), names, strict=True)]
    matched = (match_by_id if by_id else match_by_place)(maps[0], maps[1])
    ids, renamed = _numbers(maps[0], maps[1], matched, by_id)
    joined = matched.joined
    covariance = joined.dense()[3:, 3:]
    mean = joined.mean[3:]
    place = 3 + 2 * np.arange(len(joined))[:, None] + np.arange(2)
    existence = np.concatenate([first.landmark_existence, second.landmark_existence[_fresh(matched, second)]])
    existence[matched.pairs[:, 0]] = np.fmax(
        existence[matched.pairs[:, 0]], second.landmark_existence[matched.pairs[:, 1]]
    )
    landmarks = Landmarks(
        ids=ids,
        positions=joined.landmarks,
        covariances=covariance[place[:, :, None], place[:, None, :]],
        sightings=joined.sightings,
        existence=existence,
    )
    estimate = Estimate(
        time=second.time,
        pose=joined.end,
        covariance=covariance[:3, :3],
        landmarks=landmarks,
        biases={},
        joint=lambda: (mean, covariance),
        coordinates="additive",
    )
    return matched, _report(maps, matched, by_id, renamed), estimate


def _as_local(saved: SavedMap, path: Path) -> LocalMap:
    """Pose and landmarks, without the constant errors of a vehicle."""
    if not len(saved.landmark_ids):
        raise LogError("holds no landmarks to join by", file=path, field="landmark_ids")
    if len(np.unique(saved.landmark_ids)) != len(saved.landmark_ids):
        raise LogError("expected every id once", file=path, field="landmark_ids")
    biases = len(saved.bias_names)
    kept = np.concatenate([np.arange(3), np.arange(3 + biases, len(saved.mean))])
    covariance = saved.covariance()[np.ix_(kept, kept)]
    return local_map(saved.mean[kept], covariance, saved.landmark_ids, saved.landmark_sightings)


def _fresh(matched: Matched, second: SavedMap) -> np.ndarray:
    """Rows of the second map's landmarks that the first does not hold."""
    return np.setdiff1d(np.arange(len(second.landmark_ids)), matched.pairs[:, 1])


def _numbers(
    first: LocalMap, second: LocalMap, matched: Matched, by_id: bool
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Ids of the joined map: the first's as they are; the second's where they are free, else new ones."""
    ids = matched.joined.ids.copy()
    renamed = []
    if not by_id:
        taken, number = set(first.ids.tolist()), int(max(first.ids.max(), second.ids.max())) + 1
        for row in range(len(first), len(ids)):
            if int(ids[row]) in taken:
                renamed.append((int(ids[row]), number))
                ids[row], number = number, number + 1
    return ids, renamed


def _report(
    maps: list[LocalMap], matched: Matched, by_id: bool, renamed: list[tuple[int, int]]
) -> JoinReport:
    x, y, heading = matched.T_first_second.tolist()
    sigmas = np.sqrt(np.diagonal(matched.covariance)).tolist()
    pairs = zip(maps[0].ids[matched.pairs[:, 0]].tolist(), maps[1].ids[matched.pairs[:, 1]].tolist())
    return JoinReport(
        x=x,
        y=y,
        heading_deg=float(np.degrees(heading)),
        sigma_x=sigmas[0],
        sigma_y=sigmas[1],
        sigma_heading_deg=float(np.degrees(sigmas[2])),
        landmarks=len(matched.joined),
        pairs=list(pairs),
        joint_distance=matched.squared,
        degrees=matched.degrees,
        chance=None if by_id else matched.chance,
        renamed=renamed,
    )


def _view(matched: Matched, saved: list[SavedMap], names: tuple[Path, Path]) -> JoinView:
    places = [each.mean[3 + len(each.bias_names) :].reshape(-1, 2) for each in saved]
    return JoinView(
        names=(str(Path(*names[0].parts[-2:])), str(Path(*names[1].parts[-2:]))),
        first=places[0],
        second=places[1],
        T_first_second=matched.T_first_second,
        pairs=matched.pairs,
        joined=matched.joined.landmarks,
    )


def _manifest(files: tuple[Path, Path], by_id: bool, started: datetime) -> Manifest:
    hashes: dict[str, Any] = {}
    for number, path in enumerate(files, 1):
        hashes[f"{number}: {path.name}"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return Manifest(
        kalmap=__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        packages={name: version(name) for name in ("numpy", "scipy", "msgspec")},
        command=" ".join(sys.argv),
        log=" + ".join(path.name for path in files),
        source=" + ".join(str(path) for path in files),
        data_sha256=hashes,
        seed=0,
        config={"by_id": by_id},
        started=started.isoformat(timespec="seconds"),
        finished=_now(),
        completed=True,
        interrupted=False,
        error=None,
        skipped=[],
        skipped_total=0,
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
