"""Floors on the command line: by name, with other numbers, with another plan."""

import numpy as np
import pytest
from click.testing import CliRunner

from kalmap.cli.main import kalmap
from kalmap.cli.source import find_world
from kalmap.records import ConfigError
from kalmap.simulate import FloorWorld, rooms_world
from test_simulate_floors import FLOORS


def test_numbers_names_and_switches_can_be_set():
    changes = {"people": 3, "speed": 1, "upside_down": True, "scanner": "sick", "max_range": 20.0}
    world = find_world("floor-115", changes)
    assert isinstance(world, FloorWorld)
    assert (world.people, world.speed, world.upside_down, world.scanner) == (3, 1, True, "sick")


def test_another_plan_of_as_many_rooms():
    for text in ("rooms-4", "rooms-4-9"):
        world = find_world(text, {"map_seed": 7, "people": 2})
        np.testing.assert_array_equal(world.walls, rooms_world(4, 7).walls)
        assert (world.name, world.people) == ("rooms-4-7", 2)


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("floor-115", {"map_seed": 2}, "fixed"),
        ("rooms-4", {"map_seed": -1}, "map_seed"),
        ("rooms-4", {"map_seed": 1.5}, "map_seed"),
        ("floor-115", {"people": 1.5}, "whole"),
        ("floor-115", {"people": True}, "number"),
        ("floor-115", {"upside_down": 1}, "true or false"),
        ("floor-115", {"scanner": 3}, "a name"),
        ("floor-115", {"scanner": "sonar"}, "sonar"),
        ("floor-115", {"name": "x"}, "no such setting"),
        ("floor-115", {"walls": 1}, "no such setting"),
        ("floor-115", {"clutter": 1.0}, "no such setting"),
        ("floor-115", {"speed": -1.0}, "speed"),
    ],
)
def test_what_cannot_be_set_is_refused(name, changes, said):
    with pytest.raises(ConfigError, match=said):
        find_world(name, changes)


def test_a_floor_can_be_checked():
    result = CliRunner().invoke(kalmap, ["check", "standstill"])
    assert result.exit_code == 0, result.output
    assert "301" in result.output


def test_help_names_the_floors():
    text = " ".join(CliRunner().invoke(kalmap, ["run", "--help"]).output.split())
    names = [name for name in FLOORS if not name.startswith("rooms")]
    for name in [*names, "rooms-N"]:
        assert name in text
