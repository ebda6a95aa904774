"""What `finite_sets.py` writes: what was asked, published and got, and the tables behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import finite_sets_cases as cases
import numpy as np
import report
from finite_sets_cases import CAR_PARK, CLUTTERED, LIMIT, PLAIN, Job, Record

Column = tuple[str, str, str]  # title, key, format
Bar = tuple[str, str, str, str, str]  # what, asked, published, got, whether it is reached

NEES = "nees"  # one decimal, or as a power where it is beyond all sense
TIME: Column = ("CPU ms a frame", "cpu_ms", ".3f")
CLUTTER_COLUMNS: tuple[Column, ...] = (
    ("position RMS m", "position_rmse_m", ".2f"),
    ("heading RMS deg", "heading_rmse_deg", ".2f"),
    ("OSPA m", "ospa_m", ".2f"),
    ("GOSPA m", "gospa_m", ".1f"),
    ("features off", "off", ".1f"),
    ("OSPA in the course", "ospa_course_m", ".2f"),
    ("F1", "association_f1", ".3f"),
    ("NEES (3)", "nees_mean", NEES),
    TIME,
    ("ms by the clock", "clock_ms", ".3f"),
)
FIELD_COLUMNS: tuple[Column, ...] = (
    ("position RMS m", "position_rmse_m", ".2f"),
    ("worst seed", "worst_m", ".2f"),
    ("heading RMS deg", "heading_rmse_deg", ".2f"),
    ("GOSPA m", "gospa_m", ".1f"),
    ("landmarks", "landmarks", ".1f"),
    ("NEES (3)", "nees_mean", NEES),
    ("CPU ms a step", "cpu_ms", ".3f"),
    ("ms by the clock", "clock_ms", ".3f"),
)
RFS_COLUMNS: tuple[Column, ...] = (
    ("position mean m", "position_mean_m", ".3f"),
    ("OSPA m", "ospa_m", ".3f"),
    ("landmarks", "landmarks", ".1f"),
    ("us a particle and step", "particle_us", ".2f"),
    ("CPU ms a step", "cpu_ms", ".2f"),
)
PARK_COLUMNS: tuple[Column, ...] = (
    ("aligned RMSE m", "path_m", ".2f"),
    ("trimmed by a tenth", "path_trimmed_m", ".2f"),
    ("landmarks", "landmarks", ".0f"),
    ("CPU s", "total_cpu_s", ".1f"),
    ("times real time", "faster", ".0f"),
)
CAR_COLUMNS: tuple[Column, ...] = (
    ("aligned path RMSE m", "path_m", ".3f"),
    ("worst run", "worst_path_m", ".3f"),
    ("poles", "landmarks", ".1f"),
    ("runs with 14 to 16", "right", ".0f"),
    ("OSPA to the survey m", "ospa_m", ".2f"),
    ("CPU s", "total_cpu_s", ".2f"),
)
PUBLISHED_FIELD = {1: (3.45, 0.42, 46.8), 10: (2.66, 0.34, 38.3), 100: (2.18, 0.29, 32.1)}
# of RFS-SLAM: position error m and ms a step of 200 particles, by world and method
PUBLISHED_RFS = {
    ("rfs-99-0", "rb-phd"): (".082", 15.0), ("rfs-99-0", "mh-fastslam"): (".040", 6.8),
    ("rfs-90-1", "rb-phd"): (".039", 15.7), ("rfs-90-1", "mh-fastslam"): (".034", 19.6),
    ("rfs-70-6", "rb-phd"): (".027", 15.0), ("rfs-70-6", "mh-fastslam"): ("-", 400.0),
    ("rfs-50-13", "rb-phd"): (".055", 26.0),
}  # fmt: skip
FIELD_MS, RFS_US, PARK_M, PARK_LANDMARKS, FASTER, CAR_M = 1.0, 62.0 / 4.0, 2.5, (250, 350), 20.0, 0.6
LINEAR = 1.15


# --- rows -----------------------------------------------------------------------------------------------------------


def extended(r: Record) -> Record:
    """A run with what follows from its numbers."""
    more: Record = {}
    if "cardinality_error" in r:
        more["off"] = abs(r["cardinality_error"])
    if "runtime_s" in r:
        more["clock_ms"] = 1e3 * r["runtime_s"] / r["frames"]
        more["faster"] = r["log_s"] / r["total_cpu_s"]
        more["particle_us"] = 1e3 * r["cpu_ms"] / (r["particles"] or 1)
        more["right"] = float(14 <= r["landmarks"] <= 16)
        gps = "gps_" if "gps_ate_aligned_rmse_m" in r else ""
        more["path_m"] = r.get(f"{gps}ate_aligned_rmse_m")
        more["path_trimmed_m"] = r.get(f"{gps}ate_aligned_trimmed_rmse_m")
    return r | more


def rows_of(records: Sequence[Record], part: str, where: str | None = None) -> list[Record]:
    """A mean over the seeds for each method, as the jobs are ordered."""
    chosen = [r for r in records if r["part"] == part and where in (None, r["where"])]
    rows = []
    for name in dict.fromkeys(r["method"] for r in chosen):
        runs = [extended(r) for r in chosen if r["method"] == name]
        good = [r for r in runs if r["error"] is None]
        row: Record = {"method": name, "runs": len(good), "failed": len(runs) - len(good)}
        for key in dict.fromkeys(key for r in good for key in r):
            known = [r[key] for r in good if isinstance(r.get(key), (int, float))]
            if known and not isinstance(known[0], bool):
                row[key] = float(np.mean(known))
        if good:
            row["worst_m"] = max((r["position_rmse_m"] for r in good if "position_rmse_m" in r), default=None)
            row["worst_path_m"] = max(
                (r["path_m"] for r in good if r.get("path_m") is not None), default=None
            )
            row["right"] = float(sum(r.get("right", 0.0) for r in good))
        rows.append(row)
    return rows


def _told(value: float | None, form: str) -> str:
    if value is None:
        return "-"
    if form == NEES:
        form = ".1f" if abs(value) < 1e3 else ".0e"
    return f"{value:{form}}"


def table(
    rows: Sequence[Record],
    columns: Sequence[Column],
    head: Sequence[str] = (),
    extra: Callable[[Record], list[str]] = lambda row: [],
) -> str:
    """Methods as rows."""
    cells = []
    for row in rows:
        told = [_told(row.get(key), form) for _, key, form in columns]
        cells.append([row["method"], *told, *extra(row), str(row["runs"]), str(row["failed"])])
    return report.table(("method", *(column[0] for column in columns), *head, "seeds", "failed"), cells)


# --- sections -------------------------------------------------------------------------------------------------------


def clutter_section(records: Sequence[Record]) -> str:
    """Set filters against associators."""
    errors = [
        f"- {r['method']}, seed {r['seed']}: {r['error']}, in frame {r.get('reached_frames', 0)}."
        for r in records
        if r["part"] == "clutter" and r["error"] is not None
    ]
    told = table(rows_of(records, "clutter"), CLUTTER_COLUMNS)
    return "\n".join(["### clutter-20-70: 35 features\n", told, "", *errors])


def _number(method: str) -> int:
    return int(method.split(", ")[1]) if ", " in method else 0


def field_section(records: Sequence[Record]) -> str:
    """PHD-SLAM 3.0's world."""

    def published(row: Record) -> list[str]:
        found = PUBLISHED_FIELD.get(_number(row["method"]))
        return ["-"] if found is None else [f"{found[0]} m, {found[1]} deg, {found[2]}"]

    rows = sorted(rows_of(records, "field"), key=lambda row: (_number(row["method"]), row["method"]))
    return "### field-160: 160 landmarks\n\n" + table(rows, FIELD_COLUMNS, ["PHD-SLAM 3.0"], published)


def rfs_section(records: Sequence[Record]) -> str:
    """RFS-SLAM's grid."""
    texts = []
    for where in cases.RFS:

        def published(row: Record, where: str = where) -> list[str]:
            found = PUBLISHED_RFS.get((where, row["method"]))
            return (
                ["-"]
                if found is None
                else [f"{found[0]} m, {found[1]:g} ms a step ({found[1] / 0.2:.0f} us)"]
            )

        rows = rows_of(records, "rfs", where)
        if rows:
            texts += [f"### {where}: 50 features\n\n" + table(rows, RFS_COLUMNS, ["RFS-SLAM"], published)]
    return "\n\n".join(texts)


def park_misses(row: Record) -> list[str]:
    """What is asked for in Victoria Park and not reached."""
    if row["runs"] == 0:
        return ["failed"]
    low, high = PARK_LANDMARKS
    short = [
        what
        for what, met in (
            ("path", row["path_m"] <= PARK_M),
            ("landmarks", low <= row["landmarks"] <= high),
            ("time", row["faster"] >= FASTER),
        )
        if not met
    ]
    return [", ".join(short) or "nothing"]


def logs_section(records: Sequence[Record]) -> str:
    """Recorded logs."""
    texts = []
    for where in (PLAIN, CLUTTERED):
        rows = rows_of(records, "logs", where)
        if rows:
            texts += [f"### {where}\n\n" + table(rows, PARK_COLUMNS, ["misses"], park_misses)]
    rows = rows_of(records, "logs", CAR_PARK)
    if rows:
        texts += [f"### {CAR_PARK}: 15 poles\n\n" + table(rows, CAR_COLUMNS)]
    return "\n\n".join(texts)


def slopes_of(records: Sequence[Record]) -> list[Record]:
    """Fitted exponents: ms a frame against what grows, over all points and over the upper half."""
    found = []
    chosen = [r for r in records if r["part"] == "slopes" and r["error"] is None]
    for what, against in (("particles", "particles"), ("features", "mapped"), ("clutter", "seen")):
        for name in ("pmb", "rb-phd"):
            runs = [r for r in chosen if r["where"].split()[0] == what and r["method"] == name]
            if len(runs) < 3:
                continue
            x, y = (np.log([float(r[key]) for r in runs]) for key in (against, "cpu_ms"))
            upper = len(runs) // 2
            found.append(
                {
                    "what": what, "against": against, "method": name, "points": runs,
                    "slope": float(np.polyfit(x, y, 1)[0]), "upper": float(np.polyfit(x[upper:], y[upper:], 1)[0]),
                }
            )  # fmt: skip
    return found


def slopes_section(records: Sequence[Record]) -> str:
    """The points and their slopes."""
    units = {"particles": "particles", "mapped": "components of the map", "seen": "sightings a frame"}
    rows = []
    for fit in slopes_of(records):
        points = "; ".join(f"{r[fit['against']]:.0f}: {r['cpu_ms']:.2f}" for r in fit["points"])
        rows.append(
            [
                fit["what"],
                fit["method"],
                units[fit["against"]],
                points,
                f"{fit['slope']:.2f}",
                f"{fit['upper']:.2f}",
            ]
        )
    head = ("what grows", "method", "against", "CPU ms a frame", "slope", "slope of the upper half")
    return report.table(head, rows) if rows else ""


# --- asked, published, got ------------------------------------------------------------------------------------------


def _bar(what: str, asked: str, published: str, got: str, met: bool) -> Bar:
    return what, asked, published, got, "yes" if met else "no"


def _finished(records: Sequence[Record], part: str, where: str | None = None) -> dict[str, Record]:
    """The rows of the methods with a run that went well, by method."""
    return {row["method"]: row for row in rows_of(records, part, where) if row["runs"]}


def clutter_bars(records: Sequence[Record]) -> list[Bar]:
    """The filters with identities against the density."""
    found, clutter = [], _finished(records, "clutter")
    for name in ("pmb", "pmbm"):
        if name in clutter and "rb-phd" in clutter:
            mine, other = clutter[name], clutter["rb-phd"]
            keys = (("position_rmse_m", "m"), ("ospa_m", "m OSPA"), ("off", "features off"))
            told = [f"{mine[key]:.2f} against {other[key]:.2f} {unit}" for key, unit in keys]
            leads = all(mine[key] < other[key] for key, _ in keys)
            found.append(_bar(f"clutter-20-70: {name} leads rb-phd", "leads", "-", ", ".join(told), leads))
    return found


def field_bars(records: Sequence[Record]) -> list[Bar]:
    """PHD-SLAM 3.0's figures and its time, with the limit before them."""
    found, field = [], _finished(records, "field")

    def got(row: Record) -> str:
        return f"{row['position_rmse_m']:.2f} m, {row['gospa_m']:.1f} GOSPA, seeds: {row['runs']}"

    if LIMIT in field:
        found.append((f"field-160: {LIMIT}, the limit", "-", "-", got(field[LIMIT]), "-"))
    for number, (metres, _, gospa) in PUBLISHED_FIELD.items():
        for name in ("pmb", "rb-phd", "srckf-phd", "mh-fastslam", "pmbm"):
            row = field.get(f"{name}, {number}")
            if row:
                met = row["position_rmse_m"] < metres and row["gospa_m"] < gospa
                asked, published = f"below {metres} m and {gospa}", f"{metres} m, {gospa} GOSPA"
                found.append(_bar(f"field-160: {name}, {number}", asked, published, got(row), met))
    for name in (*cases.PARTICLES, "pmbm"):
        row = field.get(f"{name}, 10")
        if row:
            told, met = f"{row['cpu_ms']:.2f} ms", row["cpu_ms"] <= FIELD_MS
            found.append(
                _bar(f"field-160: time of {name}, 10", f"{FIELD_MS:g} ms a step", "80 ms", told, met)
            )
    return found


def rfs_bars(records: Sequence[Record]) -> list[Bar]:
    """RFS-SLAM's time, and its order of the methods where nothing is in doubt."""
    found = []
    for where in cases.RFS:
        rows = _finished(records, "rfs", where)
        for name, row in rows.items():
            if name != "pmbm":
                asked, told = f"{RFS_US:.1f} us a particle and step", f"{row['particle_us']:.1f} us"
                met = row["particle_us"] <= RFS_US
                found.append(_bar(f"{where}: time of {name}", asked, "62 us", told, met))
        rival = rows.get("mh-fastslam")
        for name, row in rows.items():
            if rival and where == "rfs-99-0" and name != "mh-fastslam":
                mine, other = row["position_mean_m"], rival["position_mean_m"]
                told = f"{mine:.3f} against {other:.3f} m"
                what = f"{where}: {name} not worse than mh-fastslam"
                found.append(_bar(what, "not worse", "rb-phd .082 to .040 m", told, mine <= other))
    return found


def park_bars(records: Sequence[Record]) -> list[Bar]:
    """Victoria Park, as it is and with clutter."""
    found = []
    for where in (PLAIN, CLUTTERED):
        for name, row in _finished(records, "logs", where).items():
            asked = "2.5 m, 250 to 350 landmarks, 20 times real time"
            published = "2.46 m; PHD-SLAM 3.0 3.36 m"
            met = park_misses(row) == ["nothing"]
            told = f"{row['path_m']:.2f} m, {row['landmarks']:.0f}, {row['faster']:.0f} times"
            found.append(_bar(f"{where}: {name}", asked, published, told, met))
    return found


def car_bars(records: Sequence[Record]) -> list[Bar]:
    """The car park, and its two densities side by side."""
    found, car = [], _finished(records, "logs", CAR_PARK)
    for name, row in car.items():
        told = f"{row['path_m']:.3f} m; {row['right']:.0f} of {row['runs']} runs with 14 to 16 poles"
        met = row["path_m"] <= CAR_M and row["right"] == row["runs"]
        found.append(_bar(f"car park: {name}", "0.6 m, 14 to 16 poles", "-", told, met))
    if "srckf-phd" in car and "rb-phd" in car:
        mine, other = car["srckf-phd"]["path_m"], car["rb-phd"]["path_m"]
        told = f"{mine:.3f} against {other:.3f} m"
        found.append(_bar("car park: srckf-phd below rb-phd", "below", "below", told, mine < other))
    return found


def slope_bars(records: Sequence[Record]) -> list[Bar]:
    """Time against what grows."""
    found = []
    for fit in slopes_of(records):
        told = f"slope {fit['slope']:.2f}, upper half {fit['upper']:.2f}"
        linear = max(fit["slope"], fit["upper"]) <= LINEAR
        what = f"time of {fit['method']} against {fit['what']}"
        found.append(_bar(what, "linear (slope 1)", "-", told, linear))
    return found


def bars(records: Sequence[Record]) -> list[Bar]:
    """All that is asked, in the order of the page's table."""
    parts = (clutter_bars, field_bars, rfs_bars, park_bars, car_bars, slope_bars)
    return [bar for part in parts for bar in part(records)]


def missing_text(missing: Sequence[Job]) -> str:
    """What was not run."""
    if not missing:
        return "Every run was finished."
    groups: dict[tuple[str, str], dict[str, list[int]]] = {}
    for job in missing:
        groups.setdefault((job.part, job.where), {}).setdefault(job.method, []).append(job.seed)
    lines = []
    for (part, where), methods in groups.items():
        alike: dict[tuple[int, ...], list[str]] = {}
        for name, seeds in methods.items():
            alike.setdefault(tuple(seeds), []).append(name)
        told = [f"{'; '.join(names)} (seeds {', '.join(map(str, seeds))})" for seeds, names in alike.items()]
        lines.append(f"- {part}, {where}: {' / '.join(told)}.")
    return "\n".join(["Asked for and not run:\n", *lines])


def text_of(records: Sequence[Record], missing: Sequence[Job]) -> str:
    """The whole page."""
    loads = [r["load"] for r in records]
    busy = f"{min(loads):.1f} to {max(loads):.1f}" if loads else "-"
    parts = ["# Filters of random finite sets\n", ABOUT.format(load=busy, limit=LIMIT)]
    parts += [report.table(("what", "asked", "published", "got", "reached"), bars(records)) + "\n"]
    for title, about, section in (
        ("Heavy clutter: set filters and associators", CLUTTER_ABOUT, clutter_section),
        ("The world of PHD-SLAM 3.0", FIELD_ABOUT, field_section),
        ("Recorded logs", LOGS_ABOUT, logs_section),
        ("The grid of RFS-SLAM", RFS_ABOUT, rfs_section),
        ("Time", SLOPES_ABOUT, slopes_section),
    ):
        parts += [f"## {title}\n", about, section(records) + "\n"]
    return "\n".join([*parts, "## What is missing\n", missing_text(missing)])


ABOUT = """\
Means over the seeds that were finished (`seeds`). One thread. "CPU ms" is the filter's own time without what other
programs took of the processor meanwhile, "by the clock" with it: the machine's load (its mean over a minute) was
{load} on its two cores when the runs began. Caches and memory were shared all the same, so on an idle machine times
are shorter. Particles draw from the sightings' proposal unless a row says otherwise. pmbm's number is that of its
explanations. {limit}: the limit, a Kalman filter that is told the identities.
"""
CLUTTER_ABOUT = """\
20 false sightings a frame, P_D 0.7. Set filters have 10 particles, pmbm 10 explanations. Every method is told P_D and
clutter, the associators by their settings `detection` and `false_rate`; all else is the default. OSPA (order 2,
cut-off 10 m) and GOSPA (order 2, cut-off 20 m) are of the last map, OSPA in the course is its mean over time, features
off the mean of how many too many or too few the last map holds.
"""
FIELD_ABOUT = """\
4,000 steps, P_D 0.95, clutter 5; GOSPA of order 2 with a cut-off of 20 m. The published figures are over 100 runs in
its own world, whose map and way are not known: this one is like it, not the same.
"""
LOGS_ABOUT = """\
Settings are the log's own, with 10 particles (10 explanations). Path against GPS after the best rigid alignment, over
all instants. CPU s: all of the run. Clutter 5: a Poisson number of false sightings in every frame, uniform in range and
bearing; the filters are told of five more. The data is the same in all runs, the seed is the method's; pmbm draws
nothing and has one run.
"""
RFS_ABOUT = """\
200 particles, pmbm 10 explanations (its time is by explanation). OSPA of order 2; its cut-off is a sixth of 10 m, as
the sensor reaches 2.5 m. RFS-SLAM's time is for 200 particles, its error is the mean of its best particle in its own
world; what is asked of the time is a quarter of its 62 us.
"""
SLOPES_ABOUT = f"""\
The world of Yan et al. (clutter 2, 10 particles unless these grow), {cases.MOST_FRAMES} frames after the first
{cases.SETTLED}; slopes are fitted to logarithms. With more features more is sighted, too. The upper half leaves out
where the cost of a call counts most.
"""
