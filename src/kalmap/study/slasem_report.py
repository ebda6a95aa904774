"""What the reproduction of Sun et al. 2010 leaves behind: the table, figures 4 to 7, and the page."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kalmap.study.claims import Claim
from kalmap.study.djnn_report import ALTERED
from kalmap.study.paper_report import Column, Line, PaperReport, PaperTable, given_up
from kalmap.study.result import StudyResult, Summary
from kalmap.study.slasem_cases import FloorRecord, Plan, amortised, method_name
from kalmap.view.floor_figures import FloorMaps, StepTimes, floor_maps_figure, step_times_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Divide-and-conquer SLASEM (Sun et al. 2010)"

_PAPER = {
    ("floor-115", False): (183.0 * 60.0, None),
    ("floor-115", True): (13.0 * 60.0, 7.0),
    ("floor-170", False): (420.0 * 60.0, None),
    ("floor-170", True): (14.0 * 60.0, 8.0),
}
"""Seconds in all, and submaps: of floors of the same length, 50 and 58 minutes of driving."""
_COLUMNS = (
    Column("s in all", "total_s", paper=True, decimals=2),
    Column("submaps", "local_maps", paper=True, decimals=1),
    Column("s live", "live_s", decimals=2),
    Column("s joins", "join_s", decimals=2),
    Column("step median ms", "live_ms_median", decimals=2),
    Column("step 99 % ms", "live_ms_p99", decimals=1),
    Column("step max ms", "live_ms_max", decimals=1),
    Column("amortised max ms", "amortised_ms_max", decimals=1),
    Column("samples", "samples", decimals=0),
    Column("position RMS m", "position_rmse_m"),
    Column("heading RMS deg", "heading_rmse_deg"),
    Column("in the end m", "final_position_rmse_m"),
    Column("in the end deg", "final_heading_rmse_deg"),
    Column("seen again, worst m", "revisit_worst_m"),
    Column("walls m", "wall_m"),
    Column("joins refused", "refusals", decimals=1),
)
_NOTE = (
    "Means over the seeds; n is their number. s: of processor time, in one process, one run after the other; live is "
    "everything from odometry to the corrected map, joins what closing and joining took. Position and heading RMS are "
    "over all scans, of the pose as it was known then; in the end: where the joined map has the vehicle. Seen again: "
    "of two scans within 0.5 m but 15 m apart on the way, how wrong the map has one as seen from the other, at worst. "
    "Walls: mean distance of the samples from the true walls."
)


def write_report(
    out: Path,
    plan: Plan,
    result: StudyResult,
    records: Sequence[FloorRecord],
    claims: list[Claim],
    started: datetime,
) -> dict[str, Path]:
    """Write every file and return the paths by name."""
    warnings = [ALTERED] * plan.altered + given_up(result)
    tables = tuple(_table(plan, world.name, records) for world in plan.worlds)
    report = PaperReport(TITLE, tables, claims, warnings, _about())
    return report.write(out, "slasem", result, plan.cases, started, slasem_figures(plan, records))


def _about() -> list[str]:
    """What was decided where the paper is silent, and what the times are of."""
    return [
        "The paper's logs were never published: these are simulated floors of the same kind and length, with the same "
        "scanner. Its robot was far slower, and its computer and program are of 2010: its times can be compared in "
        "their ratio only, and that depends on how much of a step does not grow with the map. Cutting a scan, "
        "fitting its pieces and finding the samples is most of a step here, in one map or in local ones.",
        "slasem keeps one map; dc-slasem closes a local map at 300 samples and joins them as a binary counter carries. "
        "Both are EKFs in additive coordinates, as published, update every 10 cm or 10 degrees, and see the same logs. "
        "Signed distances in joins leave the shared curve open instead of taking it as exact (see `on_one_curve`).",
    ]


def _table(plan: Plan, world: str, records: Sequence[FloorRecord]) -> PaperTable:
    lines = []
    for name in plan.filters:
        for divided in (False, True):
            chosen = [r for r in records if (r.world, r.method) == (world, method_name(name, divided))]
            paper = _PAPER.get((world, divided)) if name == "ekf" and not plan.altered else None
            rest: tuple[float | None, ...] = (None,) * (len(_COLUMNS) - 2)
            lines.append(
                Line(
                    _summary(world, method_name(name, divided), chosen),
                    None if paper is None else (*paper, *rest),
                )
            )
    return PaperTable(f"{world}", "method", _COLUMNS, tuple(lines), _NOTE, 1)


def _summary(world: str, method: str, records: list[FloorRecord]) -> Summary:
    done = [record for record in records if record.error is None]
    values = {column.metric: np.array([r.metrics[column.metric] for r in done]) for column in _COLUMNS}
    return Summary(
        world=world,
        method=method,
        runs=len(done),
        failed=len(records) - len(done),
        mean={key: float(v.mean()) if len(v) else None for key, v in values.items()},
        rms={key: float(np.sqrt(np.mean(v**2))) if len(v) else None for key, v in values.items()},
        error_of_mean={
            key: float(v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else None for key, v in values.items()
        },
    )


def slasem_figures(plan: Plan, records: Sequence[FloorRecord]) -> dict[str, tuple[Figure, str]]:
    """Figures 4 to 7, of the first seed that both ways came through, each with its caption."""
    figures: dict[str, tuple[Figure, str]] = {}
    for number, world in enumerate(plan.worlds):
        for name in plan.filters:
            pair = _first_pair(records, world.name, name)
            if pair is None:
                continue
            suffix = world.name if name == "ekf" else f"{world.name}-{name}"
            seed = f"{world.name}, seed {pair[0].seed}"
            figures[f"maps-{suffix}"] = (
                floor_maps_figure(_maps(*pair), f"{seed}: {pair[0].method} and {pair[1].method}"),
                f"{seed}: the true floor and the drive; the map of one filter; the local maps where the drive alone "
                f"has them; and what they were joined to: the paper's figure {4 + 2 * min(number, 1)}.",
            )
            figures[f"times-{suffix}"] = (
                step_times_figure([_times(record) for record in pair], 1.0 / world.rate),
                f"{seed}: the longest step of each 150th of the drive, all time so far, and the longest steps with the "
                f"joins spread over the steps up to the next: the paper's figure {5 + 2 * min(number, 1)}.",
            )
    return figures


def _first_pair(
    records: Sequence[FloorRecord], world: str, name: str
) -> tuple[FloorRecord, FloorRecord] | None:
    by_seed = [
        {
            r.seed: r
            for r in records
            if (r.world, r.method, r.error) == (world, method_name(name, divided), None)
        }
        for divided in (False, True)
    ]
    both = [seed for seed in by_seed[0] if seed in by_seed[1]]
    return (by_seed[0][both[0]], by_seed[1][both[0]]) if both else None


def _maps(plain: FloorRecord, divided: FloorRecord) -> FloorMaps:
    return FloorMaps(
        walls=np.array(plain.walls).reshape(-1, 4),
        true=np.array(plain.true),
        paths=(np.array(plain.path), np.array(divided.path)),
        plain=np.concatenate([np.array(each).reshape(-1, 2) for each in plain.maps]),
        local=tuple(np.array(each).reshape(-1, 2) for each in divided.local),
        joined=tuple(np.array(each).reshape(-1, 2) for each in divided.maps),
    )


def _times(record: FloorRecord) -> StepTimes:
    live, join = np.array(record.live_seconds), np.array(record.join_seconds)
    return StepTimes(record.method, np.array(record.times), live + join, amortised(live, join))
