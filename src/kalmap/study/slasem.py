"""Sun et al. 2010 again: SLASEM in one map against divide and conquer, figures 4 to 7."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from kalmap.simulate import FloorWorld
from kalmap.study.cases import Case, RunRecord
from kalmap.study.claims import Claim, bounded, not_comparable
from kalmap.study.montecarlo import Progress
from kalmap.study.paper_report import Reproduction
from kalmap.study.result import StudyResult
from kalmap.study.slasem_cases import (
    FloorRecord,
    FloorStore,
    Plan,
    make_plan,
    method_name,
    run_floor,
    warm_up,
)
from kalmap.study.slasem_report import write_report

FASTER, WORSE, CLOSED = 10.0, 1.1, 0.3  # times; share of the position RMS; m at a place seen again


def reproduce_slasem(
    out: Path | str,
    runs: int = 1,
    workers: int | None = None,
    progress: Progress | None = None,
    *,
    methods: Sequence[str] = ("ekf",),
    worlds: Sequence[FloorWorld] | None = None,
) -> Reproduction:
    """Map both floors in one map and in local maps that are joined, and write what came out.

    The folder `out` then holds `slasem.md`, `slasem.csv`, `runs.csv`, `claims.json`, `report.html`, `manifest.json`,
    `figures/*.png` and the single runs in `runs/`.

    Seeds 1 to `runs`. methods: of `FILTERS`. worlds: other floors, for a quick look (then every page says so). All runs
    are made one after the other in this process, whatever `workers` says, so that their times can be compared.

    A stopped reproduction goes on where it was. Raises `ConfigError` for settings that make no sense.
    """
    del workers
    out = Path(out)
    plan = make_plan(runs, methods, worlds)
    out.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC)
    records = _run_all(plan.cases, FloorStore(out / "runs"), progress)
    result = StudyResult(tuple(_as_run(record) for record in records))
    claims = slasem_claims(plan, records)
    return Reproduction(
        result=result, claims=claims, files=write_report(out, plan, result, records, claims, started)
    )


def _run_all(cases: Sequence[Case], store: FloorStore, progress: Progress | None) -> list[FloorRecord]:
    records: list[FloorRecord] = []
    warm = False
    for number, case in enumerate(cases):
        if progress is not None:
            progress(number, len(cases))
        record = store.read(case)
        if record is None:
            if not warm and isinstance(case.world, FloorWorld):
                warm_up(case.world)
                warm = True
            record = run_floor(case)
            store.write(case, record)
        records.append(record)
    if progress is not None:
        progress(len(cases), len(cases))
    return records


def _as_run(record: FloorRecord) -> RunRecord:
    metrics = {**record.metrics, "runtime_s": record.metrics.get("total_s")}
    metrics["landmarks"] = record.metrics.get("samples")
    metrics["step_ms_p99"] = record.metrics.get("live_ms_p99")
    return RunRecord(record.world, record.method, record.seed, metrics, [], [], [], record.error)


def slasem_claims(plan: Plan, records: Sequence[FloorRecord]) -> list[Claim]:
    """Every target, on every floor and for every filter, over all seeds."""
    claims = []
    for world in plan.worlds:
        for name in plan.filters:
            plain, divided = (
                [
                    record
                    for record in records
                    if (record.world, record.method) == (world.name, method_name(name, which))
                ]
                for which in (False, True)
            )
            claims += _of_pair(world, method_name(name, False), plain, method_name(name, True), divided)
    claims += [_gave_up(record) for record in records if record.error is not None]
    return [not_comparable(each) for each in claims] if plan.altered else claims


def _of_pair(
    world: FloorWorld, one: str, plain: list[FloorRecord], other: str, divided: list[FloorRecord]
) -> list[Claim]:
    total = [_mean(records, "total_s") for records in (plain, divided)]
    position = [_mean(records, "position_rmse_m") for records in (plain, divided)]
    runs = sum(record.error is None for record in divided)
    where = f"{world.name}: {other}"
    faster = None if total[0] is None or total[1] is None else total[0] / total[1]
    worse = None if position[0] is None or position[1] is None else position[1] / position[0]
    return [
        bounded(f"{where}, times faster in total than {one}, joins included", faster, low=FASTER, runs=runs),
        bounded(
            f"{where}, largest live step (ms), below the scanner's period",
            _most(divided, "live_ms_max"),
            high=1e3 / world.rate,
            runs=runs,
        ),
        bounded(
            f"{where}, position RMS as it was known at the time, of that of {one}",
            worse,
            high=WORSE,
            runs=runs,
        ),
        bounded(f"{where}, maps left apart in the end", _most(divided, "maps"), high=1.0, runs=runs),
        bounded(
            f"{where}, worst error (m) between two scans at a place seen again: every loop closed",
            _most(divided, "revisit_worst_m"),
            high=CLOSED,
            runs=runs,
        ),
    ]


def _gave_up(record: FloorRecord) -> Claim:
    name = f"{record.world}: {record.method}, seed {record.seed} comes to an end"
    return Claim(name, "no error", record.error or "", "fails", runs=1)


def _values(records: list[FloorRecord], metric: str) -> list[float]:
    return [record.metrics[metric] for record in records if record.error is None]


def _mean(records: list[FloorRecord], metric: str) -> float | None:
    values = _values(records, metric)
    return float(np.mean(values)) if values else None


def _most(records: list[FloorRecord], metric: str) -> float | None:
    values = _values(records, metric)
    return max(values) if values else None
