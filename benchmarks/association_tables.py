"""Every associator in every world made to break it, and on the real logs without ids.

Worlds: `clutter-5`, `missed-35`, `doubles-35`, `orchard`, `clusters`, `breaker`, `djnn-50`, `grove` (laser scans); each
method with its own default settings, some once more with another management of the map; as the limit, the filter that
is told the identities. Means over the seeds.

Logs: the car park, Victoria Park (identities hidden; all detections; raw scans), DLR and MRCLAM 1 and 9 with their
identities hidden; the settings are the log's own, only the method changes. Skipped where there is no data:
`KALMAP_DATA` names the folder, by default `../shared/data` beside the repository.

    python benchmarks/association_tables.py [--part worlds|logs] [--only NAME ...] [--seeds 5] [--workers 2] [--quick]

Runs in worlds are kept in `benchmarks/out`; what is not measured again stays in `results/` as it was.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import association_cases as cases
import report
import worlds as common
from association_cases import Record
from association_text import text_of
from programs import commit


def data_root() -> Path | None:
    """Where the real logs are; None where there are none."""
    named = os.environ.get("KALMAP_DATA")
    root = Path(named) if named else common.ROOT.parent / "shared" / "data"
    return root if root.is_dir() else None


def standing(name: str) -> list[Record]:
    """The records of the last run."""
    file = report.RESULTS / f"{name}.json"
    return json.loads(file.read_text())["records"] if file.is_file() else []


def measured(a: argparse.Namespace) -> list[Record]:
    """What is asked for."""
    records: list[Record] = []

    def chosen(name: str) -> bool:
        return not a.only or name in a.only

    if a.part != "logs":
        names = [name for name in cases.WORLDS if chosen(name)]
        plan = cases.world_cases(names, a.seeds, a.quick)
        records += cases.run_worlds(plan, a.workers)
    if a.part != "worlds":
        root = data_root()
        if root is None:
            print("real logs skipped: set KALMAP_DATA to the folder that holds them")
            return records
        for name in cases.QUICK_LOGS if a.quick else cases.LOGS:
            if chosen(name) and (root / cases.LOGS[name][0]).is_dir():
                records += cases.run_log(root, name)
            elif chosen(name):
                print(f"{name} skipped: {root / cases.LOGS[name][0]} is not there")
    return records


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=("worlds", "logs"))
    parser.add_argument("--only", nargs="+", choices=(*cases.WORLDS, *cases.LOGS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true")
    a = parser.parse_args()
    name = "association_tables_quick" if a.quick else "association_tables"
    program: dict[str, Any] = {"commit": commit()}
    fresh = [record | program for record in measured(a)]
    again = {(r["part"], r["where"]) for r in fresh}
    kept = [r for r in standing(name) if (r["part"], r["where"]) not in again]
    records = [*kept, *fresh]
    report.write(name, text_of(records), records)


if __name__ == "__main__":
    main()
