"""What the reproduction of a paper leaves behind: tables with the paper's numbers, claims, figures and the page."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

import kalmap
from kalmap.data.files import json_ready, json_text, write_atomically
from kalmap.records import Manifest
from kalmap.study.cases import Case
from kalmap.study.claims import Claim, claims_markdown, claims_table, tally
from kalmap.study.recorded import Recorded
from kalmap.study.result import StudyResult, Summary, runs_csv, summary_csv
from kalmap.view import StudyRow, StudyTable, render_study, save_figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OF_METHOD = ("filter", "association", "finite_set")
_PACKAGES = ("numpy", "scipy", "numba", "matplotlib", "msgspec")


class Reproduction(msgspec.Struct, frozen=True, kw_only=True):
    """Everything measured, the claims it was held against, and name -> path of what was written."""

    result: StudyResult
    claims: list[Claim]
    files: dict[str, Path]


class Column(msgspec.Struct, frozen=True):
    """A quantity of a table: its title, and the metric whose mean over the runs it shows.

    paper, ratio: the text has the paper's number beside ours, and what ours is of it. decimals: None for as many as
    the number's size wants.
    """

    title: str
    metric: str
    paper: bool = False
    ratio: bool = False
    decimals: int | None = None


class Line(msgspec.Struct, frozen=True):
    """A method's row: ours, and the paper's number for each column, where it gives any."""

    ours: Summary
    paper: tuple[float | None, ...] | None = None


class PaperTable(msgspec.Struct, frozen=True):
    """Methods against quantities. first: what the methods are called. paper_runs: how many the paper's means are of."""

    title: str
    first: str
    columns: tuple[Column, ...]
    lines: tuple[Line, ...]
    note: str
    paper_runs: int

    def page(self) -> StudyTable:
        """For the report page: ours, and below it the paper's."""
        rows = []
        for line in self.lines:
            ours = (*(line.ours.mean[column.metric] for column in self.columns), float(line.ours.runs))
            paper = None if line.paper is None else (*line.paper, float(self.paper_runs))
            rows.append(StudyRow(line.ours.method, ours, paper))
        titles = (*(column.title for column in self.columns), "n")
        decimals = (*(column.decimals for column in self.columns), 0)
        return StudyTable(self.title, titles, tuple(rows), self.note, decimals)

    def markdown(self) -> str:
        """For a text: the paper's number, and the ratio, in columns of their own."""
        head = [self.first, "n"]
        for column in self.columns:
            head += [column.title, *["paper"] * column.paper, *["ratio"] * column.ratio]
        lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
        lines += [f"| {' | '.join(self._cells(line))} |" for line in self.lines]
        return "\n".join(lines)

    def _cells(self, line: Line) -> list[str]:
        failed = f" ({line.ours.failed} failed)" if line.ours.failed else ""
        cells = [line.ours.method, f"{line.ours.runs}{failed}"]
        paper = line.paper or (None,) * len(self.columns)
        for column, theirs in zip(self.columns, paper, strict=True):
            ours = line.ours.mean[column.metric]
            cells.append(_number(ours, column.decimals))
            cells += [_number(theirs, column.decimals)] * column.paper
            cells += [_number(ours / theirs if ours and theirs else None)] * column.ratio
        return cells


class PaperReport(msgspec.Struct, frozen=True):
    """All that is said of a reproduction. about: what a reader must know before the numbers."""

    title: str
    tables: tuple[PaperTable, ...]
    claims: list[Claim]
    warnings: Sequence[str] = ()
    about: Sequence[str] = ()

    def markdown(self) -> str:
        """The tables beside the paper's numbers, and the claims."""
        parts = [f"# {self.title}", *(f"**{warning}**" for warning in self.warnings), *self.about]
        for table in self.tables:
            parts += [f"## {table.title}", table.markdown(), table.note]
        parts += ["## Claims", f"{tally(self.claims)}.", claims_markdown(self.claims)]
        return "\n\n".join(parts)

    def write(
        self,
        out: Path,
        name: str,
        result: StudyResult,
        cases: Sequence[Case],
        started: datetime,
        figures: Mapping[str, tuple[Figure, str]],
        **facts: Any,
    ) -> dict[str, Path]:
        """Write `<name>.md`, `<name>.csv`, `runs.csv`, `claims.json`, `manifest.json`, `report.html` and the figures.

        figures: name -> figure and caption. facts: said in `claims.json` too. Returns the paths by name.
        """
        manifest = study_manifest(cases, started)
        pictures = save_figures(out / "figures", {key: figure for key, (figure, _) in figures.items()})
        page = render_study(
            self.title,
            [claims_table(self.claims), *(table.page() for table in self.tables)],
            figures={caption: pictures[key].read_bytes() for key, (_, caption) in figures.items()},
            manifest=manifest,
            lead=tally(self.claims),
            about=self.about,
            warnings=self.warnings,
        )
        texts = {
            f"{name}.md": self.markdown(),
            f"{name}.csv": summary_csv(result),
            "runs.csv": runs_csv(result),
            "claims.json": json_text({**facts, "warnings": self.warnings, "claims": self.claims}),
            "manifest.json": json_text(manifest),
            "report.html": page,
        }
        for file, text in texts.items():
            write_atomically(out / file, text.encode())
        return {
            **{file: out / file for file in texts},
            **{f"figures/{key}.png": path for key, path in pictures.items()},
        }


def given_up(result: StudyResult) -> list[str]:
    """Warnings of runs that came to no end, with what made the filters give up."""
    failed = sum(record.error is not None for record in result.records)
    if not failed:
        return []
    said = f"{failed} of {len(result.records)} runs were given up and are in no number below."
    return [said, *result.failures()]


def study_manifest(cases: Sequence[Case], started: datetime) -> Manifest:
    """What a study was made from: worlds (their maps by hash), methods, seeds, and the program."""
    worlds = {case.world.name: json_ready(case.world) for case in cases}
    settings = {
        name: {key: value for key, value in world.items() if key not in ("landmarks", "waypoints")}
        for name, world in worlds.items()
    }
    methods = {case.method.name: case.config() for case in cases}
    return Manifest(
        kalmap=kalmap.__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        packages={name: version(name) for name in _PACKAGES},
        command=" ".join(sys.argv),
        log=" and ".join(worlds),
        source=" and ".join(_sources(cases)),
        data_sha256={
            name: hashlib.sha256(msgspec.json.encode(world, order="deterministic")).hexdigest()
            for name, world in worlds.items()
        },
        seed=min(case.seed for case in cases),
        config={
            "seeds": sorted({case.seed for case in cases}),
            "methods": {
                name: {part: json_ready(getattr(config, part)) for part in _OF_METHOD}
                for name, config in methods.items()
            },
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


def _sources(cases: Sequence[Case]) -> list[str]:
    """Where the logs came from, each once."""
    places = (case.world.path if isinstance(case.world, Recorded) else "simulated" for case in cases)
    return list(dict.fromkeys(places))


def _number(value: float | None, decimals: int | None = None) -> str:
    if value is None:
        return ""
    if decimals is not None:
        return f"{value:.{decimals}f}"
    return f"{value:.4g}" if abs(value) < 0.1 else f"{value:.3f}"
