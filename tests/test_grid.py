"""The occupancy grid: its kernel against a twin that cuts beams at all grid lines, and rooms with known walls."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kalmap.kernels.grid import trace_beams
from kalmap.perception import occupancy_grid
from kalmap.perception.grid import classify
from kalmap.records import ConfigError, EstimationError, Scan, Sweeps
from kalmap.records.grid import FREE, OCCUPIED, UNKNOWN
from kalmap.simulate.raycast import cast, noisy

BEAMS = np.deg2rad(np.arange(-90.0, 90.0))
ROUND = np.deg2rad(np.arange(-180.0, 180.0))


def crossed(start, direction, length):
    """Cells that a beam crosses: it is cut at all grid lines, and each piece lies in the cell of its middle."""
    cuts = [0.0, length]
    for axis in range(2):
        if direction[axis] != 0.0:
            low, high = sorted([start[axis], start[axis] + length * direction[axis]])
            lines = np.arange(math.floor(low), math.ceil(high) + 1)
            cuts += ((lines - start[axis]) / direction[axis]).tolist()
    cuts = np.unique(np.clip(cuts, 0.0, length))
    middles = start + 0.5 * (cuts[1:] + cuts[:-1])[:, None] * direction
    return {(int(y), int(x)) for x, y in np.floor(middles)}


def twin(poses, firsts, ranges, bearings, limits, origin, resolution, shape):
    hits, passes = np.zeros(shape, dtype=np.int32), np.zeros(shape, dtype=np.int32)
    for k, pose in enumerate(poses):
        start = (pose[:2] - origin) / resolution
        hit, passed = set(), set()
        for b in range(firsts[k], firsts[k + 1]):
            turn = pose[2] + bearings[b]
            direction = np.array([math.cos(turn), math.sin(turn)])
            if limits[0] <= ranges[b] <= limits[1]:
                x, y = np.floor(start + ranges[b] / resolution * direction)
                hit.add((int(y), int(x)))
                passed |= crossed(start, direction, ranges[b] / resolution)
            elif ranges[b] > limits[1]:
                passed |= crossed(start, direction, min(ranges[b], limits[2]) / resolution)
        for cells, counts in ((hit, hits), (passed - hit, passes)):
            for row, column in cells:
                if 0 <= row < shape[0] and 0 <= column < shape[1]:
                    counts[row, column] += 1
    return hits, passes


@pytest.mark.parametrize("seed", range(4))
def test_the_kernel_counts_as_its_twin(seed):
    rng = np.random.default_rng(seed)
    poses = np.c_[rng.uniform(-1.0, 9.0, (12, 2)), rng.uniform(-9, 9, 12)]  # some stand outside
    poses[0] = [2.013, 3.021, 0.0]  # its beam 0 runs along a row exactly
    firsts = np.concatenate([[0], np.cumsum(rng.integers(0, 40, 12))])
    ranges = rng.uniform(0.0, 8.0, firsts[-1])
    bearings = rng.uniform(-3, 3, firsts[-1])
    for values, share in ((np.inf, 0.1), (np.nan, 0.1), (0.0, 0.1)):
        ranges[rng.random(firsts[-1]) < share] = values
    bearings[:1] = 0.0
    limits, origin, shape = np.array([0.2, 6.0, 4.0]), np.array([0.0, 1.0]), (70, 90)
    given = (poses, firsts, ranges, bearings, limits, origin, 0.1)
    hits, passes, marks = (np.zeros(shape, dtype=np.int32) for _ in range(3))
    trace_beams(*given, hits, passes, marks)
    expected = twin(*given, shape)
    assert expected[0].sum() > 30
    assert expected[1].sum() > 1000
    np.testing.assert_array_equal(hits, expected[0])
    np.testing.assert_array_equal(passes, expected[1])


ROOM = np.array([[0, 0, 6, 0], [6, 0, 6, 4], [6, 4, 0, 4], [0, 4, 0, 0]], dtype=float)


def sweeps_of(poses, segments=ROOM, sigma=0.0, bearings=ROUND, max_range=8.0, circles=None, seed=1):
    circles = np.zeros((0, 3)) if circles is None else circles
    ranges = cast(poses, circles, bearings, max_range, segments=segments)
    ranges = noisy(ranges, sigma, np.random.default_rng(seed))
    return Sweeps(poses, tuple(Scan(float(k), row, bearings) for k, row in enumerate(ranges)))


def walk(count):
    """Poses along the middle of the room, turning."""
    x = np.linspace(1.013, 5.017, count)
    return np.c_[x, 2.0 + 0.3 * np.sin(x), np.linspace(0, 5, count)]


def middles(grid):
    """(H, W) x and y of the cells' middles."""
    rows, columns = np.indices(grid.cells.shape)
    return (
        grid.origin[0] + (columns + 0.5) * grid.resolution,
        grid.origin[1] + (rows + 0.5) * grid.resolution,
    )


def test_a_room_is_free_inside_and_unknown_outside():
    grid = occupancy_grid(sweeps_of(walk(80), sigma=0.01), max_range=8.0)
    x, y = middles(grid)
    inside = (x > 0.1) & (x < 5.9) & (y > 0.1) & (y < 3.9)
    outside = (x < -0.1) | (x > 6.1) | (y < -0.1) | (y > 4.1)
    assert (grid.cells[inside] == FREE).all()
    assert (grid.cells[outside] == UNKNOWN).all()
    occupied = grid.cells == OCCUPIED
    off = np.minimum.reduce([np.abs(x), np.abs(x - 6), np.abs(y), np.abs(y - 4)])
    assert off[occupied].max() < 0.06
    # no wall has a gap: seen along it, every cell's width is blocked
    for near, along in (
        (np.abs(y) < 0.1, 1),
        (np.abs(y - 4) < 0.1, 1),
        (np.abs(x) < 0.1, 0),
        (np.abs(x - 6) < 0.1, 0),
    ):
        low, high = (0.2, 5.8) if along else (0.2, 3.8)
        coordinate = x if along else y
        span = (coordinate > low) & (coordinate < high) & near
        blocked = set(np.round(coordinate[span & occupied], 3))
        assert blocked == set(np.round(coordinate[span], 3))
    assert grid.extent == pytest.approx((-0.55, 6.6, -0.55, 4.6), abs=0.11)


def test_a_wall_along_the_beams_stays():
    """A robot close to a wall looks along it: its beams cross the cells that their neighbours hit."""
    poses = np.c_[np.linspace(0.5, 5.5, 60), np.full((60, 1), 0.3), np.zeros((60, 1))]
    grid = occupancy_grid(sweeps_of(poses, sigma=0.01, bearings=BEAMS), max_range=8.0)
    x, y = middles(grid)
    near = (np.abs(y) < 0.1) & (x > 1.0) & (x < 5.8)
    blocked = np.unique(np.round(x[near & (grid.cells == OCCUPIED)], 3))
    assert len(blocked) == len(np.unique(np.round(x[near], 3)))


def test_what_walked_away_is_cleared():
    person = np.array([[3.0, 2.9, 0.2]])
    with_person = sweeps_of(walk(60)[:12], circles=person)
    after = sweeps_of(walk(60)[12:])
    both = Sweeps(np.concatenate([with_person.poses, after.poses]), with_person.scans + after.scans)
    for sweeps, expected in ((with_person, OCCUPIED), (both, FREE)):
        grid = occupancy_grid(sweeps, max_range=8.0)
        x, y = middles(grid)
        front = (np.hypot(x - 3.0, y - 2.9) < 0.25) & (y < 2.78)
        assert (grid.cells[front] == expected).any()
        assert expected == OCCUPIED or not (grid.cells[front] == OCCUPIED).any()


def test_order_and_frame_do_not_matter():
    sweeps = sweeps_of(walk(30), sigma=0.01)
    order = np.random.default_rng(2).permutation(30)
    shuffled = Sweeps(sweeps.poses[order], tuple(sweeps.scans[k] for k in order))
    moved = Sweeps(sweeps.poses + [25.0, -75.0, 0.0], sweeps.scans)
    one, two, three = (occupancy_grid(each, max_range=8.0) for each in (sweeps, shuffled, moved))
    np.testing.assert_array_equal(one.cells, two.cells)
    # whole cells further on, but for beams that end on a line by rounding
    assert (one.cells != three.cells).mean() < 1e-3


@pytest.mark.parametrize(
    ("clear_range", "reaches"),
    [(None, 4.0), (2.0, 2.0), (0.0, 0.0), (50.0, 10.775)],
    ids=["sensor", "2", "0", "50"],
)
def test_what_came_back_from_nothing_clears_so_far(clear_range, reaches):
    """Ahead nothing comes back, coded as infinite or as a large number; a wall far off makes the grid large."""
    nothing = [Scan(0.0, np.array([value, 3.0]), np.array([0.0, 1.8])) for value in (np.inf, 81.83) * 3]
    wall = [Scan(0.0, np.array([3.0]), np.zeros(1))] * 6
    poses = np.array([[0.01, 0.01, 0.0]] * 6 + [[10.01, 0.01, 1.5]] * 6)
    grid = occupancy_grid(Sweeps(poses, (*nothing, *wall)), max_range=4.0, clear_range=clear_range)
    x, y = middles(grid)
    along = (y > 0.0) & (y < 0.05) & (x > 0.1) & (x < 9.9 if reaches < 9 else True)
    assert x[along & (grid.cells == FREE)].max(initial=0.0) == pytest.approx(reaches, abs=0.06)
    assert not (grid.cells[along] == OCCUPIED).any()


def test_ranges_that_say_nothing_do_nothing():
    bad = np.array([np.nan, 0.0, 0.05, -1.0])
    scans = (Scan(0.0, bad, np.linspace(-1, 1, 4)), Scan(0.0, np.zeros(0), np.zeros(0)))
    grid = occupancy_grid(Sweeps(np.zeros((2, 3)), scans), min_range=0.1, max_range=8.0)
    assert (grid.cells == UNKNOWN).all()
    assert grid.cells.size > 0


def test_evidence_is_bayes_rule():
    """One by one with Bayes' rule, as a robot would go about it."""
    for hits in range(5):
        for passes in range(9):
            p = 0.5
            for likelihood in [0.75] * hits + [0.4] * passes:
                p = p * likelihood / (p * likelihood + (1 - p) * (1 - likelihood))
            expected = OCCUPIED if p > 0.65 else FREE if p < 0.25 else UNKNOWN
            assert classify(np.array([hits]), np.array([passes]))[0] == expected


def test_infinite_reach_is_fine():
    grid = occupancy_grid(
        Sweeps(np.zeros((3, 3)), (Scan(0.0, np.array([np.inf, 2.0]), np.array([0.0, 1.0])),) * 3)
    )
    assert (grid.cells == OCCUPIED).sum() == 1


def test_what_cannot_be_is_refused():
    far = Scan(0.0, np.array([9e5]), np.zeros(1))
    near = Scan(0.0, np.array([1.0]), np.zeros(1))
    with pytest.raises(EstimationError, match=r"900001 m x 1 m at 0\.05 m a cell .* coarser"):
        occupancy_grid(Sweeps(np.zeros((1, 3)), (far,)))
    with pytest.raises(EstimationError, match="pose of scan 2 is not finite"):
        occupancy_grid(Sweeps(np.array([[0.0, 0, 0], [np.nan, 0, 0]]), (near, near)))
    with pytest.raises(EstimationError, match="there is no scan"):
        occupancy_grid(Sweeps(np.zeros((0, 3)), ()))
    one = Sweeps(np.zeros((1, 3)), (near,))
    for settings, message in (
        ({"resolution": 0.0}, "resolution"),
        ({"min_range": 2.0, "max_range": 1.0}, "hold nothing"),
        ({"max_range": float("nan")}, "hold nothing"),
        ({"margin": -1.0}, "margin"),
    ):
        with pytest.raises(ConfigError, match=message):
            occupancy_grid(one, **settings)
