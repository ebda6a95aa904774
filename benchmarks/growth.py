"""Time against size: lawns of 1,000 to 100,000 landmarks, mown once, with divide and conquer; others beside it.

    python benchmarks/growth.py [--sizes 1000,3000,...] [--plain 1000,3000] [--isam 1000] [--out results/growth.json]

The lawn is that of `simulate` (one landmark to 250 m^2, lanes 40 m apart, a look every 0.6 m, 30 m ahead), but it is
driven lazily with odometry increments, so that no log has to fit into memory. Identities are known. One process, one
thread; joins run inline, so that every second is counted (of the processor, since others may be at work beside it);
`live` is the time of the steps without the joins, `worst` the longest step by the clock.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from kalmap.geometry.se2 import compose, rotate
from kalmap.models import Increments, RangeBearing
from kalmap.records import DivideConfig, Odometry, Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.submaps.divide import DivideAndConquer

STEP, LANE, RANGE = 0.6, 40.0, 30.0  # m
SIGMA_MOVE, SIGMA_TURN = 0.03, math.radians(0.25)  # m and rad a step
SETTINGS = DivideConfig(on=True)


def increments(side: float) -> Iterator[np.ndarray]:
    """(3,) exact odometry of a lawn: lanes along x, half circles between them."""
    along = np.array([STEP, 0.0, 0.0])
    radius = LANE / 2.0
    for lane in range(round(side / LANE)):
        for _ in range(int(side / STEP)):
            yield along
        count = round(math.pi * radius / STEP)
        turn, side_of = math.pi / count, 1.0 if lane % 2 == 0 else -1.0
        chord = np.array([radius * math.sin(turn), side_of * radius * (1.0 - math.cos(turn)), side_of * turn])
        for _ in range(count):
            yield chord


def events(landmarks: np.ndarray, side: float, seed: int) -> Iterator[tuple[Odometry, Sightings, np.ndarray]]:
    """Noisy odometry, noisy sightings, true pose."""
    tree, rng = cKDTree(landmarks), np.random.default_rng(seed)
    pose, sigmas = np.zeros(3), np.array([SIGMA_MOVE, SIGMA_MOVE / 3.0, SIGMA_TURN])
    covariance = np.diag(sigmas**2)[None]
    for number, step in enumerate(increments(side)):
        pose = compose(pose, step)
        noisy = step + sigmas * rng.standard_normal(3)
        near = np.array(sorted(tree.query_ball_point(pose[:2], RANGE)), dtype=np.int64)
        local = rotate(-pose[2], landmarks[near] - pose[:2])
        near, local = near[local[:, 0] > 0.0], local[local[:, 0] > 0.0]
        z = np.column_stack([np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])])
        z += rng.standard_normal(z.shape) * [0.1, math.radians(1.0)]
        z[:, 0] = np.maximum(z[:, 0], 0.0)
        t = STEP / 3.0 * (number + 1)
        yield (
            Odometry(t, noisy[None], np.array([STEP / 3.0]), covariance=covariance),
            Sightings(t, z, near),
            pose,
        )


def lawn(size: int) -> tuple[np.ndarray, float]:
    """Landmarks (N, 2), none farther than half a lane from the way, and the side of the lawn, m."""
    side = LANE * round(math.sqrt(250.0 * size) / LANE)
    rng = np.random.default_rng(np.random.SeedSequence((7, size)))
    return rng.uniform((0.0, -LANE / 2.0), (side, side - LANE / 2.0), (size, 2)), side


def fresh() -> LandmarkSlam:
    """The filter of every run."""
    return LandmarkSlam(Increments(), RangeBearing(sigma_range=0.1, sigma_bearing=math.radians(1.0)))


def measure(size: int, divided: bool, seed: int = 1) -> dict[str, float | int]:
    """One run: seconds and errors."""
    landmarks, side = lawn(size)
    slam = DivideAndConquer(fresh(), SETTINGS) if divided else fresh()
    joins = 0.0
    if divided:
        forest, close = slam._forest, slam._forest.close

        def timed(closed):
            nonlocal joins
            begin = time.process_time()
            close(closed)
            joins += time.process_time() - begin

        forest.close = timed
    seconds, worst, steps, pose, wall = 0.0, 0.0, 0, np.zeros(3), time.perf_counter()
    for odometry, frame, true in events(landmarks, side, seed):
        before, begin, live = joins, time.process_time(), time.perf_counter()
        slam.step(odometry)
        slam.step(frame)
        slam.pose  # noqa: B018, asked after every step
        seconds, steps, pose = seconds + time.process_time() - begin, steps + 1, true
        if joins == before:
            worst = max(worst, time.perf_counter() - live)
    begin = time.process_time()
    estimate = slam.estimate()
    end = time.process_time() - begin
    found = estimate.landmarks
    error = np.linalg.norm(found.positions - landmarks[found.ids], axis=1)
    nees = np.einsum(
        "ni,nij,nj->n",
        found.positions - landmarks[found.ids],
        np.linalg.inv(found.covariances),
        found.positions - landmarks[found.ids],
    )
    return {
        "size": size,
        "divided": int(divided),
        "steps": steps,
        "landmarks": len(found),
        "live_s": seconds - joins,
        "joins_s": joins,
        "end_s": end,
        "total_s": seconds + end,
        "wall_s_world_included": time.perf_counter() - wall,
        "live_ms_a_step": 1e3 * (seconds - joins) / steps,
        "amortised_ms_a_step": 1e3 * (seconds + end) / steps,
        "worst_live_ms": 1e3 * worst,
        "landmark_rms_m": float(np.sqrt((error**2).mean())),
        "landmark_nees_a_number": float(nees.mean() / 2.0),
        "end_error_m": float(np.linalg.norm(estimate.pose[:2] - pose[:2])),
        "maps": slam.maps_closed if divided else 1,
        "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def measure_isam(size: int, seed: int = 1) -> dict[str, float | int]:
    """GTSAM's iSAM2 on the same events, an update every frame."""
    import gtsam

    landmarks, side = lawn(size)
    settings = gtsam.ISAM2Params()
    settings.setFactorization("QR")  # its default, Cholesky, calls this system indeterminate
    isam = gtsam.ISAM2(settings)
    move = gtsam.noiseModel.Diagonal.Sigmas(np.array([SIGMA_MOVE, SIGMA_MOVE / 3.0, SIGMA_TURN]))
    look = gtsam.noiseModel.Diagonal.Sigmas(np.array([math.radians(1.0), 0.1]))
    fixed = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    x = lambda number: gtsam.symbol("x", number)  # noqa: E731
    point = lambda number: gtsam.symbol("l", number)  # noqa: E731
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.zeros(3)
    graph.add(gtsam.PriorFactorPose2(x(0), gtsam.Pose2(), fixed))
    values.insert(x(0), gtsam.Pose2())
    seen: set[int] = set()
    seconds, worst, steps = 0.0, 0.0, 0
    for odometry, frame, _ in events(landmarks, side, seed):
        begin = time.perf_counter()
        steps += 1
        step = odometry.values[0]
        pose = compose(pose, step)
        graph.add(gtsam.BetweenFactorPose2(x(steps - 1), x(steps), gtsam.Pose2(*step), move))
        values.insert(x(steps), gtsam.Pose2(*pose))
        for number, z in zip(frame.ids.tolist(), frame.values):
            graph.add(gtsam.BearingRangeFactor2D(x(steps), point(number), gtsam.Rot2(z[1]), z[0], look))
            if number not in seen:
                seen.add(number)
                values.insert(point(number), pose[:2] + rotate(pose[2] + z[1], np.array([z[0], 0.0])))
        isam.update(graph, values)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        now = isam.calculateEstimatePose2(x(steps))
        pose = np.array([now.x(), now.y(), now.theta()])
        spent = time.perf_counter() - begin
        seconds, worst = seconds + spent, max(worst, spent)
    found = isam.calculateEstimate()
    error = [np.linalg.norm(found.atPoint2(point(number)) - landmarks[number]) for number in seen]
    return {
        "size": size,
        "steps": steps,
        "total_s": seconds,
        "amortised_ms_a_step": 1e3 * seconds / steps,
        "worst_ms": 1e3 * worst,
        "landmark_rms_m": float(np.sqrt(np.mean(np.square(error)))),
    }


def slope(rows: list[dict], key: str) -> float:
    """Of ln key against ln size."""
    return float(np.polyfit(np.log([row["size"] for row in rows]), np.log([row[key] for row in rows]), 1)[0])


def main() -> None:
    """Run what is asked for and print it; write it as JSON after every run."""
    parser = argparse.ArgumentParser()
    for name, default in (("sizes", "1000,3000,10000"), ("plain", ""), ("isam", "")):
        parser.add_argument(f"--{name}", default=default)
    parser.add_argument("--out", default="")
    given = parser.parse_args()
    measure(200, True)  # loads the compiled kernels
    rows: dict[str, list[dict]] = {"divided": [], "plain": [], "isam2": []}
    jobs = {
        "divided": (given.sizes, lambda n: measure(n, True)),
        "plain": (given.plain, lambda n: measure(n, False)),
        "isam2": (given.isam, measure_isam),
    }
    for kind, (sizes, job) in jobs.items():
        for size in (int(text) for text in sizes.split(",") if text):
            rows[kind].append(job(size))
            print(kind, json.dumps(rows[kind][-1]), flush=True)
            if given.out:
                Path(given.out).write_text(json.dumps(rows, indent=1))
    if len(rows["divided"]) > 1:
        for key in ("live_ms_a_step", "amortised_ms_a_step", "total_s"):
            print(f"slope of {key} against landmarks: {slope(rows['divided'], key):.3f}")


if __name__ == "__main__":
    main()
