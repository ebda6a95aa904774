"""How a frame's time grows with the map, against the bare BLAS, and what memory it takes.

A frame is 8 control steps and 5 sightings, handed over by two calls of `slam.step`, for n = 100 to 4,000
states; the sizes take turns, so that a slow moment of the machine falls on all of them. The joint update of 10
sightings (rank 20) at n = 2,003 takes turns with dsyrk of rank 20 on one triangle of the same size: in blocks
of eight ("warm": each finds its own matrix where its last round left it, as in use), and one by one ("cold":
each has just pushed the other's matrix out of the cache). One BLAS thread is set here.

    python benchmarks/scaling.py [--quick] [--filter cr-cdkf]
"""

from __future__ import annotations

import argparse
import os
import time
import tracemalloc
from pathlib import Path
from typing import Any

os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np
import report
from scipy.linalg.blas import dsyrk

from kalmap import LandmarkSlam, Odometry, RangeBearing, Sightings, VelocitySteering
from kalmap.slam.filters import FILTERS

SIZES = (100, 200, 400, 700, 1000, 1400, 2000, 2800, 4000)
SPREAD = 40.0  # m, half the side of the square of landmarks
DT, STEPS, STEERING = 0.025, 8, 0.1


class Course:
    """A vehicle that circles among n // 2 - 1 landmarks, its filter, and as many frames as one asks for."""

    def __init__(self, n: int, filter_name: str, coordinates: str = "invariant", at_once: int = 100) -> None:
        rng = self.rng = np.random.default_rng(n)
        self.landmarks = rng.uniform(-SPREAD, SPREAD, ((n - 3) // 2, 2))
        self.motion, sensor, self.pose, self.time = VelocitySteering(), RangeBearing(), np.zeros(3), 0.0
        lineariser, scope = FILTERS[filter_name]
        self.slam = LandmarkSlam(self.motion, sensor, lineariser, scope=scope, coordinates=coordinates)
        for first in range(0, len(self.landmarks), at_once):
            block = np.arange(first, min(first + at_once, len(self.landmarks)))
            for event in self.frame(block):
                self.slam.step(event)

    @property
    def states(self) -> int:
        """How many states the filter has."""
        return 3 + 2 * self.slam.landmark_count

    def frame(self, ids: np.ndarray | int) -> tuple[Odometry, Sightings]:
        """The next 8 control steps and sightings of these landmarks, or of that many at random."""
        if isinstance(ids, int):
            ids = self.rng.choice(len(self.landmarks), ids, replace=False)
        control = np.array([3.0, STEERING])
        for _ in range(STEPS):
            step = self.motion.increment(control, np.zeros(0), DT)
            c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
            self.pose += (c * step[0] - s * step[1], s * step[0] + c * step[1], step[2])
        self.time += STEPS * DT
        noise = self.rng.standard_normal((STEPS, 2)) * (self.motion.sigma_speed, self.motion.sigma_steering)
        dx, dy = (self.landmarks[ids] - self.pose[:2]).T
        values = np.column_stack([np.hypot(dx, dy), np.arctan2(dy, dx) - self.pose[2]])
        values += self.rng.standard_normal(values.shape) * (0.1, np.deg2rad(1.0))
        values[:, 1] = (values[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        odometry = Odometry(self.time, control + noise, np.full(STEPS, DT))
        return odometry, Sightings(self.time, values, np.asarray(ids, dtype=np.int64))

    def timed(self, count: int) -> float:
        """CPU microseconds of a frame with that many sightings."""
        odometry, sightings = self.frame(count)
        begin = time.process_time_ns()
        self.slam.step(odometry)
        self.slam.step(sightings)
        return 1e-3 * (time.process_time_ns() - begin)


def frame_times(sizes: tuple[int, ...], filter_name: str, rounds: int) -> dict[int, float]:
    """Median CPU microseconds of a frame of 5 sightings, by number of states."""
    courses = [Course(n, filter_name) for n in sizes]
    samples: dict[int, list[float]] = {course.states: [] for course in courses}
    for _ in range(rounds):
        for course in courses:
            course.timed(5)  # brings its map back into the cache after the others
            samples[course.states] += [course.timed(5) for _ in range(4)]
    return {n: float(np.median(values)) for n, values in samples.items()}


def slope(times: dict[int, float], least: int = 0) -> float:
    """Exponent of n in the time, fitted to the sizes from `least` on."""
    n = np.array([size for size in times if size >= least])
    return float(np.polyfit(np.log(n), np.log([times[size] for size in n]), 1)[0])


def against_blas(
    filter_name: str, coordinates: str, rounds: int, block: int, n: int = 2003
) -> dict[str, float]:
    """Median CPU microseconds of `slam.step` with 10 known sightings and of dsyrk of rank 20, taking turns.

    block: how often each goes before the other; the first of a longer block is not counted.
    """
    course = Course(n, filter_name, coordinates)
    w = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((course.states, 20)))
    p = np.asfortranarray(100.0 * np.eye(course.states))
    clock, ours, blas = time.process_time_ns, [], []
    for _ in range(rounds):
        for _ in range(block):
            odometry, sightings = course.frame(10)
            course.slam.step(odometry)
            begin = clock()
            course.slam.step(sightings)
            ours.append(1e-3 * (clock() - begin))
        for _ in range(block):
            begin = clock()
            p = dsyrk(-1.0, w, beta=1.0, c=p, lower=1, overwrite_c=1)
            blas.append(1e-3 * (clock() - begin))
    first = min(1, block - 1)
    update, bare = (float(np.median(np.reshape(t, (rounds, block))[:, first:])) for t in (ours, blas))
    return {"n": course.states, "update_us": update, "dsyrk_us": bare, "ratio": update / bare}


def step_memory(n: int, filter_name: str) -> dict[str, float]:
    """Bytes that a step of a standing map allocates at its peak: Python's, and resident (kernels too)."""
    course = Course(n, filter_name)
    for _ in range(3):
        course.timed(5)
    before = _resident("VmRSS") if _reset_peak() else 0
    for _ in range(5):
        course.timed(5)
    resident = max(0, _resident("VmHWM") - before) if before else -1
    frames = [course.frame(5) for _ in range(5)]
    tracemalloc.start()
    begin, _ = tracemalloc.get_traced_memory()
    for odometry, sightings in frames:
        course.slam.step(odometry)
        course.slam.step(sightings)
    peak = tracemalloc.get_traced_memory()[1] - begin
    tracemalloc.stop()
    return {
        "n": course.states,
        "python_bytes": peak,
        "resident_bytes": resident,
        "n2_bytes": 8 * course.states**2,
    }


def map_memory(n: int, filter_name: str) -> dict[str, float]:
    """Bytes of a map that grew 5 landmarks a frame, over n^2 doubles: its buffers, and the resident peak."""
    Course(100, filter_name).timed(5)  # compiles
    before = _resident("VmRSS") if _reset_peak() else 0
    course = Course(n, filter_name, at_once=5)
    for _ in range(5):
        course.timed(10)
    whole = 8.0 * course.states**2
    belief = course.slam._belief  # the buffers are the belief's own business, and this benchmark's
    buffers = sum(getattr(belief, name).nbytes for name in ("mean", "packed", "left", "right", "phi"))
    peak = (_resident("VmHWM") - before) / whole if before else float("nan")
    return {"n": course.states, "buffers_share": buffers / whole, "resident_peak_share": peak}


def _reset_peak() -> bool:
    """Start the process's resident peak anew; False where the system cannot (it needs Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _resident(field: str) -> int:
    """VmRSS (now) or VmHWM (peak) of this process, bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(field)).split()[1])


def measure(filter_name: str, quick: bool) -> list[dict[str, Any]]:
    """All the records of one filter."""
    sizes, rounds = (SIZES[::2], 4) if quick else (SIZES, 25)
    # memory first: a bigger map before it would leave freed pages behind
    grown = map_memory(1003 if quick else 4003, filter_name)
    steps = [step_memory(n, filter_name) for n in ((503, 1003) if quick else (503, 1003, 2003, 4003))]
    times = frame_times(sizes, filter_name, rounds)
    records: list[dict[str, Any]] = [{"what": "frame", "n": n, "us": us} for n, us in times.items()]
    records.append({"what": "slope", "all": slope(times), "from_1000": slope(times, 1000)})
    for coordinates in ("invariant", "additive"):
        for name, block in (("warm", 8), ("cold", 1)):
            compared = against_blas(filter_name, coordinates, rounds * 8 // block, block)
            records.append({"what": "dsyrk", "coordinates": coordinates, "cache": name, **compared})
    records += [{"what": "step memory", **row} for row in steps] + [{"what": "map memory", **grown}]
    return [{"filter": filter_name, **record} for record in records]


def tables(records: list[dict[str, Any]]) -> str:
    """The records of one filter as text."""
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        by_kind.setdefault(record["what"], []).append(record)
    fit, grown = by_kind["slope"][0], by_kind["map memory"][0]
    frames = [[r["n"], f"{r['us']:.4g}"] for r in by_kind["frame"]]
    blas = [
        [r["coordinates"], r["cache"], f"{r['update_us']:.4g}", f"{r['dsyrk_us']:.4g}", r["ratio"]]
        for r in by_kind["dsyrk"]
    ]
    steps = [[r["n"], r["python_bytes"], r["resident_bytes"], r["n2_bytes"]] for r in by_kind["step memory"]]
    heads = ("rank 20, n = 2,003", "cache", "step us", "dsyrk us", "ratio (asked: 1.5)")
    sizes = ("states n", "Python bytes a step, peak", "resident growth, bytes", "n^2 doubles, bytes")
    return f"""## {records[0]["filter"]}, invariant

{report.table(("states n", "CPU us per frame"), frames)}

Slope over all sizes {fit["all"]:.3f} (asked: at most 2.1); from n = 1,000 on {fit["from_1000"]:.3f}.

{report.table(heads, blas)}

{report.table(sizes, steps)}

A map grown to n = {grown["n"]}: buffers {grown["buffers_share"]:.3f}, resident peak
{grown["resident_peak_share"]:.3f} of n^2 doubles (asked: at most 1.3).
"""


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--filter", nargs="+", default=["ekf", "cr-cdkf"], choices=sorted(FILTERS))
    parser.add_argument("--quick", action="store_true")
    a = parser.parse_args()
    found = [measure(name, a.quick) for name in a.filter]
    name = "scaling_quick" if a.quick else "scaling"
    report.write(name, "\n".join(map(tables, found)), [record for records in found for record in records])


if __name__ == "__main__":
    main()
