"""What the reproduction of Chen & Cheng 2012 leaves behind: tables, figures, claims and the page."""

from __future__ import annotations

import hashlib
import platform
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

import kalmap
from kalmap.data.native_map import json_ready, write_atomically
from kalmap.records import Manifest
from kalmap.simulate import World
from kalmap.study.claims import Claim, claims_markdown, claims_table, tally
from kalmap.study.crcdkf_cases import SETS, Plan
from kalmap.study.published import CRCDKF
from kalmap.study.result import StudyResult, Summary, runs_csv, summary_csv
from kalmap.view import StudyRow, StudyTable, render_study, save_figures, study_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Complexity-reduced CDKF-SLAM (Chen & Cheng 2012)"

_COLUMNS = {
    "position RMS m": ("position_rmse_m", "position_rms_m"),
    "heading RMS deg": ("heading_rmse_deg", "heading_rms_deg"),
    "feature RMS m": ("feature_rmse_m", "feature_rms_m"),
    "NEES (3 is right)": ("nees_mean", None),
    "NIS per dof (1 is right)": ("nis_mean", None),
    "ms a step": ("step_ms_mean", "step_ms"),
    "s a run": ("runtime_s", "total_s"),
}
_RATIOS = ("position RMS m", "heading RMS deg", "feature RMS m")
_PACKAGES = ("numpy", "scipy", "numba", "matplotlib", "msgspec")

MISSING_MAP = (
    "THE PAPER'S MAP IS MISSING. These runs are on kalmap's own course (course-35, course-70), not on the "
    "map of Bailey and Nieto's simulator, so the paper's numbers are not comparable with these and are left "
    "out. Name the folder that holds bailey_sim/example_webmap.mat to compare."
)
SHORT = "Not the paper's two laps: the paper's numbers are not comparable with these and are left out."


def write_report(
    out: Path, plan: Plan, result: StudyResult, claims: list[Claim], started: datetime
) -> dict[str, Path]:
    """Write every file and return the paths by name."""
    warnings = _warnings(plan, result)
    tables = [study_table(plan, which, result) for which in SETS]
    figures = crcdkf_figures(plan, result)
    manifest = _manifest(plan, started)
    texts = {
        "crcdkf.md": crcdkf_markdown(plan, result, claims, warnings),
        "crcdkf.csv": summary_csv(result),
        "runs.csv": runs_csv(result),
        "claims.json": _json({"comparable": plan.comparable, "warnings": warnings, "claims": claims}),
        "manifest.json": _json(manifest),
        "report.html": render_study(
            TITLE,
            [claims_table(claims), *tables],
            figures={_caption(name): figure for name, figure in figures.items()},
            manifest=manifest,
            lead=tally(claims),
            warnings=warnings,
        ),
    }
    for name, text in texts.items():
        write_atomically(out / name, text.encode())
    pictures = save_figures(out / "figures", figures)
    return {**{name: out / name for name in texts}, **{f"figures/{k}.png": p for k, p in pictures.items()}}


def _warnings(plan: Plan, result: StudyResult) -> list[str]:
    warnings = []
    if not plan.comparable:
        warnings.append(MISSING_MAP if plan.worlds["a"].name == "course-35" else SHORT)
    failed = sum(record.error is not None for record in result.records)
    if failed:
        warnings.append(f"{failed} of {len(result.records)} runs were given up and are in no number below.")
    return warnings + result.failures()


def _note(plan: Plan, which: str) -> str:
    """What a reader must know of a set's table."""
    elsewhere = (
        "The paper gives no coordinates of the 35 features that set b adds; ours are drawn at random, so "
        "this is another map than the paper's and the ratios compare maps as much as filters. "
    )
    return (elsewhere if which == "b" and plan.comparable else "") + _method_note(plan)


def _method_note(plan: Plan) -> str:
    use = plan.cases[0].method.filter.use
    how = {
        "joint": "A frame's sightings are applied in one joint update; the paper applies them one by one.",
        "sequential": "A frame's sightings are applied one after the other, as in the paper.",
    }[use]
    return (
        "Means over the runs of each run's RMS over its frames; NEES and NIS are means over frames, then "
        f"runs. n is the number of runs. {how} cdkf is the full O(n^3) filter in numpy, the others are "
        "compiled: their times show the order of the algorithm and the language together. Times are taken "
        "while every worker is busy; for times alone, run with one worker on an idle machine."
    )


def _description(world: World, which: str) -> str:
    return (
        f"Set {which}: {world.name}, {len(world.landmarks)} features, {world.sigma_speed:g} m/s, "
        f"{world.sigma_steering_deg:g} deg"
    )


def _paper(plan: Plan, which: str, method: str) -> tuple[float | None, ...] | None:
    """The paper's row beside one of ours; it knows additive coordinates only."""
    name, _, coordinates = method.partition(":")
    row = CRCDKF.get((which, name))
    if row is None or coordinates != "additive" or not plan.comparable:
        return None
    return tuple(None if field is None else getattr(row, field) for _, field in _COLUMNS.values())


def _summaries(plan: Plan, which: str, result: StudyResult) -> list[Summary]:
    world = plan.worlds[which].name
    methods = plan.methods(which, "additive") + plan.methods(which, "invariant")
    return [result.summary(world, method) for method in methods]


def study_table(plan: Plan, which: str, result: StudyResult) -> StudyTable:
    """A set's table for the report page: ours, and below it the paper's."""
    rows = []
    for s in _summaries(plan, which, result):
        ours = (*(s.mean[metric] for metric, _ in _COLUMNS.values()), float(s.runs))
        paper = _paper(plan, which, s.method)
        rows.append(StudyRow(s.method, ours, None if paper is None else (*paper, 50.0)))
    title = _description(plan.worlds[which], which)
    return StudyTable(title, (*_COLUMNS, "n"), tuple(rows), _note(plan, which))


def crcdkf_markdown(plan: Plan, result: StudyResult, claims: list[Claim], warnings: list[str]) -> str:
    """Both sets' tables beside the paper's numbers, and the claims."""
    parts = [f"# {TITLE}", *(f"**{warning}**" for warning in warnings)]
    for which in SETS:
        parts += [f"## {_description(plan.worlds[which], which)}", _set_markdown(plan, which, result)]
        parts.append(_note(plan, which))
    parts += ["## Claims", f"{tally(claims)}.", claims_markdown(claims)]
    return "\n\n".join(parts)


def _set_markdown(plan: Plan, which: str, result: StudyResult) -> str:
    head = ["filter", "n"]
    for column in _COLUMNS:
        head += [column, "paper", "ratio"] if column in _RATIOS else [column]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for s in _summaries(plan, which, result):
        paper = _paper(plan, which, s.method) or (None,) * len(_COLUMNS)
        cells = [s.method, str(s.runs) + (f" ({s.failed} failed)" if s.failed else "")]
        for (column, (metric, _)), theirs in zip(_COLUMNS.items(), paper, strict=True):
            ours = s.mean[metric]
            cells.append(_number(ours))
            if column in _RATIOS:
                cells += [_number(theirs), _number(ours / theirs if ours and theirs else None)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}" if abs(value) < 0.1 else f"{value:.3f}"


def crcdkf_figures(plan: Plan, result: StudyResult) -> dict[str, Figure]:
    """RMS errors over time of each set.

    One figure of the filters in additive coordinates (the paper's figure 2), one of both coordinates.
    """
    figures = {}
    for which in SETS:
        both = [f"{name}:{kind}" for name in ("ekf", "cr-cdkf") for kind in ("additive", "invariant")]
        chosen = {"filters": plan.methods(which, "additive"), "coordinates": both}
        for name, methods in chosen.items():
            world = plan.worlds[which].name
            labels = {method: f"{method}, n = {len(result.of(world, method))}" for method in methods}
            curves = [c for m, label in labels.items() if (c := result.curve(world, m, label)) is not None]
            figures[f"set-{which}-{name}"] = study_figure(curves, f"Set {which}, RMS over the runs")
    return figures


def _caption(name: str) -> str:
    _, which, kind = name.split("-")
    what = {
        "filters": "the filters in additive coordinates, the paper's own (its figure 2)",
        "coordinates": "the same filter in additive and in invariant coordinates",
    }[kind]
    return f"Set {which}: RMS error over all runs at each instant; {what}."


def _manifest(plan: Plan, started: datetime) -> Manifest:
    worlds = {which: json_ready(world) for which, world in plan.worlds.items()}
    settings = {
        which: {k: v for k, v in world.items() if k not in ("landmarks", "waypoints")}
        for which, world in worlds.items()
    }
    methods = {case.method.name: case.method.filter for case in plan.cases}
    return Manifest(
        kalmap=kalmap.__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        packages={name: version(name) for name in _PACKAGES},
        command=" ".join(sys.argv),
        log=" and ".join(world.name for world in plan.worlds.values()),
        source="simulated",
        data_sha256={
            world["name"]: hashlib.sha256(msgspec.json.encode(world, order="deterministic")).hexdigest()
            for world in worlds.values()
        },
        seed=min(case.seed for case in plan.cases),
        config={
            "seeds": sorted({case.seed for case in plan.cases}),
            "methods": json_ready(methods),
            "worlds": settings,
        },
        started=started.isoformat(timespec="seconds"),
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        completed=True,
        interrupted=False,
        error=None,
        skipped=[],
        skipped_total=0,
    )


def _json(value: Any) -> str:
    encoded: bytes = msgspec.json.format(msgspec.json.encode(json_ready(value)), indent=2)
    return encoded.decode() + "\n"
