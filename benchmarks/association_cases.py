"""The runs of `association_tables.py`: every associator in the worlds made to break it, and on the real logs."""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import worlds as common

from kalmap.data import open_log
from kalmap.records import AssociationConfig, FilterConfig, KalmapError, RunConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import LandmarkSlam, run, slam_from_config
from kalmap.study.cases import METRICS, Case, Method, RunRecord, association_ms, judge
from kalmap.study.store import Store
from kalmap.study.workers import carry_out

Record = dict[str, Any]

OUT = common.OUT / "association_tables"
LIMIT = "known"
# settings of an `AssociationConfig` by the name that the tables give the method; all else is its default
METHODS: dict[str, dict[str, Any]] = {
    "nearest": {"method": "nearest"},
    "nearest, one-to-one": {"method": "nearest", "one_to_one": True},
    "likelihood": {"method": "likelihood"},
    "jcbb": {"method": "jcbb"},
    "mda": {"method": "mda"},
    "djnn": {"method": "djnn"},
}
MANAGED: dict[str, dict[str, Any]] = {
    "likelihood, trial": {"method": "likelihood", "management": "trial"},
    "jcbb, trial": {"method": "jcbb", "management": "trial"},
    "djnn, existence": {"method": "djnn", "management": "existence"},
}
WORLDS = ("clutter-5", "missed-35", "doubles-35", "orchard", "clusters", "breaker", "djnn-50", "grove")

# folder under KALMAP_DATA, and what `open_log` is told
LOGS: dict[str, tuple[str, dict[str, Any]]] = {
    "car park": ("car_park", {}),
    "Victoria Park, ids hidden": ("victoria_park", {"variant": "ids"}),
    "Victoria Park, detections": ("victoria_park", {"variant": "detections"}),
    "Victoria Park, scans": ("victoria_park", {"variant": "scans"}),
    "DLR": ("dlr", {}),
    **{
        f"MRCLAM {number}, robot {robot}": (f"mrclam/MRCLAM_Dataset{number}", {"robot": robot})
        for number in (1, 9)
        for robot in range(1, 6)
    },
}
QUICK_LOGS = ("car park", "MRCLAM 9, robot 1")
# what is kept of a run's metrics
KEPT = (
    "association_accuracy", "association_precision", "association_recall", "association_f1",
    "association_spurious_landmarks", "association_duplicate_landmarks", "association_missed_features",
    "association_ms", "association_s", "association_cpu_s", "runtime_s", "runtime_cpu_s", "total_s", "total_cpu_s",
    "frames", "landmarks", "true_landmarks", "state_landmarks", "least_eigenvalue",
    "position_rmse_m", "heading_rmse_deg", "nees_mean", "nis_mean", "feature_aligned_rmse_m",
    "ate_aligned_median_m", "ate_aligned_trimmed_rmse_m", "gps_ate_aligned_median_m",
    "gps_ate_aligned_trimmed_rmse_m",
)  # fmt: skip
_FIRST = 3000  # events that load the compiled code, off the clock
_LARGEST = 4000  # states; the eigenvalues of more take too long


def kept(metrics: Mapping[str, Any]) -> Record:
    """What the tables and whoever computes with them need, in six digits."""
    return {
        key: float(f"{value:.6g}") if isinstance(value, float) else value
        for key, value in metrics.items()
        if key in KEPT and value is not None
    }


# --- worlds -----------------------------------------------------------------------------------------------


def world_cases(names: Sequence[str], seeds: int, quick: bool) -> list[Case]:
    """Every method in every world; in a quick run one lap with one seed."""
    cases = []
    for name in names:
        world = world_by_name(name)
        if quick:
            world = msgspec.structs.replace(world, laps=1)
        methods = METHODS | MANAGED | ({} if world.scanner else {LIMIT: {"method": "known"}})
        for method, settings in methods.items():
            chosen = Method(method, FilterConfig(), AssociationConfig(**settings))
            cases += [Case(world, chosen, seed) for seed in range(1, (1 if quick else seeds) + 1)]
    return cases


@functools.cache
def loaded(method: str) -> None:
    """Load a method's compiled code, once a process, so that no run's time holds it."""
    world = msgspec.structs.replace(world_by_name("doubles-35"), laps=1)
    settings = (METHODS | MANAGED | {LIMIT: {"method": "known"}})[method]
    config = Case(world, Method(method, FilterConfig(), AssociationConfig(**settings)), 1).config()
    log = simulate(world, 1)
    run(slam_from_config(config, log), log, reckon=False)


def measure_world(case: Case) -> RunRecord:
    """A run with what the tables need beside a study's metrics: how large the state became, and whether its
    covariance is sound."""
    loaded(case.method.name)
    log, config = simulate(case.world, case.seed), case.config()
    slam = slam_from_config(config, log)
    outcome = run(slam, log, reckon=False)
    if outcome.interrupted:
        raise KeyboardInterrupt
    names = (case.world.name, case.method.name, case.seed)
    if outcome.error is not None:
        return RunRecord(*names, {}, [], [], [], str(outcome.error))
    metrics = judge(outcome, log, config)
    kept = {key: metrics.get(key) for key in METRICS}
    kept["association_ms"] = association_ms(outcome, config)
    return RunRecord(
        *names, kept | state_of(slam) | {"true_landmarks": len(case.world.landmarks)}, [], [], []
    )


def state_of(slam: LandmarkSlam) -> dict[str, float | None]:
    """Landmarks in the last state, those on trial among them, and the least eigenvalue of its correlation matrix."""
    belief = slam._belief  # the state is the filter's own business, and this benchmark's
    least = None
    if belief.n <= _LARGEST:
        covariance = belief.covariance()
        scale = np.sqrt(np.diag(covariance))
        least = float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])
    return {"state_landmarks": len(slam._ids), "least_eigenvalue": least}


def run_worlds(cases: Sequence[Case], workers: int) -> Iterator[Record]:
    """A record a run. Finished runs are kept in benchmarks/out, so that a stopped benchmark goes on."""
    store = Store(OUT / "runs")
    found = {k: record for k, case in enumerate(cases) if (record := store.read(case)) is not None}
    missing = [k for k in range(len(cases)) if k not in found]
    for index, record in carry_out(measure_world, [cases[k] for k in missing], workers):
        found[missing[index]] = record
        store.write(cases[missing[index]], record)
        told = record.error or f"{record.metrics['runtime_s']:.1f} s"
        print(f"{record.world}, {record.method}, seed {record.seed}: {told}", flush=True)
    for k in range(len(cases)):
        r = found[k]
        yield {
            "part": "worlds", "where": r.world, "method": r.method, "seed": r.seed, "error": r.error, **kept(r.metrics)
        }  # fmt: skip


# --- logs -------------------------------------------------------------------------------------------------


def run_log(root: Path, name: str) -> Iterator[Record]:
    """A record a method on one real log: everything as the log's own defaults have it, but the method."""
    folder, options = LOGS[name]
    log = open_log(root / folder, **options)
    methods = dict(METHODS)
    if log.defaults.association.method == LIMIT:
        methods[LIMIT] = {"method": "known"}
    for method, settings in methods.items():
        association = msgspec.structs.replace(log.defaults.association, **settings)
        config = msgspec.structs.replace(log.defaults, association=association)
        record: Record = {"part": "logs", "where": name, "method": method, "seed": None, "error": None}
        try:
            yield record | measure_log(root / folder, options, config)
        except KalmapError as problem:
            yield record | {"error": str(problem)}
        print(f"{name}, {method}: done", flush=True)


def measure_log(path: Path, options: dict[str, Any], config: RunConfig) -> Record:
    """The metrics of a run, and its CPU time with reading the files; compiled code is loaded before."""
    log = open_log(path, **options)
    some = msgspec.structs.replace(log, open=lambda skip: itertools.islice(log.open(skip), _FIRST))
    run(slam_from_config(config, some), some, reckon=False)
    begin = time.process_time()
    wall = time.perf_counter()
    log = open_log(path, **options)
    slam = slam_from_config(config, log)
    outcome = run(slam, log, reckon=False)
    total, wall = time.process_time() - begin, time.perf_counter() - wall
    if outcome.interrupted:
        raise KeyboardInterrupt
    metrics = judge(outcome, log, config) | state_of(slam) | {"total_cpu_s": total, "total_s": wall}
    for part in ("runtime", "association"):
        seconds = metrics[f"{part}_s"]  # by the clock, so with what others took of the processor
        metrics[f"{part}_cpu_s"] = None if seconds is None else seconds * total / wall
    return kept(metrics) | {"error": None if outcome.error is None else str(outcome.error)}
