"""What the reproduction of Chen & Cheng 2012 leaves behind: tables, figures, claims and the page."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from kalmap.simulate import World
from kalmap.study.claims import Claim
from kalmap.study.crcdkf_cases import SETS, Plan
from kalmap.study.paper_report import Column, Line, PaperReport, PaperTable, given_up
from kalmap.study.published import CRCDKF, CRCDKF_RUNS
from kalmap.study.result import StudyResult
from kalmap.view import study_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Complexity-reduced CDKF-SLAM (Chen & Cheng 2012)"

# each with the field of the paper's row that says the same
_COLUMNS = {
    Column("position RMS m", "position_rmse_m", paper=True, ratio=True): "position_rms_m",
    Column("heading RMS deg", "heading_rmse_deg", paper=True, ratio=True): "heading_rms_deg",
    Column("feature RMS m", "feature_rmse_m", paper=True, ratio=True): "feature_rms_m",
    Column("NEES (3 is right)", "nees_mean"): None,
    Column("NIS per dof (1 is right)", "nis_mean"): None,
    Column("ms a step", "step_ms_mean"): "step_ms",
    Column("s a run", "runtime_s"): "total_s",
}

MISSING_MAP = (
    "THE PAPER'S MAP IS MISSING. These runs are on kalmap's own course (course-35, course-70), not on the "
    "map of Bailey and Nieto's simulator, so the paper's numbers are not comparable with these and are left "
    "out. Name the folder that holds bailey_sim/example_webmap.mat to compare."
)
SHORT = "Not the paper's two laps: the paper's numbers are not comparable with these and are left out."


def crcdkf_report(plan: Plan, result: StudyResult, claims: list[Claim]) -> PaperReport:
    """Both sets' tables beside the paper's numbers, and the claims."""
    tables = tuple(_table(plan, which, result) for which in SETS)
    return PaperReport(TITLE, tables, claims, _warnings(plan, result))


def write_report(
    out: Path, plan: Plan, result: StudyResult, claims: list[Claim], started: datetime
) -> dict[str, Path]:
    """Write every file and return the paths by name."""
    report = crcdkf_report(plan, result, claims)
    figures = {name: (figure, _caption(name)) for name, figure in crcdkf_figures(plan, result).items()}
    return report.write(out, "crcdkf", result, plan.cases, started, figures, comparable=plan.comparable)


def _warnings(plan: Plan, result: StudyResult) -> list[str]:
    warnings = []
    if not plan.comparable:
        warnings.append(MISSING_MAP if plan.worlds["a"].name == "course-35" else SHORT)
    return warnings + given_up(result)


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
    return tuple(None if field is None else getattr(row, field) for field in _COLUMNS.values())


def _table(plan: Plan, which: str, result: StudyResult) -> PaperTable:
    world = plan.worlds[which]
    methods = plan.methods(which, "additive") + plan.methods(which, "invariant")
    lines = tuple(Line(result.summary(world.name, m), _paper(plan, which, m)) for m in methods)
    title, note = _description(world, which), _note(plan, which)
    return PaperTable(title, "filter", tuple(_COLUMNS), lines, note, CRCDKF_RUNS)


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
