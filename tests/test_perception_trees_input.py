"""The tree detector on scans of every kind: other beams, missing returns, its own vehicle, nonsense."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from cast_scans import look, polar
from kalmap.perception.trees import TreeDetector
from kalmap.records import ConfigError, EventError, Scan
from kalmap.simulate.raycast import SICK, URG

FIND = TreeDetector()


def test_the_own_body_is_not_seen_but_hides():
    """Returns nearer than `min_range`: none is a trunk, and a trunk that they touch is not whole."""
    (scan,) = look([[0.35, -1.0, 0.3], [6.0, 0.0, 0.2]])
    assert len(FIND(scan).values) == 1
    (scan,) = look([[0.9, -0.25, 0.25], [6.0, 0.0, 0.2]])
    assert np.isfinite(scan.ranges[180:]).any() and len(FIND(scan).values) == 0


def test_attributes_order_and_origin():
    (scan,) = look([[8.0, 4.0, 0.2], [8.0, -4.0, 0.3]])
    scan = msgspec.structs.replace(scan, record=9, file="a")
    seen = FIND(scan)
    assert (seen.time, seen.record, seen.file, seen.ids) == (0.0, 9, "a", None)
    assert seen.scan is scan and seen.values[0, 1] < 0 < seen.values[1, 1]
    assert seen.attributes["beams"].tolist() == [
        np.isfinite(scan.ranges[:180]).sum(),
        np.isfinite(scan.ranges[180:]).sum(),
    ]


@pytest.mark.parametrize("scanner", [SICK, URG], ids=["SICK", "URG"])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_other_beams(scanner, every):
    """Oracle: the true circle, with every second and third beam, and over another scanner's field of view."""
    thinned = msgspec.structs.replace(scanner, bearings=scanner.bearings[::every])
    find = TreeDetector(max_range=scanner.max_range, clearance=1.0)
    seen = find(look([[2.5, 1.5, 0.1], [1.0, -2.5, 0.15]], scanner=thinned)[0])
    spacing = 2.9 * np.diff(thinned.bearings)[0]  # m, at the farther one
    assert np.allclose(seen.values, polar(np.array([[1.0, -2.5], [2.5, 1.5]])), atol=0.6 * spacing)
    assert np.allclose(seen.attributes["diameter"], [0.3, 0.2], atol=1.1 * spacing)


@pytest.mark.parametrize("dead", [np.nan, np.inf, -np.inf, 0.0, -3.0, 81.91, 80.0])
def test_beams_without_return(dead):
    """All dead: nothing; otherwise they count as `inf` does."""
    assert len(FIND(Scan(1.0, np.full(361, dead), SICK.bearings)).values) == 0
    (scan,) = look([[8.0, 0.0, 0.3], [30.0, 9.0, 0.2]])
    marked = np.where(np.isfinite(scan.ranges), scan.ranges, dead)
    assert np.array_equal(FIND(Scan(0.0, marked, SICK.bearings)).values, FIND(scan).values)


def test_one_lost_beam_does_not_cut_a_trunk_but_two_do():
    (scan,) = look([[6.0, 0.0, 0.3]])
    whole_trunk = FIND(scan)
    lost = [scan.ranges.copy(), scan.ranges.copy()]
    lost[0][181], lost[1][181:183] = np.inf, np.inf
    holed = FIND(Scan(0.0, lost[0], SICK.bearings))
    assert np.allclose(holed.values, whole_trunk.values, atol=0.01)
    assert holed.attributes["beams"][0] == whole_trunk.attributes["beams"][0] - 1
    assert len(FIND(Scan(0.0, lost[1], SICK.bearings)).values) == 0


@pytest.mark.parametrize("value", [0.5, 2.0, 20.0])
@pytest.mark.parametrize("size", [0, 1, 2, 3, 361])
def test_full_and_tiny_scans_hold_no_trunk(size, value):
    seen = FIND(Scan(0.0, np.full(size, value), SICK.bearings[:size]))
    assert seen.values.shape == (0, 2) and seen.attributes["diameter"].shape == (0,)


@pytest.mark.parametrize(
    ("ranges", "bearings", "field"),
    [
        (np.ones(3), np.arange(4.0), "ranges"),
        (np.ones((2, 2)), np.zeros((2, 2)), "ranges"),
        (np.ones(3), np.array([0.0, np.nan, 1.0]), "bearings"),
        (np.ones(3), np.array([0.0, 1.0, np.inf]), "bearings"),
        (np.ones(3), np.array([0.0, 1.0, 1.0]), "bearings"),
        (np.ones(3), np.array([2.0, 1.0, 0.0]), "bearings"),
    ],
)
def test_scans_that_make_no_sense_are_refused(ranges, bearings, field):
    with pytest.raises(EventError, match=f"t = 2 s, field {field}") as caught:
        FIND(Scan(2.0, ranges, bearings))
    assert (caught.value.time, caught.value.field) == (2.0, field)


@pytest.mark.parametrize(
    "setting",
    [
        {"max_range": np.nan},
        {"max_range": 1.0},
        {"sigma_range": 0.0},
        {"clearance": -1.0},
        {"min_diameter": 2.0},
    ],
)
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(ConfigError, match="tree detector"):
        TreeDetector(**setting)
