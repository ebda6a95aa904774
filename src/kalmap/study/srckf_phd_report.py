"""What the reproduction of Yan et al. 2014 leaves behind: tables, figures 2, 3, 4 and 6, and the page."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kalmap.study.claims import Claim
from kalmap.study.djnn_report import ALTERED
from kalmap.study.paper_report import Column, Line, PaperReport, PaperTable, given_up
from kalmap.study.published import SRCKF_PHD_RUNS, SRCKF_PHD_SECONDS
from kalmap.study.result import StudyResult
from kalmap.study.srckf_phd_cases import CAR_PARK, CAR_PARTICLES, METHODS, PARTICLES, Plan
from kalmap.view import StudyDots, dots_figure, set_error_figure, study_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Square-root cubature PHD SLAM (Yan et al. 2014)"

_TIME = Column("s a run", "runtime_s", paper=True)
_ERRORS = (
    Column("position RMS m", "position_rmse_m"),
    Column("heading RMS deg", "heading_rmse_deg"),
    Column("OSPA over the run m", "ospa_course_m"),
    Column("features off over the run", "cardinality_course_error", decimals=2),
    Column("OSPA at the end m", "ospa_m"),
    Column("features too many at the end", "cardinality_error", decimals=1),
)
_COLUMNS = (_TIME, *_ERRORS)
_CAR_COLUMNS = (
    Column("s a run", "runtime_s"),
    Column("path RMS m", "position_rmse_m"),
    Column("poles in the map", "landmarks", decimals=1),
    Column("OSPA to the survey m", "ospa_m"),
)
_NOTE = (
    "Means over the runs; n is the number of runs. OSPA of order 2, cut off at 10 m. Over the run: the mean over "
    "some hundreds of instants, of the map against the features that have been in view until then; features off: "
    "how many too many or too few, without their sign. At the end: against all features of the world. The paper "
    "gives times alone in numbers; its errors are curves."
)
_CAR_NOTE = (
    "Against the antenna's GPS fixes, the path laid over them first. 15 poles were surveyed. The paper shows the error "
    "as a curve only (its figure 6)."
)


def write_report(
    out: Path, plan: Plan, result: StudyResult, claims: list[Claim], started: datetime
) -> dict[str, Path]:
    """Write every file and return the paths by name."""
    warnings = [ALTERED] * plan.altered + given_up(result)
    tables = tuple(_table(plan, clutter, result) for clutter in plan.worlds)
    if plan.car_park is not None:
        lines = tuple(Line(result.summary(CAR_PARK, method)) for method in METHODS)
        title = f"Car park, {CAR_PARTICLES} particles"
        tables += (PaperTable(title, "method", _CAR_COLUMNS, lines, _CAR_NOTE, SRCKF_PHD_RUNS),)
    else:
        warnings.append("The car park's log was not there: its figure and claims are missing.")
    report = PaperReport(TITLE, tables, claims, warnings, _about(plan))
    figures = srckf_phd_figures(plan, result)
    return report.write(out, "srckf-phd", result, plan.cases, started, figures)


def _about(plan: Plan) -> list[str]:
    """What was decided where the paper is silent, and what the times are of."""
    world = next(iter(plan.worlds.values()))
    return [
        "The paper states neither where its 39 features stand nor its way; ours are drawn once, and the way is such "
        "that it takes 726 looks. So numbers are compared with the paper's in their order, not in their size; only "
        "the times are of the same number of looks, theirs in MATLAB on a computer of 2.66 GHz.",
        f"srckf-phd and rb-phd are as published: {PARTICLES} particles, drawn from odometry alone and weighed by a "
        "single feature, by the cubature rule in srckf-phd, which also keeps the covariance of the pose in its update "
        "and takes the heaviest component however light. They drop components below 1e-5 and count those from 0.6 on. "
        "The two called sightings draw from what a frame makes likely and weigh by all features in view, as kalmap "
        "does by default, drop components below 1e-3 and forgive a known feature one miss. All know P_D "
        f"({world.detection_probability:g}) and clutter exactly; all see the same logs, seed by seed.",
        "On the car park's log the noise is the paper's (0.7 m/s, 5.5 deg; 1 m, 1 deg), P_D and clutter are learnt, "
        "and nothing but the filters' own seed differs between runs.",
        "Times are of the filter alone, one thread each, taken with all workers busy; `--workers 1` on an idle "
        "machine takes them alone.",
    ]


def _table(plan: Plan, clutter: int, result: StudyResult) -> PaperTable:
    world = plan.worlds[clutter]
    lines = tuple(
        Line(result.summary(world.name, method), _paper(plan, clutter, method)) for method in METHODS
    )
    title = f"Clutter {clutter} a look: {len(world.landmarks)} features, {PARTICLES} particles"
    return PaperTable(title, "method", _COLUMNS, lines, _NOTE, SRCKF_PHD_RUNS)


def _paper(plan: Plan, clutter: int, method: str) -> tuple[float | None, ...] | None:
    seconds = SRCKF_PHD_SECONDS.get((clutter, method))
    if seconds is None or plan.altered:
        return None
    return (seconds, *(None,) * len(_ERRORS))


def srckf_phd_figures(plan: Plan, result: StudyResult) -> dict[str, tuple[Figure, str]]:
    """Figures 2, 3 and 4 for each clutter, table 2 as dots, and figure 6, each with its caption."""
    figures: dict[str, tuple[Figure, str]] = {}
    for clutter, world in plan.worlds.items():
        said = f"at clutter {clutter} a look"
        curves = [curve for method in METHODS if (curve := result.curve(world.name, method)) is not None]
        figures[f"position-{clutter}"] = (
            study_figure(curves, f"Clutter {clutter}: RMS over the runs"),
            f"Error of the pose over time {said}, root mean square over the runs: the paper's figure 2.",
        )
        drawn = _set_figure(result, world.name)
        if drawn is not None:
            figures[f"set-{clutter}"] = (
                drawn,
                f"Number of features and OSPA over time {said}, means over the runs: the paper's figures 3 and 4. The "
                "truth counts the features that have been in view so far.",
            )
    figures["time"] = (
        dots_figure(_times(plan, result), "time per run (s)", log=True),
        "Table 2: a dot is a seed, beside the axis stands the mean. The paper's times are of MATLAB on its computer.",
    )
    curves = [curve for method in METHODS if (curve := result.curve(CAR_PARK, method)) is not None]
    if curves:
        figures["car-park"] = (
            study_figure(curves, "Car park: RMS over the runs"),
            "Distance from the GPS fixes over time, root mean square over the runs: the paper's figure 6. Each path "
            "was laid over the fixes first.",
        )
    return figures


def _set_figure(result: StudyResult, world: str) -> Figure | None:
    known = {method: result.set_curve(world, method) for method in METHODS}
    drawn = [curve for curve in known.values() if curve is not None]
    if not drawn:
        return None
    times, _, true = drawn[0]
    places = [place for place, curve in enumerate(known.values()) if curve is not None]
    return set_error_figure(times, [curve for _, curve, _ in drawn], true, 10.0, places)


def _times(plan: Plan, result: StudyResult) -> dict[str, list[StudyDots]]:
    return {
        f"clutter {clutter}": [
            StudyDots(
                method,
                np.array(list(result.values(world.name, method, _TIME.metric).values())),
                "sightings" if "sightings" in method else "as published",
                (_paper(plan, clutter, method) or (None,))[0],
            )
            for method in METHODS
        ]
        for clutter, world in plan.worlds.items()
    }
