"""Two finished contour maps into one: read, lay on each other, join, and write what came of it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
from scipy.linalg import block_diag

from kalmap._version import __version__
from kalmap.data.files import json_text, write_atomically
from kalmap.data.native_map import SavedMap
from kalmap.data.results import write_contours, write_manifest
from kalmap.records import Contours, Estimate, JointTooLargeError, Landmarks, LogError, Manifest
from kalmap.slam.contours.closed import ClosedMap, neighbours
from kalmap.slam.contours.leg import composed
from kalmap.slam.contours.meeting import Met, meet
from kalmap.slam.contours.strands import strands
from kalmap.slam.contours.whole import whole_contours
from kalmap.view import save_figures
from kalmap.view.contour_join_figure import ContourJoinView, contour_join_figure

SPACINGS = (0.05, 1.0)  # m between samples that a map may have


class ContourJoinReport(msgspec.Struct, frozen=True):
    """What a join came to, for `join.json`.

    x, y m, heading_deg and their sigmas: where the second map's frame lies in the first's. samples: of the joined map.
    matched: m of contour that lie on each other; agreement: share of what lies side by side that does; through: m of
    contour that stand where the other map saw nothing. joint: whether all samples have a joint covariance.
    """

    x: float
    y: float
    heading_deg: float
    sigma_x: float
    sigma_y: float
    sigma_heading_deg: float
    samples: int
    matched: float
    agreement: float
    through: float
    joint: bool

    def found(self) -> str:
        """What holds the maps together, in words."""
        joint = "" if self.joint else " (without joint covariances: laid on each other, not corrected)"
        return (
            f"{self.matched:.1f} m of contour lie on each other, {self.agreement:.0%} of what lies side by side; "
            f"{self.samples} samples in all{joint}"
        )


def join_contour_files(
    saved: tuple[SavedMap, SavedMap],
    names: tuple[Path, Path],
    folder: Path,
    manifest: Manifest,
    figures: bool,
) -> ContourJoinReport:
    """Join two maps of contours and write the joined one. Raises NoMatchError where it cannot be told how they lie."""
    met, report, estimate = join_saved_contours(saved, names)
    folder.mkdir(parents=True, exist_ok=True)
    write_manifest(folder, msgspec.structs.replace(manifest, completed=False, error="writing was cut off"))
    write_contours(folder, estimate, {"kalmap": __version__, "joined_from": manifest.data_sha256})
    write_atomically(folder / "join.json", json_text(report).encode())
    if figures:
        view = _view(saved, names, met, estimate)
        save_figures(folder / "figures", {"join": contour_join_figure(view)})
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    write_manifest(folder, msgspec.structs.replace(manifest, finished=finished))
    return report


def join_saved_contours(
    saved: tuple[SavedMap, SavedMap], names: tuple[Path, Path]
) -> tuple[Met, ContourJoinReport, Estimate]:
    """Two maps in memory; names: of their files, for what there is to say of them."""
    spacing = max(_spacing(each, name) for each, name in zip(saved, names, strict=True))
    first, second = (_as_closed(each, spacing) for each in saved)
    joint = all(each.has_joint for each in saved)
    met = meet(first, second, joint)
    estimate = (
        _estimate_joint(saved[1], met.map)
        if met.map is not None
        else _estimate_laid(saved[1], first, second, met)
    )
    sigmas = np.sqrt(np.diagonal(met.covariance)).tolist()
    contours = estimate.contours
    assert contours is not None
    report = ContourJoinReport(
        x=float(met.pose[0]),
        y=float(met.pose[1]),
        heading_deg=float(np.degrees(met.pose[2])),
        sigma_x=sigmas[0],
        sigma_y=sigmas[1],
        sigma_heading_deg=float(np.degrees(sigmas[2])),
        samples=len(contours),
        matched=met.matched,
        agreement=met.agreement,
        through=met.through,
        joint=joint,
    )
    return met, report, estimate


def _spacing(saved: SavedMap, path: Path) -> float:
    """m between neighbouring samples on straight contours: most of them are that far apart."""
    contours = saved.estimate().contours
    assert contours is not None
    segments = contours.segments()
    lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
    lengths = lengths[lengths > 0.0]
    if not len(lengths):
        raise LogError("holds no contour of two samples or more to join by", file=path, field="contour_runs")
    return float(np.clip(np.percentile(lengths, 75), *SPACINGS))


def _as_closed(saved: SavedMap, spacing: float) -> ClosedMap:
    """Pose and samples, without landmarks and constant errors."""
    assert saved.contour_normals is not None and saved.contour_sightings is not None
    count = len(saved.contour_normals)
    kept = np.concatenate([np.arange(3), np.arange(len(saved.mean) - 2 * count, len(saved.mean))])
    if saved.has_joint:
        covariance = saved.covariance()[np.ix_(kept, kept)]
    else:
        estimate = saved.estimate()
        assert estimate.contours is not None
        covariance = block_diag(estimate.covariance, *estimate.contours.covariances)
    return ClosedMap(saved.mean[kept], covariance, saved.contour_normals, saved.contour_sightings, spacing)


def _estimate_joint(second: SavedMap, joined: ClosedMap) -> Estimate:
    """The joined map with its joint covariance, samples in the order of their runs."""
    pairs = neighbours(joined.samples, joined.normals, joined.spacing)
    chains = []
    for rows in strands(pairs, len(joined.samples)):
        chains.append(rows[:-1] if rows[0] == rows[-1] else rows)
    alone = np.setdiff1d(
        np.arange(len(joined.samples)), np.concatenate([np.zeros(0, dtype=np.int64), *chains])
    )
    chains += [np.array([row]) for row in alone]
    order = np.concatenate(chains)
    runs = np.repeat(np.arange(len(chains)), [len(rows) for rows in chains])
    entries = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
    mean, covariance = joined.mean[entries], joined.covariance[np.ix_(entries, entries)]
    blocks = 3 + 2 * np.arange(len(order))[:, None] + np.arange(2)
    contours = Contours(
        mean[3:].reshape(-1, 2),
        covariance[blocks[:, :, None], blocks[:, None, :]],
        joined.normals[order],
        joined.sightings[order],
        runs,
    )
    return _estimate(second, mean[:3], covariance[:3, :3], contours, (mean, covariance))


def _estimate_laid(second: SavedMap, first: ClosedMap, other: ClosedMap, met: Met) -> Estimate:
    """The second map as it is, moved onto the first: without joint covariances nothing more can be corrected."""
    frames, spreads = np.stack([np.zeros(3), met.pose]), np.stack([np.zeros((3, 3)), met.covariance])
    contours = whole_contours([first, other], frames, spreads, first.spacing, 1)
    pose, covariance = composed(met.pose, met.covariance, other.end, other.end_covariance)
    return _estimate(second, pose, covariance, contours, None)


def _estimate(
    second: SavedMap,
    pose: np.ndarray,
    covariance: np.ndarray,
    contours: Contours,
    whole: tuple[np.ndarray, np.ndarray] | None,
) -> Estimate:
    def joint() -> tuple[np.ndarray, np.ndarray]:
        if whole is None:
            raise JointTooLargeError("the maps were saved without their joint covariances")
        return whole

    none = Landmarks(
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
    )
    return Estimate(
        time=second.time,
        pose=pose,
        covariance=covariance,
        landmarks=none,
        biases={},
        joint=joint,
        coordinates="additive",
        contours=contours,
    )


def _view(
    saved: tuple[SavedMap, SavedMap], names: tuple[Path, Path], met: Met, estimate: Estimate
) -> ContourJoinView:
    drawn = [each.estimate().contours for each in saved]
    joined = estimate.contours
    assert joined is not None and drawn[0] is not None and drawn[1] is not None
    return ContourJoinView(
        names=(str(Path(*names[0].parts[-2:])), str(Path(*names[1].parts[-2:]))),
        first=drawn[0].segments(),
        second=drawn[1].segments(),
        T_first_second=met.pose,
        joined=joined.segments(),
        samples=len(joined),
    )
