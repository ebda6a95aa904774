"""One run as people look at it: its metrics, pictures, page and result folder."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from kalmap._version import __version__
from kalmap.data import reader_notes
from kalmap.data.files import json_text, write_atomically
from kalmap.data.results import check_result_folder, write_manifest, write_result
from kalmap.evaluation import consistency, trajectory
from kalmap.geometry.alignment import apply
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import quarter_turn, rotate
from kalmap.perception import occupancy_grid
from kalmap.records import (
    Estimate,
    EstimationError,
    Log,
    Manifest,
    OccupancyGrid,
    Reference,
    RunConfig,
    Trajectory,
)
from kalmap.slam import Outcome
from kalmap.study.cases import judge
from kalmap.study.compare import Compared
from kalmap.study.set_course import JudgedCourse, course_metrics, judge_course
from kalmap.study.trail import FIGURE, save_trail
from kalmap.view import (
    Aligned,
    Errors,
    RunView,
    SetCurve,
    SetView,
    comparison_figures,
    contour_warnings,
    decision_figure,
    render_comparison,
    render_report,
    run_figures,
    save_figures,
)

_OPTIONAL_FIGURES = ("map", "plan", "plan-close-up", "set", "intensity")
_PACKAGES = ("numpy", "scipy", "numba", "matplotlib", "msgspec")


def method_label(config: RunConfig) -> str:
    """The method as tables and pictures name it."""
    sets = config.finite_set
    if config.contour.method is not None:
        return f"{config.contour.method}, {_filter_label(config)}"
    if sets.method is not None:
        number = f"{sets.particles} particle{'s' * (sets.particles > 1)}"
        proposal = ", motion proposal" if sets.proposal == "motion" else ""
        weighting = f", {sets.weighting} weighting" if sets.weighting else ""
        if sets.method != "pmbm":
            return f"{sets.method}, {number}{proposal}{weighting}"
        return f"pmbm of {sets.particles}, {_filter_label(config)}"
    return _filter_label(config)


def _filter_label(config: RunConfig) -> str:
    chosen = config.filter
    scope = f", {chosen.scope}" if chosen.scope else ""
    use = ", sequential" if chosen.use == "sequential" else ""
    divided = ", divided" if config.divide.on else ""
    return f"{chosen.name}, {chosen.coordinates}{scope}{use}{divided}"


def run_view(
    outcome: Outcome,
    log: Log,
    label: str,
    judged: JudgedCourse | None = None,
    grid: OccupancyGrid | None = None,
) -> RunView:
    """The run with its first reference brought into the estimate's frame, and the errors against it.

    judged: the course of a map that is a random finite set, where there is a true one. grid: what scans swept.
    """
    view = RunView(
        method=label,
        log=log.name,
        estimate=outcome.estimate,
        trace=outcome.trace,
        sets=_set_view(outcome, log, judged, label),
        grid=grid,
        odometry=None if outcome.dead_reckoning is None else outcome.dead_reckoning[1][:, :2],
    )
    if not log.references:
        return view
    reference, course = log.references[0], view.course
    matched = trajectory.match(course.times, course.poses, reference)
    moved, angle, translation = matched, 0.0, np.zeros(2)
    if reference.frame != "map":
        moved, (angle, translation) = trajectory.aligned(matched)
    coordinates = outcome.estimate.coordinates
    return msgspec.structs.replace(
        view,
        reference=_into_map(reference, angle, translation),
        errors=_errors(course, coordinates, matched, moved, reference, angle) if len(matched) else None,
    )


def _set_view(outcome: Outcome, log: Log, judged: JudgedCourse | None, label: str) -> SetView | None:
    """The map as a random finite set; None where it is none."""
    if outcome.course is None:
        return None
    mixture, places = outcome.course.mixture, outcome.course.places
    number = np.array([len(each) for each in places], dtype=np.int64)
    known = (mixture.weights, mixture.means, mixture.covariances, outcome.course.times, number)
    if judged is None:
        return SetView(*known)
    errors = judged.errors
    curve = SetCurve(label, errors.estimated, errors.ospa, errors.localisation, errors.cardinality)
    return SetView(*known, curve, errors.true, judged.cutoff, log.references[0].kind)


def _into_map(reference: Reference, angle: float, translation: np.ndarray) -> Aligned:
    """Undo the motion that brought the estimate onto the reference."""
    back = -np.asarray(apply(-angle, np.zeros(2), translation[None]))[0]
    return Aligned(
        kind=reference.kind,
        point=reference.point,
        path=apply(-angle, back, reference.positions),
        landmarks=apply(-angle, back, reference.landmarks),
        walls=apply(-angle, back, reference.walls.reshape(-1, 2)).reshape(-1, 4),
    )


def _errors(
    course: Trajectory,
    coordinates: str,
    matched: trajectory.Matched,
    moved: trajectory.Matched,
    reference: Reference,
    angle: float,
) -> Errors:
    """Estimate minus reference along the map's axes; the NEES where the reference needs no alignment."""
    covariances = course.covariances[matched.rows]
    covariances = _at_point(course.poses[matched.rows], covariances, reference.point)
    values = moved.estimated - moved.reference
    values[:, :2] = apply(-angle, np.zeros(2), values[:, :2])
    values[:, 2] = wrap(values[:, 2])
    nees = np.full(len(matched), np.nan)
    if reference.kind == "truth" and reference.frame == "map" and not reference.point.any():
        nees = consistency.pose_nees(matched.reference, course.poses[matched.rows], covariances, coordinates)
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return Errors(course.times[matched.rows], values, np.sqrt(np.maximum(variances, 0.0)), nees)


def _at_point(poses: np.ndarray, covariances: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(F, 3, 3) with position errors of a point (forward, left; m) of the vehicle instead of its origin's."""
    lever = quarter_turn(rotate(poses[:, 2], np.asarray(point, dtype=float)[None]))
    change = np.broadcast_to(np.eye(3), covariances.shape).copy()
    change[:, :2, 2] = lever
    return change @ covariances @ np.swapaxes(change, 1, 2)


def manifest_of(outcome: Outcome, log: Log, config: RunConfig, command: str, started: datetime) -> Manifest:
    """What the result was made from, with a hash of every file that the events came from."""
    return Manifest(
        kalmap=__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        packages={name: version(name) for name in _PACKAGES},
        command=command,
        log=log.name,
        source=log.source,
        data_sha256={Path(name).name: _hash(Path(name)) for name in log.files},
        seed=config.seed,
        config=msgspec.to_builtins(config),
        log_settings=log.settings,
        started=started.isoformat(timespec="seconds"),
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        completed=outcome.error is None and not outcome.interrupted,
        interrupted=outcome.interrupted,
        error=None if outcome.error is None else str(outcome.error),
        skipped=[msgspec.to_builtins(record) for record in outcome.skipped],
        skipped_total=outcome.skipped_total,
    )


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def save_run(
    folder: Path,
    outcome: Outcome,
    log: Log,
    config: RunConfig,
    *,
    started: datetime,
    command: str | None = None,
    figures: bool = True,
) -> dict[str, float | int | None]:
    """Write the result folder of a run, also of one that was cut short; returns its metrics.

    Raises KalmapError if the folder holds something else.
    """
    check_result_folder(folder)
    metrics = judge(outcome, log, config)
    judged = judge_course(outcome, log, config)
    if judged is not None:
        metrics |= course_metrics(judged)
    manifest = manifest_of(outcome, log, config, " ".join(sys.argv) if command is None else command, started)
    estimate = outcome.estimate
    grid, warnings = swept(estimate, config)
    write_result(
        folder, estimate=estimate, trace=outcome.trace, metrics=metrics, manifest=manifest, grid=grid
    )
    trail, worst = save_trail(folder, outcome, manifest)
    _drop_optional_figures(folder)
    if figures:
        view = run_view(outcome, log, method_label(config), judged, grid)
        drawn = run_figures(view)
        if worst is not None:
            drawn[FIGURE] = decision_figure(worst)
        paths = save_figures(folder / "figures", drawn)
        pictures = {name: path.read_bytes() for name, path in paths.items()}
        page = render_report(
            view,
            metrics=metrics,
            manifest=manifest,
            figures=pictures,
            warnings=(*reader_notes(log), *contour_warnings(metrics), *warnings),
            trail=trail,
        )
        write_atomically(folder / "report.html", page.encode())
    return metrics


def swept(estimate: Estimate, config: RunConfig) -> tuple[OccupancyGrid | None, tuple[str, ...]]:
    """The occupancy grid of the estimate's scans, and why there is none where they are too spread out for one."""
    if estimate.sweeps is None:
        return None, ()
    sweeps = estimate.sweeps()
    if not len(sweeps.scans):
        return None, ()
    try:
        sensor, clears = config.sensor, min(config.contour.clear_range, config.sensor.max_range)
        return occupancy_grid(
            sweeps, min_range=sensor.min_range, max_range=sensor.max_range, clear_range=clears
        ), ()
    except EstimationError as problem:
        return None, (f"No map for Nav2 was written: {problem}.",)


def save_comparison(
    folder: Path, results: Sequence[Compared], log: Log, *, started: datetime
) -> dict[str, dict[str, float | int | None]]:
    """Each method's result in a folder of its own, and a page, table and figures over all of them.

    Returns metrics by method; methods that could not start are in the page's warnings only.
    """
    check_result_folder(folder)
    views, metrics, manifests, warnings = [], {}, {}, list(reader_notes(log))
    for result in results:
        if result.error is not None:
            warnings.append(f"{result.method}: {result.error}")
        if result.outcome is None:
            continue
        inside = folder / result.method.replace(":", "-")
        metrics[result.method] = save_run(
            inside, result.outcome, log, result.config, started=started, figures=False
        )
        judged = judge_course(result.outcome, log, result.config)
        views.append(run_view(result.outcome, log, result.method, judged))
        manifests[result.method] = manifest_of(
            result.outcome, log, result.config, " ".join(sys.argv), started
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "metrics.json", json_text(metrics).encode())
    if manifests:
        first = next(iter(manifests.values()))
        configs = {name: one.config for name, one in manifests.items()}
        write_manifest(folder, msgspec.structs.replace(first, config=configs))
    _drop_optional_figures(folder)
    if views:
        paths = save_figures(folder / "figures", comparison_figures(views, metrics))
        pictures = {name: path.read_bytes() for name, path in paths.items()}
        title = f"{log.name}: comparison"
        page = render_comparison(
            views, metrics, manifests=manifests, title=title, figures=pictures, warnings=warnings
        )
        write_atomically(folder / "report.html", page.encode())
    return metrics


def _drop_optional_figures(folder: Path) -> None:
    """Remove what an earlier run of another method may have left: not every method draws them again."""
    for name in _OPTIONAL_FIGURES:
        (folder / "figures" / f"{name}.png").unlink(missing_ok=True)
