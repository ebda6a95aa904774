"""How long joint compatibility branch and bound takes on frames of 15 sightings and 20 candidates.

A frame is drawn from the Gaussian that the filter would hold: a pose that is off, a map whose landmarks share an
error (the map has drifted with the robot) and have one of their own, range-bearing sightings of 15 of 20 landmarks
within 30 m ahead; a part of the sightings is of nothing in the map, at random in view. The readings:

- "frame": the pose is off by 2.5 m and 6 degrees, 2 to 5 candidates inside a sighting's gate on average;
- "frame, 3 strangers", "frame, 8 strangers": the same with so many sightings of nothing in the map;
- "all gated": the gate is open, so that every sighting has all 20 candidates; "lost": the pose is off by 8 m and
  25 degrees, so that almost every pair is inside its gate; both also with strangers;
- "twins": each landmark has a double 0.2 m away, as a map has before its duplicates are merged;
- "60 x 80": a crowded frame, by branch and bound and by the randomised variant.

CPU time of one call of `jcbb` or `randomised_joint` from Python, wrapper included; per frame the median of the
rounds, between which all the other frames are matched. "right" is the share of sightings that went where they came
from, "optimum" the share of frames where the answer is the optimum: proven, or for the randomised variant that of
branch and bound (where that is proven). One BLAS thread is set here.

    python benchmarks/jcbb.py [--quick]
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np
import report

from kalmap.association.joint import jcbb, randomised_joint
from kalmap.geometry.angles import wrap
from kalmap.geometry.ellipses import chi_square

GATE, JOINT = 0.99, 0.95
REACH, SIGMA_RANGE, SIGMA_BEARING = 30.0, 0.1, np.deg2rad(1.0)
NEAR, FAR = (2.5, np.deg2rad(6.0)), (8.0, np.deg2rad(25.0))
TARGET_US = 1000.0

# name: (sightings, landmarks, pose off by, strangers, gate open, twins)
READINGS: dict[str, tuple[int, int, tuple[float, float], int, bool, bool]] = {
    "frame": (15, 20, NEAR, 0, False, False),
    "frame, 3 strangers": (15, 20, NEAR, 3, False, False),
    "frame, 8 strangers": (15, 20, NEAR, 8, False, False),
    "all gated": (15, 20, NEAR, 0, True, False),
    "all gated, 3 strangers": (15, 20, NEAR, 3, True, False),
    "lost": (15, 20, FAR, 0, False, False),
    "lost, 3 strangers": (15, 20, FAR, 3, False, False),
    "twins": (15, 20, NEAR, 0, False, True),
    "60 x 80": (60, 80, NEAR, 12, False, False),
}


def places(rng: np.random.Generator, count: int, twins: bool) -> np.ndarray:
    """(count, 2) m, in a half disc ahead of the robot, in its frame; not nearer than 2 m to it."""
    distance = rng.uniform(2.0**2, REACH**2, count) ** 0.5
    bearing = rng.uniform(-0.5 * np.pi, 0.5 * np.pi, count)
    place = distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    if twins:
        angle = rng.uniform(-np.pi, np.pi, count // 2)
        place[1::2] = place[::2][: count // 2] + 0.2 * np.column_stack([np.cos(angle), np.sin(angle)])
    return place


def frame(name: str, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The arguments of a frame's association, and the landmark that each sighting is of, -1 for none."""
    sightings, count, (off, turn), strangers, _, twins = READINGS[name]
    rng = np.random.default_rng(seed)
    place = places(rng, count, twins)
    square, distance = (place**2).sum(axis=1), np.hypot(*place.T)
    # Columns: the pose's error, relative to the drifted map, the map's drift, each landmark's own error.
    gradient = np.stack([place / distance[:, None], place[:, ::-1] * [-1.0, 1.0] / square[:, None]], axis=1)
    matrix = np.zeros((count, 2, 3 + 2 + 2 * count))
    matrix[:, :, :2], matrix[:, 1, 2], matrix[:, :, 3:5] = -gradient, -1.0, gradient
    for c in range(count):
        matrix[c, :, 5 + 2 * c : 7 + 2 * c] = gradient[c]
    sigma = np.r_[off, off, turn, 0.5, 0.5, np.full(2 * count, 0.2)]
    matrix = matrix.reshape(2 * count, -1)
    expected = np.column_stack([distance, np.arctan2(place[:, 1], place[:, 0])])
    seen = expected + (matrix @ (sigma * rng.standard_normal(len(sigma)))).reshape(-1, 2)
    source = rng.permutation(count)[:sightings]
    z = seen[source] + rng.standard_normal((sightings, 2)) * [SIGMA_RANGE, SIGMA_BEARING]
    false = places(rng, strangers, False)
    z[:strangers] = np.column_stack([np.hypot(*false.T), np.arctan2(false[:, 1], false[:, 0])])
    source[:strangers] = -1
    nu = z[:, None] - expected[None]
    nu[..., 1] = wrap(nu[..., 1])
    scaled = matrix * sigma
    cross = (scaled @ scaled.T).reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    noises = np.tile(np.diag([SIGMA_RANGE**2, SIGMA_BEARING**2]), (sightings, 1, 1))
    spread = cross[np.arange(count), np.arange(count)] + noises[:, None]
    squared = np.einsum("mci,mci->mc", nu, np.linalg.solve(spread, nu[..., None])[..., 0])
    return {"nu": nu, "cross": np.ascontiguousarray(cross), "noises": noises, "squared": squared}, source


def measure(name: str, frames: int, rounds: int, randomised: bool = False) -> dict[str, Any]:
    """One line of the table."""
    problems = [frame(name, seed) for seed in range(frames)]
    settings = {"gate": np.inf if READINGS[name][4] else chi_square(GATE, 2), "joint_probability": JOINT}
    exact = [jcbb(**problem, **settings) for problem, _ in problems]
    found, times = list(exact), np.empty((rounds, frames))
    for i in range(rounds):
        for j, (problem, _) in enumerate(problems):
            more = {"rng": np.random.default_rng(j)} if randomised else {}
            begin = time.process_time_ns()
            found[j] = (randomised_joint if randomised else jcbb)(**problem, **settings, **more)
            times[i, j] = 1e-3 * (time.process_time_ns() - begin)
    each, nodes = np.median(times, axis=0), [one.nodes for one in found]
    optimal = [
        whole.complete and np.array_equal(one.matched, whole.matched)
        for one, whole in zip(found, exact, strict=True)
    ]
    return {
        "reading": name,
        "method": "randomised" if randomised else "exact",
        "frames": frames,
        "candidates": float(
            np.mean([(p["squared"] <= settings["gate"]).sum(axis=1).mean() for p, _ in problems])
        ),
        "pairs": float(np.mean([one.pairs for one in found])),
        "right": float(
            np.mean([(one.matched == true).mean() for one, (_, true) in zip(found, problems, strict=True)])
        ),
        "optimum": float(np.mean(optimal)),
        "median_us": float(np.median(each)),
        "us_90": float(np.quantile(each, 0.9)),
        "most_us": float(each.max()),
        "nodes": float(np.median(nodes)),
        "nodes_90": float(np.quantile(nodes, 0.9)),
        "most_nodes": int(max(nodes)),
    }


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    frames, rounds = (40, 3) if parser.parse_args().quick else (300, 7)
    large = frames // 10  # of frames that take a hundred milliseconds
    records = [measure(name, frames if READINGS[name][0] == 15 else large, rounds) for name in READINGS]
    records.append(measure("60 x 80", large, rounds, randomised=True))
    columns = {
        "reading": "reading",
        "method": "method",
        "frames": "frames",
        "candidates": "candidates",
        "pairs": "pairs",
        "right": "right",
        "optimum": "optimum",
        "median us": "median_us",
        "90 % us": "us_90",
        "most us": "most_us",
    }
    rows = [
        [r[key] for key in columns.values()] + [f"{r['nodes']:g}, {r['nodes_90']:g}, {r['most_nodes']}"]
        for r in records
    ]
    frame_us = records[0]["median_us"]
    text = f"""{report.table((*columns, "nodes: median, 90 %, most"), rows)}

15 sightings x 20 gated candidates ("frame"): median {frame_us:.3g} us (asked: below {TARGET_US:g}), {frames} frames."""
    report.write("jcbb_quick" if parser.parse_args().quick else "jcbb", text, records)


if __name__ == "__main__":
    main()
