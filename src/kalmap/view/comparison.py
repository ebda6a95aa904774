"""Pages that set methods side by side: `kalmap compare` and the tables of a study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from kalmap.records import Manifest
from kalmap.view import page
from kalmap.view.figures import CAPTIONS, comparison_figures
from kalmap.view.inputs import RunView, StudyCurve, StudyTable
from kalmap.view.reading import headlines_first, metric_of, number, numbers
from kalmap.view.report import configuration, origin
from kalmap.view.study_figure import study_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Words of a key that say that a larger value is better, or that neither is.
_LARGER = {"precision", "recall", "accuracy", "f1"}
_NEITHER = {"band", "length", "duration", "reckoning"}


def render_comparison(
    runs: Sequence[RunView],
    metrics: Mapping[str, Mapping[str, Any]],
    *,
    manifests: Mapping[str, Manifest] | None = None,
    title: str | None = None,
    figures: Mapping[str, Figure | bytes] | None = None,
    warnings: Sequence[str] = (),
) -> str:
    """The page of `kalmap compare` as HTML: a table of metrics by method, and pictures.

    metrics: method -> its metrics, the methods in the order to show. manifests: method -> manifest.
    figures: as figures or as PNG; drawn here if not given.
    """
    figures = comparison_figures(runs, metrics) if figures is None else figures
    pictures = "\n".join(
        page.picture(figure, name, CAPTIONS.get(name, name)) for name, figure in figures.items()
    )
    manifests = manifests or {}
    origins = "".join(f"<h3>{page.text(name)}</h3>{origin(one)}" for name, one in manifests.items())
    settings = "".join(
        f"<h3>{page.text(name)}</h3>{configuration(one.config)}" for name, one in manifests.items()
    )
    sections = (
        ("warnings", "Warnings", page.warnings_html(warnings)),
        ("metrics", "Metrics", _metrics_by_method(metrics)),
        ("figures", "Pictures", pictures),
        ("configuration", "Configuration", settings),
        ("origin", "Where this comes from", origins),
    )
    log = runs[0].log if runs else "no runs"
    versions = ", ".join(sorted({one.kalmap for one in manifests.values()}))
    lead = f"{len(metrics)} methods on {log}"
    return page.page(title or f"Comparison on {log}", lead, sections, f"kalmap {versions}".strip())


def render_study(
    title: str,
    tables: Sequence[StudyTable],
    *,
    curves: Sequence[StudyCurve] = (),
    figures: Mapping[str, Figure | bytes] | None = None,
    manifest: Manifest | None = None,
    lead: str = "",
    about: Sequence[str] = (),
    warnings: Sequence[str] = (),
) -> str:
    """The page of a study as HTML: tables with the paper's numbers beside ours, and error curves.

    figures: as figures or as PNG. about: paragraphs that a reader must know before the numbers.
    """
    if figures is None:
        figures = {"study": study_figure(curves)} if curves else {}
    pictures = "\n".join(
        page.picture(figure, name, CAPTIONS.get(name, name)) for name, figure in figures.items()
    )
    sections = [("warnings", "Warnings", page.warnings_html(warnings))]
    sections.append(("about", "What is compared", "".join(f"<p>{page.text(each)}</p>" for each in about)))
    sections += [(f"table-{index}", table.title, study_table(table)) for index, table in enumerate(tables, 1)]
    sections.append(("figures", "Pictures", pictures))
    foot = "kalmap"
    if manifest is not None:
        sections.append(("configuration", "Configuration", configuration(manifest.config)))
        sections.append(("origin", "Where this comes from", origin(manifest)))
        foot = f"kalmap {manifest.kalmap}, {manifest.finished}"
    return page.page(title, lead, sections, foot)


def study_table(table: StudyTable) -> str:
    """HTML of a study's table: each cell ours, and below it the paper's where it gives a number."""
    papers = any(row.paper is not None for row in table.rows)
    head = (
        "<tr><th>method</th>"
        + "".join(f'<th class="n">{page.text(name)}</th>' for name in table.columns)
        + "</tr>"
    )
    lines = []
    for row in table.rows:
        paper = row.paper if row.paper is not None else (None,) * len(row.ours)
        decimals = table.decimals or (None,) * len(row.ours)
        cells = (_study_cell(*cell) for cell in zip(row.ours, paper, decimals, strict=True))
        lines.append(f"<tr><th>{page.text(row.method)}</th>{''.join(cells)}</tr>")
    note = f"{table.note} " if table.note else ""
    if papers:
        note += "Small and grey, below ours: what the paper reports."
    return page.framed_table(head, "\n".join(lines)) + (
        f'<p class="soft">{page.text(note)}</p>' if note else ""
    )


def _study_cell(ours: float | None, paper: float | None, decimals: int | None) -> str:
    shown = page.text("–" if ours is None else _rounded(ours, decimals))
    if paper is not None:
        shown += f'<br><small class="paper">{page.text(_rounded(paper, decimals))}</small>'
    return f'<td class="n">{shown}</td>'


def _rounded(value: float, decimals: int | None) -> str:
    return number(value) if decimals is None else f"{value:.{decimals}f}"


def _metrics_by_method(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    """HTML: one row a metric, one column a method, the best of each row set off."""
    rows = {method: numbers(row) for method, row in metrics.items()}
    keys = headlines_first(dict.fromkeys(key for row in rows.values() for key in row))
    if not keys:
        return "<p>No metrics to compare.</p>"
    head = (
        "<tr><th>metric</th>"
        + "".join(f'<th class="n">{page.text(method)}</th>' for method in rows)
        + "</tr>"
    )
    lines = []
    for key in keys:
        metric, values = metric_of(key), [row.get(key) for row in rows.values()]
        best = _best(key, values)
        cells = (
            f'<td class="n{" best" if value is not None and value == best else ""}">'
            f"{page.text(metric.format(value))}</td>"
            for value in values
        )
        lines.append(f"<tr><th>{page.text(metric.title)}</th>{''.join(cells)}</tr>")
    note = '<p class="soft">The best of each row is set off: least error, or nearest to what is right.</p>'
    return page.framed_table(head, "\n".join(lines)) + note


def _best(key: str, values: Sequence[float | None]) -> float | None:
    """The best value of a row, None where there is no better and worse (counts) or all are alike."""
    words = set(key.lower().replace(".", "_").split("_"))
    known = [value for value in values if value is not None]
    counts = all(isinstance(value, int) for value in known)
    if counts or words & _NEITHER or len(set(known)) < 2:
        return None
    right = metric_of(key).right
    if right is not None:
        return min(known, key=lambda value: abs(math.log(max(value, 1e-12) / right)))
    return max(known) if words & _LARGER else min(known)
