"""In under a minute: has speed or accuracy broken? Generous bounds, no peers. Ends with 1 if so.

python benchmarks/smoke.py
"""

from __future__ import annotations

import sys
import time

import association  # sets one BLAS thread before numpy comes
import scaling

import msgspec  # isort: skip
import numpy as np  # isort: skip

from kalmap import run, slam_from_config
from kalmap.evaluation import evaluate, pose_nees, score_pairs
from kalmap.perception import cut_scan
from kalmap.records import AssociationConfig, FiniteSetConfig, Scan, SensorConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.simulate.raycast import URG, cast
from kalmap.slam.run import warm_up

SLOPE, BLAS_RATIO, BUFFERS = 2.4, 2.5, 1.3
STEP_SHARE = 0.1  # of n^2 doubles: what a step may allocate at n = 2,003
DJNN_US, DJNN_F1, DJNN_FEATURES = 250.0, 0.9, 400.0  # a frame at 300 landmarks; djnn-10 with the defaults
SET_MS, SET_POSITION, SET_OFF = 4.0, 2.5, 4.0  # a frame of phd-1 by pmb with five particles
CUT_MS = {180: 0.3, 683: 1.0}  # a scan of so many beams in a cluttered room, cut into pieces of contour
MS_PER_SCAN, POSITION_M, FEATURES_M, NEES = 1.0, 12.0, 8.0, 12.0  # course-35, the default filter


def course_35(seeds: range) -> dict[str, float]:
    """The default filter on the package's own course: CPU ms per scan, RMS errors, mean NEES."""
    seconds, scans, square, apart, nees = 0.0, 0, [], [], []
    for seed in seeds:
        log = simulate(world_by_name("course-35"), seed)
        slam, truth, events = slam_from_config(log.defaults, log), log.references[0], list(log)
        poses = np.empty((len(events), 3))
        covariances = np.empty((len(events), 3, 3))
        for i, event in enumerate(events):
            begin = time.process_time()
            slam.step(event)
            seconds += time.process_time() - begin
            poses[i], covariances[i] = slam.pose, slam.pose_covariance
        rows = np.searchsorted(truth.times, [event.time - 1e-9 for event in events])
        exact = np.column_stack([truth.positions[rows], truth.headings[rows]])
        square.append(np.sum((poses - exact)[:, :2] ** 2, axis=1).mean())
        nees.append(np.nanmean(pose_nees(exact, poses, covariances, "invariant")[100:]))
        found = slam.estimate().landmarks
        apart.append(np.sum((found.positions - truth.landmarks[found.ids]) ** 2, axis=1).mean())
        scans += len(events) // 2
    return {
        "ms": 1e3 * seconds / scans,
        "position": float(np.sqrt(np.mean(square))),
        "features": float(np.sqrt(np.mean(apart))),
        "nees": float(np.mean(nees)),
    }


def djnn_frame_us() -> float:
    """A frame at 300 landmarks, us: the least of up to three measurements, since others' work only makes it longer."""
    least = np.inf
    for _ in range(3):
        least = min(least, association.measure((300,), 100, 3, ("djnn",))[0]["median_us"])
        if least <= DJNN_US:
            break
    return float(least)


def djnn_10() -> dict[str, float]:
    """DJNN without ids in the paper's world with 10 movers: pairwise F1 and features in the map."""
    log = simulate(world_by_name("djnn-10"), 1)
    config = msgspec.structs.replace(log.defaults, association=AssociationConfig(method="djnn"))
    outcome = run(slam_from_config(config, log), log, reckon=False)
    return {
        "f1": score_pairs(outcome.truth_ids, outcome.labels).f1 or 0.0,
        "features": float(len(outcome.estimate.landmarks)),
    }


def phd_1() -> dict[str, float]:
    """pmb with five particles in the world of Yan et al.: CPU ms a frame, RMS error, features too many or too few."""
    log = simulate(world_by_name("phd-1"), 1)
    sets = FiniteSetConfig(method="pmb", particles=5, threads=1, detection=0.95, clutter=1.0)
    slam = slam_from_config(msgspec.structs.replace(log.defaults, finite_set=sets), log)
    warm_up(slam)
    begin = time.process_time()
    outcome = run(slam, log, reckon=False)
    spent = time.process_time() - begin
    truth = log.references[0]
    return {
        "ms": 1e3 * spent / outcome.frames,
        "position": float(evaluate(outcome.trace, outcome.estimate, log)["position_rmse_m"] or np.inf),
        "off": float(abs(len(outcome.estimate.landmarks) - len(truth.landmarks))),
    }


def cut_ms(bearings: np.ndarray) -> float:
    """Cutting a scan of a cluttered room: CPU ms, the best of 30 times."""
    rng = np.random.default_rng(9)
    circles = np.column_stack([rng.uniform(-3, 4, 12), rng.uniform(-2, 3, 12), rng.uniform(0.05, 0.4, 12)])
    circles = circles[np.hypot(*circles[:, :2].T) > 0.8]
    walls = np.array([[-3, -2, 4, -2], [4, -2, 4, 3], [4, 3, -3, 3], [-3, 3, -3, -2]], dtype=float)
    ranges = cast(np.zeros((1, 3)), circles, bearings, 80.0, segments=walls)[0]
    scan = Scan(0.0, ranges + 0.01 * rng.standard_normal(len(ranges)), bearings)
    best = np.inf
    for _ in range(30):
        begin = time.process_time()
        cut_scan(scan, SensorConfig(sigma_range=0.01, max_range=80.0))
        best = min(best, time.process_time() - begin)
    return 1e3 * best


def checks() -> list[tuple[str, float, float]]:
    """(what, measured, at most)."""
    scaling.Course(100, "cr-cdkf").timed(5)  # compiles
    course_35(range(1))
    run = course_35(range(1, 4))
    blas = scaling.against_blas("cr-cdkf", "invariant", 12, 8)
    step = scaling.step_memory(2003, "cr-cdkf")
    grown = scaling.map_memory(1003, "cr-cdkf")
    paper = djnn_10()
    cuts = {len(each): cut_ms(each) for each in (np.deg2rad(np.arange(-90.0, 90.0)), URG.bearings)}
    sets = phd_1()
    frame = djnn_frame_us()
    return [
        ("DJNN at 300 landmarks, us a frame", frame, DJNN_US),
        ("djnn-10, pairwise F1 of DJNN: what is missing to 1", 1.0 - paper["f1"], 1.0 - DJNN_F1),
        ("djnn-10, features in DJNN's map (252 are real)", paper["features"], DJNN_FEATURES),
        ("slope of a frame's time in n, 100 to 2,000",
         scaling.slope(scaling.frame_times((100, 300, 1000, 2000), "cr-cdkf", 8)), SLOPE),
        ("rank-20 update at n = 2,003 over dsyrk", blas["ratio"], BLAS_RATIO),
        ("Python bytes of a step over n^2 doubles", step["python_bytes"] / step["n2_bytes"], STEP_SHARE),
        ("resident bytes of a step over n^2 doubles", step["resident_bytes"] / step["n2_bytes"], STEP_SHARE),
        ("buffers of a map over n^2 doubles", grown["buffers_share"], BUFFERS),
        ("course-35, CPU ms per scan", run["ms"], MS_PER_SCAN),
        ("course-35, position m", run["position"], POSITION_M),
        ("course-35, features m", run["features"], FEATURES_M),
        ("course-35, NEES (3 is right)", run["nees"], NEES),
        *((f"a scan of {beams} beams cut into pieces, CPU ms", cuts[beams], CUT_MS[beams]) for beams in cuts),
        ("phd-1, pmb with 5 particles, CPU ms a frame", sets["ms"], SET_MS),
        ("phd-1, pmb, position m", sets["position"], SET_POSITION),
        ("phd-1, pmb, features too many or too few (39 are real)", sets["off"], SET_OFF),
    ]  # fmt: skip


def main() -> int:
    """Print every check; 1 if one is broken. A number that is not finite is broken too."""
    broken = 0
    for what, measured, most in checks():
        good = measured <= most
        broken += not good
        print(f"{'ok    ' if good else 'BROKEN'}  {what}: {measured:.3g} (at most {most:g})")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
