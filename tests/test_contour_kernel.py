"""What a scan shows of the samples, the fit to it, and where new ones go, each against something slow or closed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from contour_scans import FINE, FULL, room, scan_of
from kalmap.geometry.se2 import rotate
from kalmap.kernels import contour as kernel
from kalmap.kernels import contour_state as state
from kalmap.kernels.implicit import signed_distance
from kalmap.perception.contours import cut_scan
from kalmap.records import SensorConfig

CAL, FIRST = state.CALIBRATION, state.SAMPLES
COLUMNS = 7  # of a distance: pose, bearing scale and range offset, sample
MOUNT = np.array([0.2, -0.1, 0.3])
REACH = 12.0
REACHES = np.array([REACH, REACH])


def scene(rng, *, sigma=0.0, pose=(0.3, -0.2, 0.1), bearings=FULL):
    """Samples and normals on the walls of a room with a box in it, and a scan from `pose` cut into pieces."""
    sensor = SensorConfig(
        mount_x=MOUNT[0], mount_y=MOUNT[1], mount_heading_deg=math.degrees(MOUNT[2]), sigma_range=0.01,
        max_range=REACH, field_of_view_deg=360.0,
    )  # fmt: skip
    walls = room(-3.0, -2.0, 4.0, 2.5) + [[1.5, 0.5, 1.5, 1.2], [1.5, 1.2, 2.2, 1.2]]
    pose = np.array(pose)
    scanner = np.array([*(pose[:2] + rotate(pose[2], MOUNT[:2])), pose[2] + MOUNT[2]])
    scan = scan_of(walls=walls, bearings=bearings, pose=scanner, rng=rng if sigma else None, sigma=sigma)
    pieces = cut_scan(scan, sensor)
    piece_of_beam = np.full(len(bearings), -1, dtype=np.int64)
    piece_of_beam[pieces.beam] = pieces.piece
    inside = [(0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0)]
    samples, normals = [], []
    for (x1, y1, x2, y2), normal in zip(walls, inside, strict=True):
        for t in np.arange(0.1, 0.95, 0.08):
            samples.append([x1 + t * (x2 - x1), y1 + t * (y2 - y1)])
            normals.append(normal)
    return np.array(samples), np.array(normals), scan, pieces, piece_of_beam


def seen_by(pose, samples, normals, scan, pieces, piece_of_beam, limit):
    found = np.empty(len(samples), dtype=np.int64)
    g, gradient = np.zeros(len(samples)), np.zeros((len(samples), 2))
    count = kernel.look(
        pose, samples, normals, MOUNT, scan.bearings, scan.ranges, piece_of_beam, pieces.coef, pieces.origin,
        pieces.scale, REACHES, limit, found, g, gradient,
    )  # fmt: skip
    return count, found, g, gradient


def twin_of_look(pose, samples, normals, scan, pieces, piece_of_beam, limit):
    """The same by whole arrays and the geometry alone: polar coordinates about the scanner, all beams, all pieces."""
    scanner = pose[:2] + rotate(pose[2], MOUNT[:2])
    way = samples - scanner
    r = np.hypot(*way.T)
    facing = -(way * normals).sum(axis=1) >= 0.05 * r
    bearing = np.arctan2(way[:, 1], way[:, 0]) - pose[2] - MOUNT[2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    robot, turned = rotate(-pose[2], samples - pose[:2]), rotate(-pose[2], normals)
    found, g = np.full(len(samples), kernel.HIDDEN), np.zeros(len(samples))
    for i in range(len(samples)):
        beam = int(np.abs(scan.bearings - bearing[i]).argmin())
        step = scan.bearings[1] - scan.bearings[0]
        if not facing[i] or r[i] < 1e-3 or r[i] > REACH + limit:
            continue
        if abs(scan.bearings[beam] - bearing[i]) > step:
            continue
        near = [b for b in (beam - 1, beam, beam + 1) if 0 <= b < len(scan.bearings)]
        best = limit
        for k in sorted({int(piece_of_beam[b]) for b in near} - {-1}):
            value, gx, gy = signed_distance(pieces.coef[k], *pieces.origin[k], pieces.scale[k], *robot[i])
            if abs(value) < best and gx * turned[i, 0] + gy * turned[i, 1] > 0.7:
                best, found[i], g[i] = abs(value), k, value
        if found[i] < 0:
            if (scan.ranges[near] > r[i] + limit).all():
                found[i] = kernel.OPEN
            elif not (scan.ranges[near] < r[i] - limit).all():
                found[i] = kernel.ASIDE
    return found, g


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bearings", [FINE, FULL])
def test_look(seed, bearings):
    """Oracle: the slow twin above; samples on the walls, beside them, behind them and in the open."""
    rng = np.random.default_rng(seed)
    pose = np.array([0.3, -0.2, 0.1]) + rng.normal(0, [0.2, 0.2, 0.3])
    samples, normals, *seen = scene(rng, sigma=0.01, pose=pose, bearings=bearings)
    angle = rng.uniform(-np.pi, np.pi, 150)
    more = rng.uniform([-4, -3], [5, 3.5], (150, 2))
    samples = np.vstack([samples + rng.normal(0, 0.05, samples.shape), more])
    normals = np.vstack([normals, np.column_stack([np.cos(angle), np.sin(angle)])])
    count, found, g, _ = seen_by(pose, samples, normals, *seen, 0.15)
    expected, distances = twin_of_look(pose, samples, normals, *seen, 0.15)
    assert np.array_equal(found, expected)
    assert count == (found >= 0).sum() and np.allclose(
        g[found >= 0], distances[found >= 0], rtol=0, atol=1e-12
    )
    assert {kernel.HIDDEN, kernel.OPEN, kernel.ASIDE} <= set(found.tolist()) and count > 20


@pytest.mark.parametrize("beams", [1, 2])
def test_look_with_hardly_a_beam(beams):
    samples, normals, scan, pieces, _ = scene(np.random.default_rng(0))
    few = scan.__class__(0.0, scan.ranges[:beams].copy(), scan.bearings[:beams].copy())
    count, found, _, _ = seen_by(
        np.zeros(3), samples, normals, few, pieces, np.full(beams, -1, dtype=np.int64), 0.1
    )
    assert count == 0 and (found < 0).all()


def fitted(pose, information, samples, normals, scan, pieces, piece_of_beam):
    n = len(samples)
    found = np.empty(n, dtype=np.int64)
    matched, squares = kernel.fit_pose(
        pose, information, samples, normals, MOUNT, scan.bearings, scan.ranges, piece_of_beam, pieces.coef,
        pieces.origin, pieces.scale, pieces.sigma, REACHES, np.array([0.5, 0.15]), 15, found, np.empty(n),
        np.empty((n, 2)),
    )  # fmt: skip
    return matched, squares


@pytest.mark.parametrize("seed", range(5))
def test_fit_pose_finds_the_true_pose_of_an_exact_scan(seed):
    """Oracle: the pose that the scan was cast from."""
    rng = np.random.default_rng(seed)
    truth = np.array([0.3, -0.2, 0.1]) + rng.normal(0, 0.2, 3)
    samples, normals, *seen = scene(rng, pose=truth)
    pose = truth + rng.normal(0, [0.08, 0.08, 0.04])
    matched, squares = fitted(pose, 1e-9 * np.eye(3), samples, normals, *seen)
    assert matched > 30 and squares < 1e-10
    assert np.allclose(pose, truth, rtol=0, atol=1e-6)


def test_fit_pose_holds_on_to_a_prior():
    """Oracle: the limit; information a million times that of the scan leaves the pose where it was."""
    samples, normals, *seen = scene(np.random.default_rng(0))
    pose = start = np.array([0.35, -0.2, 0.1])
    fitted(pose := start.copy(), 1e14 * np.eye(3), samples, normals, *seen)
    assert np.allclose(pose, start, rtol=0, atol=1e-6)


def test_fit_pose_with_noise_errs_no_more_than_it_says():
    """Oracle: Monte Carlo. NEES of 3 over 60 scans within its 99.9 % band from above; the weights are cautious (1 cm
    for every sample is added to the pieces' own), so from below it may be smaller."""
    values = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = np.array([0.3, -0.2, 0.1]) + rng.normal(0, 0.2, 3)
        samples, normals, *seen = scene(rng, sigma=0.01, pose=truth)
        pose, information = truth + rng.normal(0, [0.05, 0.05, 0.02]), 1e-6 * np.eye(3)
        fitted(pose, information, samples, normals, *seen)
        values.append((pose - truth) @ information @ (pose - truth))
    assert 0.1 < np.mean(values) < 4.2


LINE = np.array([[0.0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0]])  # y = 0, its free side above


ABOVE = np.array([0.0, 100.0, 0.0])  # a scanner that sees the line from straight ahead


def covered(
    hits, spacing, samples=None, normals=None, pose=(0.0, 0.0, 0.0), coef=LINE, mount=ABOVE, steepest=0.0
):
    hits = np.ascontiguousarray(hits, dtype=float)
    samples = np.zeros((0, 2)) if samples is None else samples
    normals = np.zeros((0, 2)) if normals is None else normals
    new, normal = np.empty((len(hits), 2)), np.empty((len(hits), 2))
    piece = np.empty(len(hits), dtype=np.int64)
    count = kernel.uncovered(
        np.array(pose), hits, np.zeros(len(hits), dtype=np.int64), mount, steepest, coef, np.zeros((1, 2)), np.ones(1),
        np.array([spacing]), samples, normals, new, normal, piece,
    )  # fmt: skip
    return new[:count], normal[:count]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (3.0, -1.0, 2.5)])
def test_new_samples_stand_where_contour_is_seen_at_no_grazing_angle(pose):
    """By hand: a scanner 1 m off a line sees it at 30 degrees or more within sqrt(3) m, and from behind nowhere."""
    hits = np.column_stack([np.arange(-6.0, 6.0, 0.05), np.zeros(240)])
    mount = np.array([0.5, 1.0, 0.7])
    new, _ = covered(hits, 0.2, pose=pose, mount=mount, steepest=0.5)
    assert np.abs(new[:, 0] - 0.5).max() <= np.sqrt(3.0)
    assert np.abs(new[:, 0] - 0.5).max() > np.sqrt(3.0) - 0.2
    assert len(covered(hits, 0.2, pose=pose, mount=-mount, steepest=0.5)[0]) == 0
    assert np.abs(covered(hits, 0.2, pose=pose, mount=mount)[0][:, 0]).max() > 5.7


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.01, 0.15), min_size=2, max_size=120),
    st.floats(0.2, 0.6),
    st.lists(st.floats(0.0, 10.0), max_size=20),
    st.floats(-3.0, 3.0),
)
def test_new_samples_are_neither_too_near_nor_too_far(gaps, spacing, old, turn):
    """Oracle: the definition. Not two within 0.75 spacings on one side, and every hit on a dense wall within one."""
    x = np.cumsum(gaps)
    hits = np.column_stack([x, 0.02 * np.sin(40.0 * x)])
    pose = np.array([1.0, -2.0, turn])
    there = np.column_stack([np.array(old), np.zeros(len(old))]).reshape(-1, 2)
    samples, up = pose[:2] + rotate(turn, there), rotate(turn, np.tile([0.0, 1.0], (len(old), 1)))
    new, normal = covered(hits, spacing, samples.reshape(-1, 2), up.reshape(-1, 2), pose)
    assert np.allclose(new[:, 1], 0.0, atol=1e-9) and np.allclose(normal, [0.0, 1.0], atol=1e-9)
    every = np.concatenate([there[:, 0], new[:, 0]])
    apart = np.abs(new[:, 0][:, None] - every[None])
    apart[np.arange(len(new)), len(there) + np.arange(len(new))] = np.inf
    assert (apart >= 0.75 * spacing * (1 - 1e-9)).all()
    assert (np.abs(x[:, None] - every[None]).min(axis=1) <= spacing).all()


def test_the_other_side_of_a_thin_wall_does_not_cover():
    x = np.arange(0.0, 2.0, 0.05)
    hits = np.column_stack([x, np.zeros(len(x))])
    samples = np.column_stack([np.arange(0.0, 2.0, 0.2), np.zeros(10)])
    new, _ = covered(hits, 0.3, samples, np.tile([0.0, -1.0], (10, 1)))
    assert len(new) >= 6
    none, _ = covered(hits, 0.3, samples, np.tile([0.0, 1.0], (10, 1)))
    assert len(none) == 0


def test_between_beams_far_apart_nothing_is_known():
    hits = np.column_stack([np.arange(0.0, 10.0, 1.0), np.zeros(10)])
    assert len(covered(hits, 0.3)[0]) == 0
