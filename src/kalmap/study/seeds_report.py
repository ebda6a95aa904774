"""What `compare` over several seeds leaves behind: tables with paired tests, error curves, a page."""

from __future__ import annotations

from pathlib import Path

from kalmap.data.files import write_atomically
from kalmap.study.compare import PairedRow, paired_rows
from kalmap.study.result import StudyResult, runs_csv, summary_csv
from kalmap.view import StudyRow, StudyTable, render_study, save_figures, study_figure

METRICS = {
    "position_rmse_m": "position RMS m",
    "heading_rmse_deg": "heading RMS deg",
    "feature_rmse_m": "feature RMS m",
    "ospa_m": "OSPA m",
    "cardinality_error": "features too many",
    "nees_mean": "NEES (3 is right)",
}


def write_seeds(folder: Path, result: StudyResult) -> dict[str, list[PairedRow]]:
    """Write `runs.csv`, `summary.csv`, `figures/` and `report.html`; returns the paired rows of each metric."""
    paired = {metric: paired_rows(result, metric) for metric in METRICS}
    write_atomically(folder / "runs.csv", runs_csv(result).encode())
    write_atomically(folder / "summary.csv", summary_csv(result).encode())
    curves = [
        curve for world, method in result.groups() if (curve := result.curve(world, method)) is not None
    ]
    world = result.groups()[0][0]
    paths = save_figures(folder / "figures", {"study": study_figure(curves, f"{world}, RMS over the runs")})
    pictures = {name: path.read_bytes() for name, path in paths.items()}
    tables = [_means(paired), *(_tests(METRICS[metric], rows) for metric, rows in paired.items())]
    page = render_study(f"{world}: comparison", tables, figures=pictures, warnings=result.failures())
    write_atomically(folder / "report.html", page.encode())
    return paired


def _means(paired: dict[str, list[PairedRow]]) -> StudyTable:
    first = next(iter(paired.values()))
    rows = [
        StudyRow(row.method, tuple(paired[metric][i].mean for metric in METRICS))
        for i, row in enumerate(first)
    ]
    note = "Means over the seeds: of each run's RMS, and of its last map as a set."
    return StudyTable("Means", tuple(METRICS.values()), tuple(rows), note)


def _tests(title: str, rows: list[PairedRow]) -> StudyTable:
    tested = tuple(
        StudyRow(row.method, (row.test.mean_difference, row.test.low, row.test.high, row.test.p_value))
        for row in rows
        if row.test is not None
    )
    columns = ("difference", "95 % low", "95 % high", "Wilcoxon p")
    return StudyTable(f"{title}: against {rows[0].method}, seed by seed", columns, tested)
