"""The filters of random finite sets: beside the published figures, beside the associators, and what they cost.

Parts: `clutter` (20 false sightings a frame, P_D 0.7: set filters and associators), `field` (PHD-SLAM 3.0's world),
`logs` (Victoria Park's detections, the car park), `rfs` (RFS-SLAM's grid), `slopes` (time against particles, features
and clutter). `logs` is skipped where there is no data: `KALMAP_DATA` names the folder, by default `../shared/data`
beside the repository.

    python benchmarks/finite_sets.py [--part NAME ...] [--seeds N] [--minutes M] [--report]

Every run is kept in `benchmarks/out`, so that a stopped benchmark goes on. --minutes: begin no run after so many;
what is missing then is said. --report: run nothing, write what there is.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import finite_sets_cases as cases
import report
from finite_sets_text import text_of


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", nargs="+", choices=tuple(cases.JOBS), default=list(cases.JOBS))
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--report", action="store_true")
    a = parser.parse_args()
    until = time.monotonic() + 60.0 * a.minutes
    for part in () if a.report else a.part:
        for _ in cases.carry_out(cases.JOBS[part](a.seeds or cases.SEEDS[part]), until):
            pass
    records, missing = [], []
    for part, make in cases.JOBS.items():
        for job in make(a.seeds or cases.SEEDS[part]):
            record = cases.stored(job)
            records += [record] if record is not None else []
            missing += [job] if record is None else []
    report.write("finite_sets", text_of(records, missing), records)


if __name__ == "__main__":
    main()
