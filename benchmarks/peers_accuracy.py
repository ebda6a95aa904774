"""Accuracy beside iSAM2 on the same logs: RMS over seeds, ratio, NEES.

kalmap's invariant filters and GTSAM's iSAM2 (online: the pose right after its scan).
iSAM2's results are kept in benchmarks/out/isam2 by world and seed, so that an interrupted run goes on where
it stopped.

    python benchmarks/peers_accuracy.py [--quick] [--worlds web35 lawn400 ...]
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
import programs
import report
import worlds

SEEDS = {"web35": 20, "lawn400": 2, "same400": 5, "lawn1000": 2}
QUICK = {"web35": 3}
FILTERS = ("ekf", "cr-cdkf")
NUMBERS = ("position", "heading_deg", "features", "nees")
NEES_BAND = (2.5, 4.5)


def isam2(world: str, seed: int) -> dict[str, Any]:
    """iSAM2's errors on one log, from the cache if they are there."""
    cached = worlds.OUT / "isam2" / f"{world}_s{seed}.json"
    if cached.is_file():
        return dict(json.loads(cached.read_text()))
    found = programs.isam2(world, seed, marginals_every=50, limit_s=3600.0)
    names = ("rms_pos", "rms_head_deg", "rms_feat", "pose_nees_mean")
    result = {"scans": int(found["steps"])} | {key: found[name] for key, name in zip(NUMBERS, names)}
    cached.parent.mkdir(parents=True, exist_ok=True)
    cached.write_text(json.dumps(result))
    return result


def collect(world: str, seeds: range) -> list[dict[str, Any]]:
    """One record for each method and seed."""
    records = []
    for seed in seeds:
        for name in FILTERS:
            record = programs.kalmap("accuracy", world, seed, name)
            about = {"world": world, "seed": seed, "commit": programs.commit()}
            records.append(about | {"method": f"kalmap {name} invariant", **record})
        if programs.has_gtsam():
            records.append({"world": world, "seed": seed, "method": "iSAM2", **isam2(world, seed)})
    return records


def summary(records: list[dict[str, Any]]) -> list[list[object]]:
    """Rows of world, method, seeds, RMS over seeds of each error, its ratio to iSAM2, mean NEES, verdict."""
    rows: list[list[object]] = []
    for world in dict.fromkeys(record["world"] for record in records):
        mine = [record for record in records if record["world"] == world]
        methods = dict.fromkeys(record["method"] for record in mine)
        by_method = {m: _over_seeds([r for r in mine if r["method"] == m]) for m in methods}
        best = by_method.get("iSAM2")
        for method, (count, numbers) in by_method.items():
            ratios = [numbers[k] / best[1][k] if best else None for k in ("position", "features")]
            verdict = "" if method == "iSAM2" or best is None else _verdict(ratios, numbers["nees"])
            rows.append([world, method, count, *(numbers[k] for k in NUMBERS), *ratios, verdict])
    return rows


def _over_seeds(records: list[dict[str, Any]]) -> tuple[int, dict[str, float]]:
    numbers = {k: float(np.sqrt(np.mean([r[k] ** 2 for r in records]))) for k in NUMBERS[:3]}
    numbers["nees"] = float(np.mean([r["nees"] for r in records]))
    return len(records), numbers


def _verdict(ratios: list[Any], nees: float) -> str:
    within = all(ratio <= 1.05 for ratio in ratios) and NEES_BAND[0] <= nees <= NEES_BAND[1]
    return "met" if within else "missed"


HEADER = (
    "world", "method", "seeds", "position m", "heading deg", "features m", "NEES",
    "position / iSAM2", "features / iSAM2", "5 % and NEES 2.5 to 4.5",
)  # fmt: skip


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="+")
    parser.add_argument("--seeds", type=int, help="seeds 1..N of every world, instead of the plan")
    parser.add_argument("--keep", action="store_true", help="keep the last run's results of other worlds")
    parser.add_argument("--quick", action="store_true", help="web35 with three seeds")
    a = parser.parse_args()
    worlds.require_peers()
    plan = QUICK if a.quick else SEEDS
    name = "peers_accuracy_quick" if a.quick else "peers_accuracy"
    chosen = a.worlds or list(plan)
    records = report.kept(name, chosen) if a.keep else []
    for world in chosen:
        records += collect(world, range(1, (a.seeds or plan.get(world, 1)) + 1))
    report.write(name, report.table(HEADER, summary(records)), records)


if __name__ == "__main__":
    main()
