"""Made-up results of mapping from scans: a floor of rooms along a corridor, driven, scanned and sampled with noise."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.records import Contours, Estimate, Landmarks, Scan, Sweeps, Trace, Trajectory
from kalmap.simulate.raycast import cast, noisy
from kalmap.view import Aligned, RunView

BEAMS = np.deg2rad(np.arange(-90.0, 90.0))
REACH = 8.0
DOORS = (2.0, 7.0, 12.0, 17.0)


def contours_of(strands, sigma=0.01, seed=1) -> Contours:
    """Contours with one run for each array (n, 2) of positions; surer across than along."""
    positions = np.concatenate([np.zeros((0, 2)), *strands])
    along = np.concatenate([np.zeros((0, 2)), *(_directions(strand) for strand in strands)])
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    outer = along[:, :, None] * along[:, None, :]
    grown = 1.0 + np.linspace(0, 3, len(positions))[:, None, None]
    return Contours(
        positions=positions,
        covariances=grown * sigma**2 * (np.eye(2) + 8.0 * outer),
        normals=normals,
        sightings=np.random.default_rng(seed).integers(1, 60, len(positions)),
        runs=np.repeat(np.arange(len(strands)), [len(strand) for strand in strands]),
    )


def _directions(strand: np.ndarray) -> np.ndarray:
    if len(strand) < 2:
        return np.tile([1.0, 0.0], (len(strand), 1))
    ways = np.gradient(strand, axis=0)
    return ways / np.hypot(*ways.T)[:, None]


def floor_walls() -> np.ndarray:
    """(S, 4): a corridor of 20 m between two rows of rooms, with doors, and a round column in one room."""
    walls = [[0, 0, 20, 0], [20, 0, 20, 12], [20, 12, 0, 12], [0, 12, 0, 0]]
    for x in (5, 10, 15):
        walls += [[x, 0, x, 5], [x, 7, x, 12]]
    for y in (5, 7):
        edges = [0.0, *(edge for door in DOORS for edge in (door, door + 1.0)), 20.0]
        walls += [[left, y, right, y] for left, right in zip(edges[::2], edges[1::2])]
    turn = np.linspace(0, 2 * np.pi, 25)
    column = np.column_stack([7.5 + 0.4 * np.cos(turn), 10.0 + 0.4 * np.sin(turn)])
    walls += np.hstack([column[:-1], column[1:]]).tolist()
    return np.array(walls, dtype=float)


def drive(step: float = 0.1) -> np.ndarray:
    """(F, 3) along the corridor, into four rooms, and back to the start, turning on the spot."""
    corners = [[1.0, 6.0]]
    for x, y in zip((2.5, 7.5, 12.5, 17.5), (2.0, 8.8, 2.0, 10.0)):
        corners += [[x, 6.0], [x, y], [x, 6.0]]
    corners += [[1.0, 6.0]]
    poses, heading = [], 0.0
    for start, end in zip(np.array(corners)[:-1], np.array(corners)[1:]):
        way = end - start
        turn = float(wrap(np.arctan2(way[1], way[0]) - heading))
        poses += [[*start, heading + share * turn] for share in np.linspace(0, 1, 2 + int(abs(turn) / 0.2))]
        heading += turn
        shares = np.linspace(0, 1, 1 + int(np.hypot(*way) / step))[:, None]
        poses += np.hstack([start + shares * way, np.full((len(shares), 1), heading)]).tolist()
    poses = np.array(poses)
    return np.column_stack([poses[:, :2], wrap(poses[:, 2])])


def floor_run(poses: float = 0.01, seed: int = 4, every: int = 3) -> RunView:
    """The floor as an estimator would hand it over. poses: m, standard deviation of the final poses of the scans.

    The trace, what was said at the time, drifts; the odometry drifts more. Two stamps are not in order.
    """
    rng = np.random.default_rng(seed)
    truth, walls = drive(), floor_walls()
    count = len(truth)
    times = 50.0 + 0.2 * np.arange(count)
    stamps = times.copy()
    stamps[[20, 21]] = stamps[[21, 20]]
    final = truth + poses * rng.standard_normal((count, 3)) * [1.0, 1.0, 0.1]
    grown = np.linspace(0.0, 1.0, count)
    online = truth + grown[:, None] * [0.25, -0.15, 0.01]
    covariances = (0.01 + 0.03 * grown**2)[:, None, None] * np.diag([1.0, 0.5, 0.05])
    contours = _sampled(walls, rng)
    estimate = _estimate(
        times[-1], final, 0.04 * covariances, contours, stamps, times, _scans(truth, walls, times, rng, every)
    )
    trace = Trace(
        times=times,
        poses=online,
        covariances=covariances,
        nis=np.full(count, np.nan),
        nis_dof=np.zeros(count, dtype=np.int64),
        landmarks=np.linspace(0, len(contours), count).astype(np.int64),
        sightings=np.full(count, 150),
        step_seconds=rng.gamma(6.0, 5e-4, count),
        step_times=times,
    )
    odometry = truth[:, :2] + np.column_stack([1.5 * grown**2, -2.0 * grown**2])
    reference = Aligned(kind="truth", path=truth[:, :2], walls=walls)
    return RunView("dc-slasem", "floor", estimate, trace, reference, odometry=odometry)


def _scans(truth, walls, times, rng, every):
    ranges = cast(truth[::every], np.zeros((0, 3)), BEAMS, REACH, segments=walls)
    ranges = noisy(ranges, 0.01, rng)
    scans = tuple(Scan(float(time), row, BEAMS) for time, row in zip(times[::every], ranges, strict=True))
    return scans, every


def _sampled(walls, rng, spacing: float = 0.3) -> Contours:
    strands = []
    for x1, y1, x2, y2 in walls[: len(walls) - 24]:
        shares = np.linspace(0, 1, 2 + int(np.hypot(x2 - x1, y2 - y1) / spacing))[:, None]
        strands.append((1 - shares) * [x1, y1] + shares * [x2, y2])
    strands.append(walls[len(walls) - 24 :, :2])
    noisy_strands = [strand + 0.01 * rng.standard_normal(strand.shape) for strand in strands]
    return contours_of([*noisy_strands, np.array([[13.0, 9.0]])])


def _estimate(time, final, covariances, contours, stamps, times, scanned) -> Estimate:
    scans, every = scanned
    nothing = np.zeros(0)
    landmarks = Landmarks(
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.zeros(0, dtype=np.int64),
        nothing,
    )
    n = 3 + 2 * len(contours)

    def joint():
        mean, covariance = np.empty(n), np.full((n, n), 1e-7)
        mean[:3], mean[3:] = final[-1], contours.positions.ravel()
        covariance[:3, :3] = covariances[-1]
        for k, block in enumerate(contours.covariances):
            covariance[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] = block
        return mean, covariance

    return Estimate(
        time=float(time),
        pose=final[-1],
        covariance=covariances[-1],
        landmarks=landmarks,
        biases={},
        joint=joint,
        coordinates="invariant",
        contours=contours,
        trajectory=Trajectory(times, final, covariances, stamps),
        sweeps=lambda: Sweeps(final[::every], scans),
        counts={"loops_closed": 2, "local_maps": 5},
    )
