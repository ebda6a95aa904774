"""What `association_tables.py` writes: a table a world, a table a log, and what went wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import association_cases as cases
import numpy as np
import report
from association_cases import LIMIT, Record

GROWN = 4.0  # times the true number of features: a map without bound
LOST_NEES = 30.0  # ten times what is right: the filter is sure of a wrong place

# title, key, decimals, what is best: the highest, the lowest, or the one nearest to a number
Column = tuple[str, str, int, Callable[[float, Record], float]]


def _high(value: float, record: Record) -> float:
    return -value


def _low(value: float, record: Record) -> float:
    return value


def _as_many(value: float, record: Record) -> float:
    return abs(value - record["true_landmarks"])


def _three(value: float, record: Record) -> float:
    return abs(math.log(max(value, 1e-9) / 3.0))


WORLD_COLUMNS: tuple[Column, ...] = (
    ("accuracy", "association_accuracy", 3, _high),
    ("F1", "association_f1", 3, _high),
    ("landmarks", "landmarks", 1, _as_many),
    ("duplicates", "association_duplicate_landmarks", 1, _low),
    ("spurious", "association_spurious_landmarks", 1, _low),
    ("in the state", "state_landmarks", 1, _low),
    ("position RMS m", "position_rmse_m", 2, _low),
    ("NEES (3)", "nees_mean", 1, _three),
    ("ms a frame", "association_ms", 3, _low),
)
LOG_COLUMNS: tuple[Column, ...] = (
    ("F1", "association_f1", 3, _high),
    ("precision", "association_precision", 3, _high),
    ("recall", "association_recall", 3, _high),
    ("landmarks", "landmarks", 0, _as_many),
    ("duplicates", "association_duplicate_landmarks", 0, _low),
    ("landmark RMS m", "feature_aligned_rmse_m", 2, _low),
    ("path median m", "path_median_m", 2, _low),
    ("path trimmed RMS m", "path_trimmed_m", 2, _low),
    ("filter s", "runtime_cpu_s", 1, _low),
    ("association s", "association_cpu_s", 1, _low),
    ("all s", "total_cpu_s", 1, _low),
)
PARK = {
    "F1": ("association_f1", 0.97, None),
    "landmarks": ("landmarks", 250, 350),
    "landmark RMS": ("feature_aligned_rmse_m", None, 0.8),
    "median": ("path_median_m", None, 1.5),
    "trimmed RMS": ("path_trimmed_m", None, 2.5),
    "association s": ("association_cpu_s", None, 2.0),
    "all s": ("total_cpu_s", None, 10.0),
}
# the same loosened by a fifth; the times are asked for as they are
SCANS = PARK | {
    "F1": ("association_f1", 1.0 - 1.2 * 0.03, None),
    "landmarks": ("landmarks", 240, 360),
    "landmark RMS": ("feature_aligned_rmse_m", None, 0.96),
    "median": ("path_median_m", None, 1.8),
    "trimmed RMS": ("path_trimmed_m", None, 3.0),
}
ASKED: dict[str, dict[str, tuple[str, float | None, float | None]]] = {
    "car park": {"landmarks": ("landmarks", 15, 15)},
    "Victoria Park, ids hidden": PARK,
    "Victoria Park, detections": PARK,
    "Victoria Park, scans": SCANS,
}
FEATURES = {"car park": 15, "DLR": 549}
PARK_FEATURES, MRCLAM_FEATURES, MRCLAM_F1 = 299, 15, 0.95


def table(
    rows: Sequence[Record], columns: Sequence[Column], extra: Callable[[Record], list[str]], head: list[str]
) -> str:
    """Methods as rows; of each column the best is bold and the worst marked, the limit left out of the contest."""
    marked = [_marks(rows, column) for column in columns]
    cells = [[row["method"], *(marks[k] for marks in marked), *extra(row)] for k, row in enumerate(rows)]
    return report.table(("method", *(column[0] for column in columns), *head), cells)


def _marks(rows: Sequence[Record], column: Column) -> list[str]:
    """A column's cells. Values that look alike in the table share a mark; where all do there is none."""
    _, key, decimals, order = column
    texts = [None if row.get(key) is None else f"{row[key]:.{decimals}f}" for row in rows]
    contest = {
        text: order(float(text), row)
        for text, row in zip(texts, rows, strict=True)
        if text is not None and row["method"] != LIMIT
    }
    best, worst = (min(contest.values()), max(contest.values())) if contest else (0.0, 0.0)
    cells = []
    for text, row in zip(texts, rows, strict=True):
        if text is None or row["method"] == LIMIT or best == worst:
            cells.append(text or "-")
        else:
            cells.append({best: f"**{text}**", worst: f"{text} ▼"}.get(contest[text], text))
    return cells


def mean_row(runs: Sequence[Record]) -> Record:
    """The mean over the finished runs of a method in a world, for every number."""
    finished = [run for run in runs if run["error"] is None]
    row: Record = {"method": runs[0]["method"], "runs": len(finished), "failed": len(runs) - len(finished)}
    for key in {key for run in finished for key in run}:
        known = [run[key] for run in finished if isinstance(run.get(key), (int, float))]
        if known:
            row[key] = float(np.mean(known))
    return row


def world_section(name: str, records: Sequence[Record]) -> str:
    """One world: the table, and what went wrong."""
    runs = [record for record in records if (record["part"], record["where"]) == ("worlds", name)]
    groups = [
        [r for r in runs if r["method"] == method] for method in dict.fromkeys(r["method"] for r in runs)
    ]
    rows = [mean_row(group) for group in groups]
    true = next((r["true_landmarks"] for r in runs if r["error"] is None), None)
    text = table(rows, WORLD_COLUMNS, lambda row: [str(row["runs"]), str(row["failed"])], ["runs", "failed"])
    return "\n".join([f"### {name}: {true:g} features\n", text, "", *world_notes(groups)])


def _indefinite(record: Record) -> bool:
    return record.get("least_eigenvalue", 1.0) <= 0.0


def world_notes(groups: Sequence[Sequence[Record]]) -> list[str]:
    """Maps without bound, states without bound, filters that are sure of a wrong place, runs that failed."""
    notes = []
    for text, wrong in (
        (
            f"Map grown beyond {GROWN:g} times the true number",
            lambda r: r["landmarks"] > GROWN * r["true_landmarks"],
        ),
        (
            f"State grown beyond {GROWN:g} times the true number (landmarks on trial)",
            lambda r: r["state_landmarks"] > GROWN * r["true_landmarks"],
        ),
        (f"NEES beyond {LOST_NEES:g}", lambda r: r.get("nees_mean", 0.0) > LOST_NEES),
        ("Covariance not positive", lambda r: _indefinite(r)),
    ):
        found = []
        for group in groups:
            count = sum(r["error"] is None and bool(wrong(r)) for r in group)
            found += [f"{group[0]['method']} ({count} of {len(group)})"] if count else []
        notes += [f"- {text}: {'; '.join(found)}."] if found else []
    errors = [
        f"- {r['method']}, seed {r['seed']}: {r['error']}."
        for g in groups
        for r in g
        if r["error"] is not None
    ]
    return notes + errors or [
        "- Nothing grew without bound, no filter was sure of a wrong place, no run failed."
    ]


def log_row(record: Record) -> Record:
    """A log's record with its path errors under one name, against GPS where there is any."""
    name = record["where"]
    if record["error"] is not None:
        return {key: record[key] for key in ("where", "method", "error")}
    gps = "gps_" if record.get("gps_ate_aligned_median_m") is not None else ""
    true = PARK_FEATURES if name.startswith("Victoria") else FEATURES.get(name, MRCLAM_FEATURES)
    return record | {
        "true_landmarks": true,
        "path_median_m": record.get(f"{gps}ate_aligned_median_m"),
        "path_trimmed_m": record.get(f"{gps}ate_aligned_trimmed_rmse_m"),
    }


def missed(row: Record) -> list[str]:
    """What is asked for on this log and not reached."""
    if row["error"] is not None:
        return [f"failed: {row['error']}"]
    asked = ASKED.get(row["where"])
    if asked is None or row["method"] == LIMIT:
        return ["-"]
    short = [
        title
        for title, (key, low, high) in asked.items()
        if row.get(key) is None
        or (low is not None and row[key] < low)
        or (high is not None and row[key] > high)
    ]
    return [", ".join(short) or "nothing"]


def log_section(name: str, records: Sequence[Record]) -> str:
    """One log that has a table of its own."""
    rows = [log_row(r) for r in records if (r["part"], r["where"]) == ("logs", name)]
    return "\n".join([f"### {name}\n", table(rows, LOG_COLUMNS, missed, ["misses"]), ""])


def mrclam_section(records: Sequence[Record]) -> str:
    """The robots of MRCLAM: F1 of every robot and method, and landmarks in the map."""
    rows = [r for r in records if r["part"] == "logs" and r["where"].startswith("MRCLAM")]
    names, methods = (list(dict.fromkeys(r[key] for r in rows)) for key in ("where", "method"))
    by = {(r["where"], r["method"]): r for r in rows}
    cells = []
    for name in names:
        line = []
        for method in methods:
            r = by.get((name, method), {})
            if r.get("error") is not None:
                line.append("failed")
                continue
            f1, count = r.get("association_f1"), r.get("landmarks")
            short = f1 is not None and f1 < MRCLAM_F1
            shown = "" if f1 is None else f"{f1:.3f}{' ▼' if short else ''}, "
            line.append("-" if count is None else f"{shown}{count}")
        cells.append([name, *line])
    reached = []
    for method in methods:
        runs = [by[name, method] for name in names if (name, method) in by]
        known = [
            r["association_f1"] for r in runs if r["error"] is None and r.get("association_f1") is not None
        ]
        met = sum(f1 >= MRCLAM_F1 for f1 in known)
        reached.append(f"{met} of {len(runs)}; worst {min(known):.3f}" if known else "-")
    cells.append([f"F1 >= {MRCLAM_F1}", *reached])
    return "\n".join(
        [
            f"### MRCLAM 1 and 9: F1 (▼: below {MRCLAM_F1}), landmarks of the last map ({MRCLAM_FEATURES} are real)\n",
            report.table(("robot", *methods), cells),
            "",
        ]
    )


def text_of(records: Sequence[Record]) -> str:
    """The whole page."""
    places = list(dict.fromkeys((r["part"], r["where"]) for r in records))
    order = {name: k for k, name in enumerate((*cases.WORLDS, *cases.LOGS))}
    found = sorted(places, key=lambda place: order[place[1]])
    parts = ["# Associators against the worlds made to break them, and on real logs\n", ABOUT]
    worlds = [name for part, name in found if part == "worlds"]
    logs = [name for part, name in found if part == "logs"]
    if worlds:
        parts += ["## Worlds\n", WORLDS_ABOUT, *(world_section(name, records) + "\n" for name in worlds)]
    if logs:
        parts += ["## Real logs\n", LOGS_ABOUT]
        parts += [log_section(name, records) for name in logs if not name.startswith("MRCLAM")]
        parts += [mrclam_section(records)] if any(name.startswith("MRCLAM") for name in logs) else []
    return "\n".join(parts)


ABOUT = """\
Of each column the best is **bold** and the worst marked ▼; `known`, the filter that is told the identities, is the
limit and takes no part. accuracy: sightings decided rightly; F1: pairs of sightings said to be of one feature.
"""
WORLDS_ABOUT = """\
Means over the seeds. duplicates: landmarks of the last map beyond the first of a feature; spurious: those that are of
none; in the state: all that the filter carries, on trial too; NEES: 3 is right; ms a frame: the association alone, by
the clock. A landmark is believed in by its existence probability, but for djnn (an information counter of two) and
"trial" (two sightings in thirty frames that could see it).
"""
LOGS_ABOUT = """\
Settings are each log's own, only the method changes. landmark RMS: against the batch solution or the survey, paired by
nearest and aligned; path: the antenna against GPS, of DLR the robot against the batch solution, aligned. all s:
reading, detecting, associating and filtering, CPU seconds; filter s and association s: their shares of that by the
filter's own clock. misses: what is asked for and not reached; of raw scans the bars are
loosened by a fifth (F1 0.964, landmarks 240 to 360, landmark RMS 0.96 m, median 1.8 m, trimmed RMS 3 m). Nobody says
what the car park's reflections are of, so it has no F1.
"""
