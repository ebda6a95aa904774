"""How long each associator takes for a frame, against the number of landmarks in the map.

Landmarks lie evenly over a square, so that about 15 are in view wherever the robot stands (30 m, half plane); the map
is as sure of them as after a first lap. Every frame is taken from a new place; the sightings are what the sensor would
see there.
One frame is `associate` and `settle`, the reasons not asked for: everything from the sightings to the updated memory,
but not the filter's update. DJNN has its counter; the others believe every landmark (`Keep`). Nothing is merged.

Time of the processor, one BLAS thread; the median over the frames of the median over the rounds, so that being
interrupted does not count. A third of DJNN's is the filter's own regression of the candidates (central differences).

    python benchmarks/association.py [--quick]
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np
import report

from kalmap.association import Djnn, Jcbb, Keep, Likelihood, Nearest, Region
from kalmap.association.gated import Gated
from kalmap.gaussian import Belief
from kalmap.models import RangeBearing
from kalmap.records import Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.predicted import PredictedMap
from kalmap.slam.region import LandmarkIndex

SIZES = (100, 300, 1000, 3000, 10_000, 30_000)
IN_VIEW, REACH = 15, 30.0
DENSITY = IN_VIEW / (0.5 * np.pi * REACH**2)
TARGET_US, TARGET_SLOPE = 50.0, 0.15
METHODS: dict[str, Gated] = {
    "djnn": Djnn(),
    "nearest": Nearest(),
    "likelihood": Likelihood(),
    "jcbb": Jcbb(),
    "nearest, whole map": Nearest(region=Region(local=False), management=Keep()),
    "jcbb, whole map": Jcbb(region=Region(local=False), management=Keep()),
}
WHOLE_MAP_MOST = 3000


class Course:
    """A map of n landmarks and frames from places in it."""

    def __init__(self, n: int, frames: int, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        side = np.sqrt(n / DENSITY)
        self.landmarks = rng.uniform(0.0, side, (n, 2))
        self.slam = LandmarkSlam(sensor=RangeBearing(max_range=REACH))
        self.belief = _belief(self.landmarks)
        margin = min(REACH, 0.25 * side)
        places = rng.uniform(margin, side - margin, (frames, 2))
        self.poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, frames)])
        self.frames = [self._frame(pose, rng) for pose in self.poses]
        self.index = LandmarkIndex()

    def _frame(self, pose: np.ndarray, rng: np.random.Generator) -> Sightings:
        """What the sensor sees, the 15 nearest to what a frame holds on average."""
        z = self.slam.sensor.predict(pose, self.landmarks)
        seen = np.flatnonzero((z[:, 0] < REACH) & (np.abs(z[:, 1]) < 0.5 * np.pi))
        seen = rng.permutation(seen)[:IN_VIEW]
        values = z[seen] + rng.normal(0.0, [0.1, np.deg2rad(1.0)], (len(seen), 2))
        return Sightings(0.0, np.abs(values) * np.column_stack([np.ones(len(seen)), np.sign(values[:, 1])]))

    def memory(self, method: Gated) -> Any:
        """What the associator would remember of n landmarks that it believes in."""
        memory, n = method.start(), len(self.landmarks)
        memory.update(confirmed=[True] * n, score=[20.0] * n, serial=list(range(n)), founded=n)
        return memory

    def pass_once(self, method: Gated, memory: Any) -> np.ndarray:
        """(frames,) seconds of the processor."""
        spent = np.empty(len(self.frames))
        for k, (pose, frame) in enumerate(zip(self.poses, self.frames, strict=True)):
            self.belief.mean[:3] = pose
            noises, _ = self.slam._engine.noises(frame.values)
            begin = time.process_time()
            predicted = PredictedMap(
                self.slam._engine, self.belief, self.slam.sensor, self.index, frame, noises
            )
            association = method.associate(memory, frame, predicted)
            method.settle(memory, association)
            spent[k] = time.process_time() - begin
        return spent


def _belief(landmarks: np.ndarray) -> Belief:
    """Robot and landmarks with 0.3 m and 0.2 m of error, most of it shared; only what association reads is filled.

    The rest of the covariance stays untouched memory, so that 30,000 landmarks fit anywhere.
    """
    n = 3 + 2 * len(landmarks)
    belief = Belief(np.zeros(3), np.diag([0.09, 0.09, np.deg2rad(1.0) ** 2]))
    belief.mean = np.concatenate([np.zeros(3), landmarks.ravel()])
    packed = np.zeros(n * (n + 1) // 2)
    packed[:6] = belief.packed[:6]
    rows = np.arange(3, n)
    start = rows * (rows + 1) // 2
    packed[start + (rows - 3) % 2] = 0.04
    packed[start + rows] = 0.05
    belief.packed, belief.n = packed, n
    return belief


def measure(
    sizes: tuple[int, ...], frames: int, rounds: int, names: tuple[str, ...] = tuple(METHODS)
) -> list[dict[str, Any]]:
    """Each of the named methods at each size."""
    records = []
    for n in sizes:
        course = Course(n, frames)
        sighted = float(np.mean([len(frame.values) for frame in course.frames]))
        for name in names:
            if "whole" in name and n > WHOLE_MAP_MOST:
                continue
            method = METHODS[name]
            course.pass_once(method, course.memory(method))  # compiles, and files the landmarks
            spent = np.array([course.pass_once(method, course.memory(method)) for _ in range(rounds)])
            each = 1e6 * np.median(spent, axis=0)
            records.append(
                {
                    "method": name,
                    "landmarks": n,
                    "sightings": sighted,
                    "median_us": float(np.median(each)),
                    "p90_us": float(np.percentile(each, 90)),
                }
            )
    return records


def slope(records: list[dict[str, Any]], method: str) -> float:
    """Of the log of the time in the log of the number of landmarks."""
    mine = [r for r in records if r["method"] == method]
    x, y = (np.log([r[key] for r in mine]) for key in ("landmarks", "median_us"))
    return float(np.polyfit(x, y, 1)[0])


def main() -> None:
    """Measure and write results/association.md."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small maps, few frames")
    quick = parser.parse_args().quick
    sizes = SIZES[:3] if quick else SIZES
    records = measure(sizes, 100 if quick else 300, 3 if quick else 7)
    rows = [[r["method"], r["landmarks"], r["sightings"], r["median_us"], r["p90_us"]] for r in records]
    at_300 = next(r["median_us"] for r in records if (r["method"], r["landmarks"]) == ("djnn", 300))
    text = [
        "# Association, microseconds a frame\n",
        report.table(["method", "landmarks", "sightings", "median us", "90 % us"], rows),
        f"\nDJNN at 300 landmarks: {at_300:.1f} us (at most {TARGET_US:g} asked); slope from {sizes[0]} to "
        f"{sizes[-1]:,} landmarks {slope(records, 'djnn'):.3f} (below {TARGET_SLOPE:g} asked).",
    ]
    report.write("association_quick" if quick else "association", "\n".join(text), records)


if __name__ == "__main__":
    main()
