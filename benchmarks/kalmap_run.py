"""One kalmap filter on one common world, in a process of its own. Prints a line of JSON.

speed: process CPU seconds of `slam.step` over the whole log, two calls a scan, after a warm-up that leaves
the compilation off the clock. accuracy: errors against the truth at every scan, NEES at every 50th, as the
peers do it.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from worlds import World, load

from kalmap import LandmarkSlam, RangeBearing, VelocitySteering
from kalmap.evaluation import pose_nees
from kalmap.geometry.angles import wrap
from kalmap.slam.filters import FILTERS

MARK = 50  # scans between two readings of the clock, and between two NEES
WARM_UP = 100  # scans


def make(filter_name: str, coordinates: str) -> LandmarkSlam:
    """A filter that knows the worlds' vehicle, sensor and noise, with the log's own association."""
    lineariser, scope = FILTERS[filter_name]
    motion = VelocitySteering(wheelbase=4.0, sigma_speed=0.3, sigma_steering=float(np.deg2rad(3.0)))
    sensor = RangeBearing(sigma_range=0.1, sigma_bearing=float(np.deg2rad(1.0)))
    return LandmarkSlam(motion, sensor, lineariser, scope=scope, coordinates=coordinates)


def speed(world: World, filter_name: str, coordinates: str, passes: int) -> dict[str, object]:
    """CPU seconds after every 50 scans, of the median pass."""
    _timed_pass(world, make(filter_name, coordinates), WARM_UP)
    count = len(world.scans)
    curves = [_timed_pass(world, make(filter_name, coordinates), count) for _ in range(passes)]
    middle = curves[int(np.argsort([curve[-1] for curve in curves])[(passes - 1) // 2])]
    marks = [*range(MARK, count, MARK), count]
    return {"scans": count, "cpu_s": middle[-1], "marks": marks, "curve": np.round(middle, 7).tolist()}


def _timed_pass(world: World, slam: LandmarkSlam, count: int) -> list[float]:
    step, clock, curve = slam.step, time.process_time, []
    begin = clock()
    for number, (odometry, sightings) in enumerate(world.scans[:count], start=1):
        step(odometry)
        step(sightings)
        if number % MARK == 0:
            curve.append(clock() - begin)
    if count % MARK:
        curve.append(clock() - begin)
    return curve


def accuracy(world: World, filter_name: str, coordinates: str) -> dict[str, object]:
    """RMS of position (m), heading (deg) and features (m), and the mean NEES of the pose."""
    slam = make(filter_name, coordinates)
    poses, rows, covariances = np.empty_like(world.truth), [], []
    for number, (odometry, sightings) in enumerate(world.scans):
        slam.step(odometry)
        slam.step(sightings)
        poses[number] = slam.pose
        if (number + 1) % MARK == 0 and slam.landmark_count:
            rows.append(number)
            covariances.append(slam.pose_covariance)
    landmarks = slam.estimate().landmarks
    apart = landmarks.positions - world.landmarks[landmarks.ids]
    error = poses - world.truth
    nees = pose_nees(world.truth[rows], poses[rows], np.array(covariances), coordinates)
    return {
        "scans": len(world.scans),
        "refused": world.refused,
        "position": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "heading_deg": float(np.rad2deg(np.sqrt(np.mean(wrap(error[:, 2]) ** 2)))),
        "features": float(np.sqrt(np.mean(np.sum(apart**2, axis=1)))),
        "nees": float(np.nanmean(nees)),
    }


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("speed", "accuracy"))
    parser.add_argument("--world", default="web35")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--filter", default="cr-cdkf", choices=sorted(FILTERS))
    parser.add_argument("--coordinates", default="invariant", choices=("invariant", "additive"))
    parser.add_argument("--passes", type=int, default=5)
    a = parser.parse_args()
    world = load(a.world, a.seed)
    if a.what == "speed":
        result = speed(world, a.filter, a.coordinates, a.passes)
    else:
        result = accuracy(world, a.filter, a.coordinates)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
