"""What the reproduction of Zhou, Zhao & Zhang 2010 leaves behind: tables, figures, claims and the page."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kalmap.records import Sightings
from kalmap.simulate import mover_tracks
from kalmap.study.cases import outcome_of
from kalmap.study.claims import Claim
from kalmap.study.djnn_cases import FEW, MANY, MDA, OWN, Plan, djnn_case, group_of
from kalmap.study.paper_report import Column, Line, PaperReport, PaperTable, given_up
from kalmap.study.present import run_view
from kalmap.study.published import DJNN, DJNN_RUNS
from kalmap.study.result import StudyResult
from kalmap.view import StudyDots, dots_figure, maps_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Dynamic joint nearest neighbour (Zhou, Zhao & Zhang 2010)"

_ACCURACY = Column("accuracy", "association_accuracy", paper=True, decimals=4)
_AT_ONCE = Column("accuracy at once", "association_accuracy_at_once", decimals=4)
_TIME = Column("ms a call", "association_ms", paper=True)
_FEATURES = Column("map features", "landmarks", paper=True, decimals=1)
_COLUMNS = (
    _ACCURACY,
    _AT_ONCE,
    _TIME,
    _FEATURES,
    Column("spurious", "association_spurious_landmarks", decimals=1),
    Column("duplicate", "association_duplicate_landmarks", decimals=1),
    Column("F1", "association_f1", decimals=4),
    Column("precision", "association_precision", decimals=4),
    Column("recall", "association_recall", decimals=4),
    Column("position RMS m", "position_rmse_m"),
    Column("NEES (3 is right)", "nees_mean", decimals=1),
)
_PICTURED = (("jcbb", "nn"), ("djnn",))  # of each the first that was run: the paper's figure 2
_FIRST_SEED = 1

_NOTE = (
    "Means over the runs; n is the number of runs. spurious: features of the last map that are none; "
    "duplicate: beyond the first of one feature. F1, precision and recall are of pairs of sightings said to "
    "be of one feature. The paper's map features are of one run."
)
_DOTS = "A dot is a seed, beside the axis stands the mean."
ALTERED = (
    "NOT THE STUDY'S WORLDS: settings of the worlds were changed, so these numbers stand for themselves."
)


def write_report(
    out: Path, plan: Plan, result: StudyResult, claims: list[Claim], started: datetime
) -> dict[str, Path]:
    """Write every file and return the paths by name."""
    figures = djnn_figures(plan, result)
    return djnn_report(plan, result, claims).write(out, "djnn", result, plan.cases, started, figures)


def djnn_report(plan: Plan, result: StudyResult, claims: list[Claim]) -> PaperReport:
    """Both tables beside the paper's numbers, and the claims."""
    warnings = [ALTERED] * plan.altered + given_up(result)
    tables = tuple(_table(plan, movers, result) for movers in (FEW, MANY))
    return PaperReport(TITLE, tables, claims, warnings, _about(plan))


def _about(plan: Plan) -> list[str]:
    """What was decided where the paper is silent, and what the times are of."""
    world = plan.worlds[MANY]
    mda = len({case.seed for case in plan.cases if case.method.name == MDA})
    fewer = f" {MDA} has {mda} of them, because it takes so long." if 0 < mda < _seeds(plan) else ""
    return [
        "The paper defines no accuracy, and states neither how fast its objects move, nor the course, nor where "
        "the features stand. Ours are: accuracy, the share of all sightings that were joined to the landmark "
        "that their own feature founded, founded the first one of their feature, or were of a mover and were "
        "left aside. A sighting that went to a tentative feature counts by what became of the feature: one that "
        "was never admitted corrected nothing, and its sightings were left aside. Accuracy at once is without "
        "this hindsight: a mover's sighting that founds a tentative feature is wrong whatever becomes of it. "
        f"Ours are further: movers that walk at {world.mover_speed:g} m/s with a heading that strays at random; "
        f"{len(world.landmarks)} features drawn at random, at least 1.5 m apart and 2 m from the way; one round "
        "anticlockwise with a fold to the middle. So numbers are compared with the paper's in their order, not "
        "in their size.",
        "All methods share the filter (cr-cdkf in invariant coordinates; the paper names none), the logs and "
        f"the seeds.{fewer} But for the last group ({OWN}) they take the paper's gate of 95 % and begin a "
        "feature with every sighting beyond it: with one of twenty sightings of a known feature, too. Nothing "
        "takes such a feature back in nn, jcbb and mda; the tentative set of djnn does.",
        "ms a call is the time of the association for a frame of sightings, with its management of the map, "
        "and for mda with going back to take frames again. mda is Python around compiled searches, the inner "
        "loops of the others are compiled: its times show the language too. Times were taken with all workers "
        "busy, on both sides of every comparison; `--workers 1` on an idle machine takes them alone. The "
        "paper's time is its mean running time, it does not say of what, on a computer of its day.",
    ]


def _seeds(plan: Plan) -> int:
    return len({case.seed for case in plan.cases})


def _table(plan: Plan, movers: int, result: StudyResult) -> PaperTable:
    world = plan.worlds[movers]
    lines = tuple(
        Line(result.summary(world.name, method), _paper(plan, movers, method)) for method in plan.methods
    )
    title = f"{world.name}: {len(world.landmarks)} features, {movers} movers"
    return PaperTable(title, "method", _COLUMNS, lines, _NOTE, DJNN_RUNS)


def _paper(plan: Plan, movers: int, method: str) -> tuple[float | None, ...] | None:
    row = DJNN.get((movers, method))
    if row is None or plan.altered:
        return None
    known = (row.accuracy, None, 1e3 * row.time_s, None if row.features is None else float(row.features))
    return (*known, *(None,) * (len(_COLUMNS) - len(known)))


def djnn_figures(plan: Plan, result: StudyResult) -> dict[str, tuple[Figure, str]]:
    """Accuracy, map features and time by method, and two maps beside each other, each with its caption."""
    true = len(plan.worlds[MANY].landmarks)
    figures = {
        "accuracy": (
            dots_figure(_dots(plan, result, _ACCURACY), "accuracy", decimals=3),
            f"{_DOTS} Share of sightings that were decided rightly. The paper's accuracy is of another world and "
            "perhaps of another definition: its order counts, not its size.",
        ),
        "features": (
            dots_figure(
                _dots(plan, result, _FEATURES),
                "features in the last map",
                line=(true, f"the {true} real ones"),
                log=True,
                decimals=0,
            ),
            f"{_DOTS} Features in the map at the end of the run: what is right of the line is spurious or there "
            "twice. The paper's numbers are of one run.",
        ),
        "time": (
            dots_figure(_dots(plan, result, _TIME), "time per call (ms)", log=True),
            f"{_DOTS} Time of the association for a frame, taken with all workers busy. The paper's is of a "
            "computer of its day.",
        ),
    }
    maps = _maps(plan)
    return figures if maps is None else {"maps": maps, **figures}


def _dots(plan: Plan, result: StudyResult, column: Column) -> dict[str, list[StudyDots]]:
    """The panels of a figure: a metric of every method with its seeds, for few movers and for many."""
    panels = {}
    for movers, world in plan.worlds.items():
        rows = []
        for method in plan.methods:
            values = np.array(list(result.values(world.name, method, column.metric).values()))
            paper = (_paper(plan, movers, method) or (None,) * len(_COLUMNS))[_COLUMNS.index(column)]
            rows.append(StudyDots(method, values, group_of(method), paper))
        panels[f"{movers} movers"] = rows
    return panels


def _maps(plan: Plan) -> tuple[Figure, str] | None:
    """The maps of a method that believes everything and of DJNN among many movers, like the paper's figure 2.

    Their runs are made again here: a study keeps numbers, not maps.
    """
    names = [next((name for name in wanted if name in plan.methods), None) for wanted in _PICTURED]
    views, world = [], plan.worlds[MANY]
    for name in names:
        if name is None:
            return None
        outcome, log = outcome_of(djnn_case(world, name, _FIRST_SEED))
        count = len(outcome.estimate.landmarks)
        views.append(run_view(outcome, log, f"{name}: {count} features"))
    frames = sum(isinstance(event, Sightings) for event in log)
    caption = (
        f"The last maps of {' and '.join(map(str, names))} with seed {_FIRST_SEED} and {MANY} movers, of "
        f"{len(world.landmarks)} real features, as in the paper's figure 2."
    )
    return maps_figure(views, mover_tracks(world, _FIRST_SEED, frames)), caption
