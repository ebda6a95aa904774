"""Scans cut into pieces of contour. Oracles: the worlds that the scans were cast in."""

from __future__ import annotations

import math

import numpy as np

from contour_scans import FULL, HALF, LASER, SIGMA, room, scan_of
from kalmap.geometry.se2 import rotate
from kalmap.perception import EndKind, cut_scan
from kalmap.records import Scan, SensorConfig

SEEDS = range(20)


def kinds(pieces):
    return [tuple(EndKind(k).name for k in pair) for pair in pieces.kinds]


def angle_between(curve, normal):
    at = curve.gradient(curve.origin)
    return math.acos(min(1.0, abs(at @ normal) / np.linalg.norm(at)))


def test_a_room_is_four_walls_that_meet_in_its_corners():
    """The scanner sees all round, and the scan's two ends lie in the middle of a wall."""
    corners = np.array([[-3.0, -2.0], [4.0, -2.0], [4.0, 3.0], [-3.0, 3.0]])
    for seed in SEEDS:
        pieces = cut_scan(
            scan_of(walls=room(-3, -2, 4, 3), bearings=FULL, rng=np.random.default_rng(seed)), LASER
        )
        assert (pieces.order == 1).all() and len(pieces) == 4
        assert (pieces.kinds == EndKind.CORNER).all()
        for k in range(4):
            for end in pieces.ends[k]:
                assert np.linalg.norm(corners - end, axis=1).min() < 0.15  # two beams
            assert pieces.curve(k).distance(np.zeros(2)) > 1.9
        assert (pieces.piece >= 0).mean() > 0.99


def test_pieces_follow_the_beams_and_name_them():
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(0))
    pieces = cut_scan(scan, LASER)
    assert len(pieces) == 3
    assert (pieces.first[1:] == pieces.last[:-1] + 1).all()
    assert kinds(pieces)[0][0] == "VIEW" and kinds(pieces)[-1][1] == "VIEW"
    for k in range(3):
        beams = pieces.beam[pieces.piece == k]
        assert (beams[0], beams[-1]) == (pieces.first[k], pieces.last[k])
        points = pieces.points[pieces.piece == k]
        ray = np.column_stack([np.cos(scan.bearings[beams]), np.sin(scan.bearings[beams])])
        np.testing.assert_allclose(points, scan.ranges[beams, None] * ray, atol=1e-12)
        np.testing.assert_allclose(pieces.ends[k], pieces.curve(k).project(points[[0, -1]]), atol=1e-9)
        np.testing.assert_allclose(
            pieces.lengths[k], np.linalg.norm(np.diff(pieces.ends[k], axis=0)), rtol=1e-12
        )


def test_pieces_are_in_the_robots_frame():
    """A scanner 0.3 m ahead, 0.1 m to the left and turned by 100 degrees sees what one at the centre does, moved."""
    scan = scan_of(walls=room(-3, -2, 4, 3), rng=np.random.default_rng(1))
    mounted = SensorConfig(
        sigma_range=SIGMA, max_range=80.0, mount_x=0.3, mount_y=0.1, mount_heading_deg=100.0
    )
    centred, moved = cut_scan(scan, LASER), cut_scan(scan, mounted)
    pose = np.array([0.3, 0.1, math.radians(100.0)])
    assert len(moved) == len(centred)
    np.testing.assert_allclose(moved.ends, pose[:2] + rotate(pose[2], centred.ends), atol=1e-9)
    for k in range(len(moved)):
        expected = centred.curve(k).moved(pose)
        np.testing.assert_allclose(
            moved.curve(k).distance(moved.points), expected.distance(moved.points), atol=1e-9
        )
        rows = moved.curve(k).distance_covariance(moved.points)
        np.testing.assert_allclose(rows, expected.distance_covariance(moved.points), atol=1e-12)
        assert moved.curve(k).distance(pose[:2]) > 0.0


def test_no_piece_crosses_a_doorway():
    """A wall with a doorway of 0.9 m into a room behind: both halves stop there."""
    walls = [[3, -4, 3, -0.45], [3, 0.45, 3, 4], [6, -5, 6, 5]]
    for seed in SEEDS:
        pieces = cut_scan(scan_of(walls=walls, bearings=HALF, rng=np.random.default_rng(seed)), LASER)
        near = [k for k in range(len(pieces)) if abs(pieces.ends[k, :, 0] - 3.0).max() < 0.1]
        assert len(near) == 2
        right, left = near
        assert -0.6 < pieces.ends[right, 1, 1] <= -0.43 and 0.43 <= pieces.ends[left, 0, 1] < 0.6
        assert pieces.kinds[right, 1] == EndKind.END and pieces.kinds[left, 0] == EndKind.END
        behind = next(k for k in range(len(pieces)) if abs(pieces.ends[k, :, 0] - 6.0).max() < 0.1)
        assert (pieces.kinds[behind] == EndKind.HIDDEN).all()


def test_a_column_hides_the_wall_behind_it():
    """A column of 0.6 m at 2 m, a wall at 4 m: the column is a conic of that radius, the wall two lines."""
    for seed in SEEDS:
        scan = scan_of(walls=[[4, -6, 4, 6]], circles=[[2.0, 0.0, 0.3]], rng=np.random.default_rng(seed))
        pieces = cut_scan(scan, LASER)
        column = np.flatnonzero(pieces.order == 2)
        assert len(column) == 1 and len(pieces) == 3
        assert (pieces.kinds[column[0]] == EndKind.END).all()
        curve = pieces.curve(column[0])
        middle = curve.project(np.array([1.7, 0.0]))
        assert np.linalg.norm(middle - [1.7, 0.0]) < 0.02
        assert 1.0 / 0.45 < curve.curvature(middle) < 1.0 / 0.2
        assert pieces.kinds[0, 1] == EndKind.HIDDEN and pieces.kinds[2, 0] == EndKind.HIDDEN
        assert (np.abs(np.array([pieces.curve(k).distance(np.zeros(2)) for k in (0, 2)]) - 4.0) < 0.03).all()


def test_an_open_side_is_silent():
    """Beyond the wall nothing sends a beam back."""
    pieces = cut_scan(scan_of(walls=[[3, -1, 3, 1]], rng=np.random.default_rng(2)), LASER)
    assert kinds(pieces) == [("SILENT", "SILENT")]


def test_a_wall_seen_along_goes_on_where_its_points_become_sparse():
    """A corridor of 2 m, 40 m long: its walls are one line each, and do not stop where the beams become sparse."""
    walls = [[-1, -1, 40, -1], [-1, 1, 40, 1]]
    for seed in SEEDS:
        pieces = cut_scan(scan_of(walls=walls, bearings=HALF, rng=np.random.default_rng(seed)), LASER)
        assert len(pieces) == 2
        assert (pieces.lengths > 6.0).all()
        assert kinds(pieces) == [("VIEW", "ONWARD"), ("ONWARD", "VIEW")]


def test_far_walls_seen_by_few_beams_are_single_lines():
    """60 m away, a degree between beams: points more than a metre apart, straight on and at 45 degrees."""
    for turn in (0.0, 45.0):
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        ends = [60 * c + 15 * s, 60 * s - 15 * c, 60 * c - 15 * s, 60 * s + 15 * c]
        scan = scan_of(walls=[ends], bearings=HALF, rng=np.random.default_rng(3), sigma=0.02)
        pieces = cut_scan(scan, SensorConfig(sigma_range=0.02, max_range=80.0))
        assert len(pieces) == 1 and pieces.order[0] == 1
        assert pieces.lengths[0] > 27.0
        assert angle_between(pieces.curve(0), np.array([c, s])) < 0.005


def test_an_s_of_a_wall_is_one_cubic():
    """Within 3 cm of the true wall. Oracle: the wall's own formula."""
    bearings = np.deg2rad(np.arange(-16.0, 16.1, 0.5))
    ranges = np.full(len(bearings), 3.0)
    for _ in range(400):
        ranges = 0.5 * ranges + 0.5 * (3.0 + 0.25 * np.sin(3.0 * ranges * np.sin(bearings))) / np.cos(
            bearings
        )
    truth = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    whole = 0
    for seed in SEEDS:
        noise = SIGMA * np.random.default_rng(seed).standard_normal(len(ranges))
        pieces = cut_scan(Scan(0.0, ranges + noise, bearings), LASER)
        whole += len(pieces) == 1 and pieces.order[0] == 3
        assert (pieces.piece >= 0).all() and len(pieces) <= 2
        for k in range(len(pieces)):
            points = truth[pieces.beam[pieces.piece == k]]
            assert np.abs(pieces.curve(k).distance(points)).max() < 0.03
    assert whole >= 18


def test_a_round_room_is_conics_that_follow_it():
    """The ring is opened somewhere; every piece stays within 3 cm of the circle and goes round by half a turn, and by
    what a run at either end may add, at most. Measured, 80 seeds: 2 or 3 pieces."""
    centre = np.array([0.5, 0.2])
    for seed in SEEDS:
        scan = scan_of(circles=[[*centre, 3.0]], bearings=FULL, rng=np.random.default_rng(seed))
        pieces = cut_scan(scan, LASER)
        assert len(pieces) <= 4 and (pieces.order[pieces.lengths > 2.0] > 1).all()
        for k in range(len(pieces)):
            feet = pieces.curve(k).project(pieces.points[pieces.piece == k]) - centre
            assert np.abs(np.hypot(*feet.T) - 3.0).max() < 0.03
            assert np.ptp(np.unwrap(np.arctan2(feet[:, 1], feet[:, 0]))) < math.radians(215.0)


def test_noise_smaller_than_the_sensor_says_lets_no_misfit_pass():
    """Monte Carlo in a superellipse, which is no cubic: its walls scatter by 1 cm, the sensor claims 1.5 cm. Squared
    errors in what the curves say of them, 1 if they told all; every number counted for the claim, they were 7."""
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    c, s = np.cos(angle), np.sin(angle)
    outline = np.column_stack([4.0 * np.sign(c) * np.abs(c) ** 0.7, 2.5 * np.sign(s) * np.abs(s) ** 0.7])
    walls = np.column_stack([outline[:-1], outline[1:]])
    claimed = SensorConfig(sigma_range=0.015, max_range=80.0)
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pose = rng.uniform([-2.0, -1.0, -3.0], [2.0, 1.0, 3.0])
        exact = scan_of(walls=walls, bearings=FULL, pose=pose).ranges
        pieces = cut_scan(Scan(0.0, exact + SIGMA * rng.standard_normal(len(exact)), FULL), claimed)
        truth = exact[:, None] * np.column_stack([np.cos(FULL), np.sin(FULL)])
        for k in range(len(pieces)):
            points = truth[pieces.beam[pieces.piece == k]]
            away, cov = pieces.curve(k).distance(points), pieces.curve(k).distance_covariance(points)
            squares += list(away**2 / np.diag(cov))
    assert np.mean(squares) < 4.0


def test_a_step_of_a_wall_is_a_cut():
    """A door 8 cm deep in a wall 2 m away: three lines, no curve through the steps."""
    walls = [[2, -2, 2, -0.4], [2.08, -0.4, 2.08, 0.4], [2, 0.4, 2, 2]]
    for seed in SEEDS:
        pieces = cut_scan(scan_of(walls=walls, rng=np.random.default_rng(seed)), LASER)
        assert (pieces.order == 1).all() and len(pieces) == 3


def test_a_mixed_pixel_between_two_walls_is_in_no_piece():
    scan = scan_of(walls=[[2, -2, 2, 0], [4, 0, 4, 4]], rng=np.random.default_rng(5))
    edge = int(np.flatnonzero(scan.ranges[:-1] < scan.ranges[1:] - 1.0)[0])
    ranges = scan.ranges.copy()
    ranges[edge + 1] = 0.5 * (ranges[edge] + ranges[edge + 2])
    pieces = cut_scan(Scan(0.0, ranges, scan.bearings), LASER)
    assert pieces.piece[pieces.beam == edge + 1] == -1
    assert len(pieces) == 2


def test_the_noise_of_a_walls_distances_is_what_the_cut_says():
    """Monte Carlo through the whole cut: 400 noisy scans of a room; normalised squared distances of three true points
    on each wall, with the pieces' joint covariance, have their chi-square's mean."""
    rng = np.random.default_rng(6)
    walls = room(-3, -2, 4, 3)
    truth = {0: [[-1, -2], [1, -2], [3, -2]], 1: [[4, -1], [4, 0.5], [4, 2]], 2: [[3, 3], [1, 3], [0.2, 3]]}
    total = []
    for _ in range(400):
        pieces = cut_scan(scan_of(walls=walls, rng=rng), LASER)
        assert len(pieces) == 3
        for k in range(3):
            points = np.array(truth[k], dtype=float)[
                [0, 2]
            ]  # a line has two freedoms: the third would be singular
            away, cov = pieces.curve(k).distance(points), pieces.curve(k).distance_covariance(points)
            total.append(away @ np.linalg.solve(cov, away))
    assert (
        1.4 < np.mean(total) < 2.2
    )  # 2, a little less for the beams' own uncertainty, which these scans lack
