"""Ground plans: walls around what is carved free, round walls, ways."""

import numpy as np
import pytest

from kalmap.simulate.plans import along, arc, box_walls, corridor, meets, outline


def length(walls):
    return np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]).sum()


def test_one_room_has_four_walls():
    walls = outline([(1.0, 2.0, 4.0, 8.0)])
    expected = {(1, 2, 4, 2), (1, 8, 4, 8), (1, 2, 1, 8), (4, 2, 4, 8)}
    assert {tuple(row) for row in walls.tolist()} == expected


def test_rooms_that_overlap_are_one_and_walls_in_line_come_whole():
    walls = outline([(0.0, 0.0, 3.0, 2.0), (2.0, 0.0, 6.0, 2.0)])
    assert {tuple(row) for row in walls.tolist()} == {(0, 0, 6, 0), (0, 2, 6, 2), (0, 0, 0, 2), (6, 0, 6, 2)}


def test_a_door_joins_two_rooms_and_has_jambs():
    rooms = [(0.0, 0.0, 3.0, 2.0), (3.2, 0.0, 6.0, 2.0), (3.0, 0.5, 3.2, 1.5)]
    walls = outline(rooms)
    assert length(walls) == pytest.approx(2 * (5 + 4.8) - 2 * 1.0 + 2 * 0.2)
    assert [3.0, 0.5, 3.2, 0.5] in walls.tolist() and [3.0, 0.0, 3.0, 0.5] in walls.tolist()


def test_what_is_put_back_and_what_a_curve_replaces():
    pillar = outline([(0.0, 0.0, 4.0, 4.0)], solid=[(1.0, 0.0, 2.0, 1.0)])
    assert length(pillar) == pytest.approx(16 + 2)
    corner = outline([(0.0, 0.0, 4.0, 4.0)], replaced=[(0.0, 0.0, 1.0, 1.0)])
    assert length(corner) == pytest.approx(16 - 2)


@pytest.mark.parametrize("seed", range(4))
def test_walls_are_where_free_and_solid_meet(seed):
    """Oracle: a raster; two points a hair to either side of a wall's middle are one free, one solid, and the walls'
    length is that of the raster's edges."""
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 20, (8, 2))
    free = np.column_stack([low, low + rng.integers(1, 9, (8, 2))]).astype(float)
    solid = np.array([[3.0, 3.0, 5.0, 9.0], [10.0, 2.0, 14.0, 4.0]])

    def is_free(x, y):
        def within(boxes):
            return ((boxes[:, 0] < x) & (x < boxes[:, 2]) & (boxes[:, 1] < y) & (y < boxes[:, 3])).any()

        return within(free) and not within(solid)

    walls = outline([*map(tuple, free)], [*map(tuple, solid)])
    raster = np.array([[is_free(x + 0.5, y + 0.5) for y in range(-1, 31)] for x in range(-1, 31)])
    edges = (raster[1:] != raster[:-1]).sum() + (raster[:, 1:] != raster[:, :-1]).sum()
    assert length(walls) == pytest.approx(float(edges))
    for a, b, c, d in walls:
        x, y = (a + c) / 2 + 1e-6, (b + d) / 2 + 1e-6
        across = np.array([b == d, a == c]) @ np.array([[0.0, 0.01], [0.01, 0.0]])
        assert is_free(x + across[0], y + across[1]) != is_free(x - across[0], y - across[1])


@pytest.mark.parametrize(
    ("radius", "first", "last"), [(4.0, 180.0, 270.0), (0.3, 0.0, 360.0), (2.0, 90.0, -90.0)]
)
def test_a_round_wall_is_nowhere_farther_than_its_sagitta(radius, first, last):
    """Oracle: the circle; ends of chords lie on it, their middles at most the sagitta inside."""
    walls = arc(1.0, -2.0, radius, first, last)
    ends = np.hypot(walls[:, 0] - 1.0, walls[:, 1] + 2.0)
    middles = np.hypot(walls[:, [0, 2]].mean(axis=1) - 1.0, walls[:, [1, 3]].mean(axis=1) + 2.0)
    np.testing.assert_allclose(ends, radius, atol=1e-12)
    assert 0 < (radius - middles).max() <= 1e-4
    np.testing.assert_allclose(walls[1:, :2], walls[:-1, 2:])
    turned = np.radians([first, last])
    expected = [1.0, -2.0] + radius * np.column_stack([np.cos(turned), np.sin(turned)])
    np.testing.assert_allclose([walls[0, :2], walls[-1, 2:]], expected, atol=1e-12)


def test_box_walls_turn():
    walls = box_walls(1.0, 1.0, 2.0, 1.0, np.pi / 2)
    np.testing.assert_allclose(walls[:, :2].min(axis=0), [0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(walls[:, :2].max(axis=0), [1.5, 2.0], atol=1e-12)
    assert length(walls) == pytest.approx(6.0)


def test_corridors_meet_at_their_corners():
    boxes = corridor([(0.0, 0.0), (10.0, 0.0), (10.0, 6.0), (0.0, 6.0)], 2.0)
    assert boxes[0] == (-1.0, -1.0, 11.0, 1.0) and len(boxes) == 4
    assert length(outline(boxes)) == pytest.approx(2 * (12 + 8) + 2 * (8 + 4))
    assert len(corridor([(0.0, 0.0), (5.0, 0.0)], 2.0, closed=False)) == 1


def test_meets():
    assert meets((0, 0, 1, 1), [(0.9, 0.9, 2, 2)]) and not meets((0, 0, 1, 1), [(1, 0, 2, 1)])
    assert meets((0, 0, 1, 1), [(1.1, 0, 2, 1)], 0.2) and not meets((0, 0, 1, 1), [])


def test_places_along_a_way():
    points = along(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), 0.3, closed=True)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.max() <= 0.3 and steps.sum() == pytest.approx(3 + 5**0.5)
    np.testing.assert_allclose(points[-1], points[0])
