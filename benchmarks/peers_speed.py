"""Speed beside the peers on the same logs: CPU per scan, everything included, and ratios.

In every round kalmap's invariant EKF and CR-CDKF, GTSAM's iSAM2 and MRPT's C++ EKF run one after the other,
each in its own process on one core; ratios are taken within a round and the median over the rounds is told. A
peer that was cut off by its time limit is compared on the scans that it reached.

    python benchmarks/peers_speed.py [--quick] [--worlds web35 same100 ...] [--rounds 3]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import programs
import report
import worlds

FILTERS = ("ekf", "cr-cdkf")
ROUNDS = {"web35": 7, "same100": 5, "same400": 3, "lawn400": 3, "lawn1000": 1}
PASSES = {"web35": 5, "same100": 5, "same400": 1, "lawn400": 1, "lawn1000": 1}
QUICK = {"web35": 1, "same100": 1}
# the least factor by which the peer must be slower; 0.5: kalmap may take twice the peer's time
ISAM2_TARGETS = {"web35": 20.0, "same400": 10.0, "lawn400": 10.0}
MRPT_TARGETS = {"web35": 0.5, "same100": 1.0, "same400": 4.0, "lawn400": 4.0, "lawn1000": 5.0}
LIMIT_S = 300.0


def one_round(world: str, seed: int, passes: int, limit_s: float, peers: list[str]) -> list[dict[str, Any]]:
    """kalmap and the peers, one after the other. CPU ms per scan, and the peers' factors.

    passes: how often each of them but iSAM2 goes through the log for its median (iSAM2 takes long enough).
    """
    more = ("--passes", str(passes))
    curves = {name: programs.kalmap("speed", world, seed, name, *more) for name in FILTERS}
    records = []
    for name, curve in curves.items():
        scans, seconds = curve["scans"], curve["cpu_s"]
        records.append({"method": f"kalmap {name}", "scans": scans, "of": scans, "ms": 1e3 * seconds / scans})
    for method, scans, of, seconds in _peers(world, seed, passes, limit_s, peers):
        factors = {f"times {name}": seconds / _seconds_at(curves[name], scans) for name in FILTERS}
        records.append({"method": method, "scans": scans, "of": of, "ms": 1e3 * seconds / scans, **factors})
    return records


def _peers(
    world: str, seed: int, passes: int, limit_s: float, peers: list[str]
) -> list[tuple[str, int, int, float]]:
    """(method, scans done, scans of the log, CPU seconds) of the peers that are there."""
    done = []
    if "isam2" in peers and programs.has_gtsam():
        found = programs.isam2(world, seed, marginals_every=0, limit_s=limit_s)
        done.append(("iSAM2", int(found["steps"]), int(found["of"]), found["cpu_s"]))
    program = programs.mrpt_program() if "mrpt" in peers else None
    if program is not None:
        runs = [programs.mrpt_ekf(program, world, seed, limit_s) for _ in range(passes)]
        found = sorted(runs, key=lambda run: run["cpu_s"] / run["scans"])[(passes - 1) // 2]
        done.append(("MRPT EKF", int(found["scans"]), int(found["of"]), found["cpu_s"]))
    return done


def _seconds_at(curve: dict[str, Any], scans: int) -> float:
    """kalmap's CPU seconds up to that scan."""
    return float(np.interp(scans, [0, *curve["marks"]], [0.0, *curve["curve"]]))


def summary(records: list[dict[str, Any]]) -> list[list[object]]:
    """Rows of world, method, rounds, scans, median ms, the factors' medians and ranges, target, verdict."""
    rows: list[list[object]] = []
    for world, method in dict.fromkeys((r["world"], r["method"]) for r in records):
        mine = [r for r in records if (r["world"], r["method"]) == (world, method)]
        targets = {"iSAM2": ISAM2_TARGETS, "MRPT EKF": MRPT_TARGETS}.get(method, {})
        least, cells, verdict = targets.get(world), [], []
        for name in FILTERS:
            factors = [r[f"times {name}"] for r in mine if f"times {name}" in r]
            cells.append(_median_and_range(factors))
            if factors and least is not None:
                verdict.append(f"{name} {'met' if np.median(factors) >= least else 'MISSED'}")
        reached = f"{min(r['scans'] for r in mine)} of {mine[0]['of']}"
        middle = f"{float(np.median([r['ms'] for r in mine])):.4g}"
        rows.append([world, method, len(mine), reached, middle, *cells, least, ", ".join(verdict)])
    return rows


def _median_and_range(factors: list[float]) -> str | None:
    if not factors:
        return None
    return f"{np.median(factors):.3g} ({min(factors):.3g} to {max(factors):.3g})"


HEADER = (
    "world", "method", "rounds", "scans", "CPU ms per scan",
    "takes how many times kalmap ekf", "takes how many times kalmap cr-cdkf", "at least", "verdict",
)  # fmt: skip


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="+")
    parser.add_argument("--rounds", type=int, help="instead of the plan's")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds after which a peer is cut off")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--peers", nargs="+", default=["isam2", "mrpt"], choices=("isam2", "mrpt"))
    parser.add_argument("--keep", action="store_true", help="keep the last run's results of other worlds")
    parser.add_argument("--quick", action="store_true", help="web35 and same100, one round")
    a = parser.parse_args()
    worlds.require_peers()
    plan = QUICK if a.quick else ROUNDS
    name = "peers_speed_quick" if a.quick else "peers_speed"
    chosen = a.worlds or list(plan)
    records = report.kept(name, chosen) if a.keep else []
    for world in chosen:
        for number in range(1, (a.rounds or plan.get(world, 1)) + 1):
            found = one_round(world, a.seed, PASSES.get(world, 3), a.limit, a.peers)
            about = {"world": world, "seed": a.seed, "round": number, "commit": programs.commit()}
            records += [about | record for record in found]
        # after every world, so that an interrupted run leaves what it has
        report.write(name, report.table(HEADER, summary(records)), records)


if __name__ == "__main__":
    main()
