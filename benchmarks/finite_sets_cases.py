"""The runs of `finite_sets.py`: which method, where, with which settings, and what is kept of each."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import worlds as common
from programs import commit

from kalmap.data import open_log
from kalmap.evaluation import match, position_errors
from kalmap.records import AssociationConfig, FilterConfig, KalmapError, Log, Odometry, RunConfig
from kalmap.simulate import World, phd_world, simulate, world_by_name
from kalmap.simulate.courses import map_stream, random_landmarks
from kalmap.simulate.disturb import with_clutter
from kalmap.simulate.set_worlds import PHD_AREA
from kalmap.slam import run, slam_from_config
from kalmap.slam.run import warm_up
from kalmap.study.cases import judge
from kalmap.study.set_course import course_metrics, judge_course

Record = dict[str, Any]

OUT = common.OUT / "finite_sets"
LIMIT = "known ids"
PARTICLES = ("rb-phd", "srckf-phd", "mh-fastslam", "pmb")
RFS = ("rfs-99-0", "rfs-90-1", "rfs-70-6", "rfs-50-13")
ASSOCIATORS = ("nearest", "likelihood", "jcbb", "mda", "djnn", "pmb")
PLAIN, CLUTTERED, CAR_PARK = "Victoria Park", "Victoria Park, clutter 5", "car park"
KEPT = (
    "position_rmse_m", "heading_rmse_deg", "ospa_m", "gospa_m", "gospa_missed", "gospa_false", "cardinality_error",
    "ospa_course_m", "cardinality_course_error", "nees_mean", "association_f1", "association_ms", "landmarks",
    "frames", "steps", "sightings", "runtime_s", "step_ms_mean", "step_ms_p99", "ate_aligned_rmse_m",
    "ate_aligned_trimmed_rmse_m", "gps_ate_aligned_rmse_m",
    "gps_ate_aligned_trimmed_rmse_m", "gps_ate_aligned_median_m", "feature_aligned_rmse_m",
)  # fmt: skip
ENOUGH_S = (
    60.0  # CPU seconds for an associator in a world; those whose state grows without bound would take hours
)
MOST_FRAMES = 300  # of a run whose time alone is measured
SETTLED = 60  # frames before it that are not timed


class Job(msgspec.Struct, frozen=True):
    """A run: a method (its name in the tables) at a place with a seed, and its settings.

    changes: of the set's settings; None for a filter with an association, by `association`.
    """

    part: str
    where: str
    method: str
    seed: int
    changes: dict[str, Any] | None = None
    association: dict[str, Any] | None = None

    @property
    def particles(self) -> int | None:
        """How many, where the method has any."""
        return None if self.changes is None else self.changes["particles"]

    def config(self, own: RunConfig) -> RunConfig:
        """The place's own settings with this method's."""
        own = msgspec.structs.replace(own, seed=self.seed)
        sets = own.finite_set
        if self.changes is not None:
            return msgspec.structs.replace(
                own, finite_set=msgspec.structs.replace(sets, threads=1, **self.changes)
            )
        rates = {
            "detection": sets.detection,
            "false_rate": max(sets.clutter, 1e-3),
            "new_rate": sets.new_rate,
        }
        told = AssociationConfig(**rates | (self.association or {}))
        return msgspec.structs.replace(own, filter=FilterConfig(), association=told)


# --- what there is to run, the most wanted first --------------------------------------------------------------------


def _sets(method: str, particles: int, **more: Any) -> dict[str, Any]:
    return {"method": method, "particles": particles, **more}


def clutter_jobs(seeds: int) -> list[Job]:
    """Heavy clutter: every set filter, every associator, and the limit; djnn, which does not end, once."""
    jobs = []
    for seed in range(1, seeds + 1):
        where = ("clutter", "clutter-20-70")
        jobs += [Job(*where, LIMIT, seed, None, {"method": "known"})]
        jobs += [
            Job(*where, f"cr-cdkf:{name}", seed, None, {"method": name})
            for name in ASSOCIATORS
            if name != "djnn" or seed == 1
        ]
        jobs += [Job(*where, name, seed, _sets(name, 10)) for name in (*reversed(PARTICLES), "pmbm")]
    return jobs


def field_jobs(seeds: int) -> list[Job]:
    """The world of PHD-SLAM 3.0. pmb with 100 particles for three seeds; all but pmb and pmbm for five at most."""
    jobs = []
    for seed in range(1, seeds + 1):
        where = ("field", "field-160")
        chosen = PARTICLES if seed <= 5 else ("pmb",)
        jobs += [Job(*where, LIMIT, seed, None, {"method": "known"})]
        jobs += [Job(*where, f"pmbm, {n}", seed, _sets("pmbm", n)) for n in (10, 1)]
        jobs += [
            Job(*where, f"{name}, {n}", seed, _sets(name, n)) for n in (10, 1) for name in reversed(chosen)
        ]
        if seed <= 5:
            jobs += [Job(*where, "rb-phd, 10, by motion", seed, _sets("rb-phd", 10, proposal="motion"))]
        if seed <= 3:
            jobs += [Job(*where, "pmb, 100", seed, _sets("pmb", 100))]
    return jobs


def rfs_jobs(seeds: int) -> list[Job]:
    """The grid of RFS-SLAM: 200 particles with as many seeds as asked for, pmbm with three."""
    jobs = []
    for seed in range(1, max(seeds, 3) + 1):
        for name in ("pmbm", "pmb", "rb-phd", "mh-fastslam", "srckf-phd"):
            if seed <= (3 if name == "pmbm" else seeds):
                number = 10 if name == "pmbm" else 200
                jobs += [Job("rfs", where, name, seed, _sets(name, number)) for where in RFS]
    return jobs


def logs_jobs(seeds: int) -> list[Job]:
    """Recorded logs: Victoria Park's detections as they are and with clutter; the car park, ten times."""
    jobs = []
    runs = {"pmbm": 1}  # nothing in it is drawn
    for name in ("pmbm", "pmb", "srckf-phd", "rb-phd"):
        jobs += [Job("logs", CAR_PARK, name, k, _sets(name, 10)) for k in range(1, runs.get(name, 10) + 1)]
    for name in ("pmbm", *reversed(PARTICLES)):
        jobs += [Job("logs", where, name, 1, _sets(name, 10)) for where in (PLAIN, CLUTTERED)]
    return jobs


def slopes_jobs(seeds: int) -> list[Job]:
    """Time against particles, features in view and clutter; `where` is what grows and its number."""
    jobs = []
    for name in ("pmb", "rb-phd"):
        jobs += [Job("slopes", f"particles {n}", name, 1, _sets(name, n)) for n in (1, 2, 4, 8, 16, 32, 64)]
        jobs += [Job("slopes", f"features {n}", name, 1, _sets(name, 10)) for n in (20, 40, 80, 160, 320)]
        jobs += [Job("slopes", f"clutter {n}", name, 1, _sets(name, 10)) for n in (1, 2, 5, 10, 20, 50)]
    return jobs


JOBS = {
    "clutter": clutter_jobs,
    "field": field_jobs,
    "logs": logs_jobs,
    "rfs": rfs_jobs,
    "slopes": slopes_jobs,
}
SEEDS = {"clutter": 5, "field": 5, "logs": 1, "rfs": 1, "slopes": 1}


# --- running --------------------------------------------------------------------------------------------------------


def data_root() -> Path | None:
    """Where the recorded logs are; None where there are none."""
    named = os.environ.get("KALMAP_DATA")
    root = Path(named) if named else common.ROOT.parent / "shared" / "data"
    return root if root.is_dir() else None


@functools.cache
def sources() -> str:
    """What stands for the program in a stored run's name: the sources under version control and what is changed."""
    asked = (["rev-parse", "HEAD:src"], ["diff", "HEAD", "--", "src"])
    told = [
        subprocess.run(["git", *words], cwd=common.ROOT, capture_output=True, check=False).stdout
        for words in asked
    ]
    return hashlib.sha256(b"".join(told)).hexdigest()


def place(job: Job) -> Path:
    """Where a run is kept."""
    content = json.dumps([sources(), msgspec.to_builtins(job)], sort_keys=True)
    key = hashlib.sha256(content.encode()).hexdigest()[:12]
    name = re.sub(r"[^a-z0-9]+", "-", f"{job.part}-{job.where}-{job.method}".lower()).strip("-")
    return OUT / f"{name}-{job.seed:03d}-{key}.json"


def stored(job: Job) -> Record | None:
    """A run that was made before."""
    file = place(job)
    return json.loads(file.read_text()) if file.is_file() else None


def carry_out(jobs: list[Job], until: float) -> Iterator[Record]:
    """A record a job, those that were made before from benchmarks/out; no new one is begun after `until` (s)."""
    OUT.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        record = stored(job)
        if record is None and time.monotonic() < until:
            record = measured(job)
            if record is None:
                print(f"{job.where} skipped: no recorded logs; KALMAP_DATA names their folder", flush=True)
                continue
            place(job).write_text(json.dumps(record) + "\n")
            told = record["error"] or f"{record['wall_s']:.1f} s"
            print(f"{job.where}, {job.method}, seed {job.seed}: {told}", flush=True)
        if record is not None:
            yield record


def log_of(job: Job) -> Log | None:
    """The log of a place, its own settings in it; None for a recorded one that is not there."""
    if job.part == "slopes":
        return simulate(slope_world(job.where), job.seed)
    if job.part != "logs":
        return simulate(world_by_name(job.where), job.seed)
    root = data_root()
    folder, options = (
        ("car_park", {}) if job.where == CAR_PARK else ("victoria_park", {"variant": "detections"})
    )
    if root is None or not (root / folder).is_dir():
        return None
    log = open_log(root / folder, **options)
    if job.where != CLUTTERED:
        return log
    sets = log.defaults.finite_set
    told = msgspec.structs.replace(sets, clutter=sets.clutter + 5.0)
    return msgspec.structs.replace(
        with_clutter(log, 5.0, 1), defaults=msgspec.structs.replace(log.defaults, finite_set=told)
    )


class TooLongError(KalmapError):
    """A run was given up for its time."""


@contextmanager
def limited(job: Job) -> Iterator[None]:
    """Give an associator up after its CPU time."""

    def give_up(*_: object) -> None:
        raise TooLongError(f"given up after {ENOUGH_S:g} CPU seconds")

    if job.association is None:
        yield
        return
    standing = signal.signal(signal.SIGPROF, give_up)
    signal.setitimer(signal.ITIMER_PROF, ENOUGH_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, standing)


def measured(job: Job) -> Record | None:
    """One run, judged; None where its log is not there. Compiled code is loaded before the clocks start."""
    log = log_of(job)
    if log is None:
        return None
    config = job.config(log.defaults)
    record: Record = {
        **msgspec.to_builtins(job),
        "particles": job.particles,
        "error": None,
        "commit": commit(),
    }
    record["load"] = round(os.getloadavg()[0], 1)
    begin, wall = time.process_time(), time.perf_counter()
    try:
        slam = slam_from_config(config, log)
        warm_up(slam)
        if job.part == "slopes":
            return record | timed(slam, log) | {"wall_s": time.perf_counter() - wall}
        begin, wall = time.process_time(), time.perf_counter()
        with limited(job):
            outcome = run(slam, log, reckon=False)
    except KalmapError as problem:
        return record | {"error": str(problem), "wall_s": time.perf_counter() - wall}
    cpu, wall = time.process_time() - begin, time.perf_counter() - wall
    if outcome.interrupted:
        raise KeyboardInterrupt
    if outcome.error is not None:
        reached = {
            "wall_s": wall,
            "reached_frames": outcome.frames,
            "landmarks_then": len(outcome.estimate.landmarks),
        }
        return record | {"error": str(outcome.error)} | reached
    metrics = judge(outcome, log, config) | course_metrics(judge_course(outcome, log, config))
    record |= {key: metrics[key] for key in KEPT if metrics.get(key) is not None}
    errors = position_errors(match(outcome.trace.times, outcome.trace.poses, log.references[0]))
    record["position_mean_m"] = float(np.mean(errors))
    record["log_s"] = float(outcome.trace.times[-1] - outcome.trace.times[0])
    # by the clock a filter's time holds what others took of the processor; its share of the CPU time does not
    seconds = outcome.runtime * min(cpu / wall, 1.0)
    return record | {
        "cpu_s": seconds,
        "cpu_ms": 1e3 * seconds / outcome.frames,
        "total_cpu_s": cpu,
        "wall_s": wall,
    }


# --- time alone -----------------------------------------------------------------------------------------------------


def slope_world(where: str) -> World:
    """The world of Yan et al. with more clutter, or with more features anywhere in its square."""
    what, number = where.split()
    if what == "clutter":
        return phd_world(int(number))
    world = phd_world(2)
    if what == "particles":
        return world
    drawn = random_landmarks(int(number), PHD_AREA, map_stream(8, int(number)))
    return msgspec.structs.replace(world, name=f"phd-2, {number} features", landmarks=drawn)


def timed(slam: Any, log: Log) -> Record:
    """CPU ms of a frame with the odometry before it; sightings, and components of the best particle's map."""
    seconds, frames, sightings, components = 0.0, 0, 0, 0
    for event in itertools.islice(log, 2 * (SETTLED + MOST_FRAMES)):
        moving = isinstance(event, Odometry)
        begin = time.process_time()
        slam.step(event)
        spent = time.process_time() - begin
        frames += not moving
        if frames > SETTLED:
            seconds += spent
            if not moving:
                sightings += len(event.values)
                components += len(slam.map())
    counted = frames - SETTLED
    return {
        "frames": counted,
        "cpu_ms": 1e3 * seconds / counted,
        "seen": sightings / counted,
        "mapped": components / counted,
    }
