"""Tables for people and files for later."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from programs import machine

RESULTS = Path(__file__).resolve().parent / "results"


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A markdown table; floats with three significant digits, None as a dash."""
    cells = [[_text(cell) for cell in row] for row in rows]
    lines = [_row(row) for row in (header, ["---"] * len(header), *cells)]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(cell: object) -> str:
    if cell is None:
        return "-"
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)


def kept(name: str, again: list[str]) -> list[dict[str, Any]]:
    """The records of the last run's other worlds; each names the commit that it measured."""
    file = RESULTS / f"{name}.json"
    found = json.loads(file.read_text())["records"] if file.is_file() else []
    return [record for record in found if record["world"] not in again]


def write(name: str, text: str, records: Sequence[Mapping[str, Any]]) -> None:
    """Leave the text in results/ as NAME.md, the records as .csv and, with the machine, .json; print it."""
    RESULTS.mkdir(exist_ok=True)
    about = machine()
    told = ", ".join(f"{key} {value}" for key, value in about.items() if value is not None)
    text = f"{text}\n\nMeasured: {told}."
    print(text)
    (RESULTS / f"{name}.md").write_text(text + "\n")
    whole = {"machine": about, "records": list(records)}
    (RESULTS / f"{name}.json").write_text(json.dumps(whole, indent=1) + "\n")
    columns = list(dict.fromkeys(key for record in records for key in record))
    with (RESULTS / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(records)
