"""Nav2's map files, read back by a reader of its own that follows map_server's rule, by Pillow and by a YAML parser."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from kalmap.data.nav2 import map_yaml, pgm_bytes
from kalmap.records import OccupancyGrid
from kalmap.records.grid import FREE, OCCUPIED, UNKNOWN

FIELDS = ["image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"]


def serve(folder):
    """What map_server publishes: cells from the lower left, -1, 0 or 100, with resolution and origin."""
    lines = (folder / "map.yaml").read_text().splitlines()
    told = dict(line.split(": ", 1) for line in lines)
    assert list(told) == FIELDS
    content = (folder / told["image"]).read_bytes()
    head = re.match(rb"P5\s+(\d+)\s+(\d+)\s+(\d+)\s", content)
    width, height, most = (int(number) for number in head.groups())
    assert most == 255
    body = content[head.end() :]
    assert len(body) == width * height
    assert (told["mode"], told["negate"]) == ("trinary", "0")
    cells = []
    for row in range(height):
        for column in range(width):
            occupied = 1.0 - body[(height - 1 - row) * width + column] / 255.0
            sure, free = occupied > float(told["occupied_thresh"]), occupied < float(told["free_thresh"])
            cells.append(100 if sure else 0 if free else -1)
    origin = [float(number) for number in told["origin"].strip("[]").split(",")]
    return np.array(cells).reshape(height, width), float(told["resolution"]), origin


def write(folder, grid):
    (folder / "map.pgm").write_bytes(pgm_bytes(grid))
    (folder / "map.yaml").write_text(map_yaml(grid, "map.pgm"))


@given(
    arrays(
        np.int8,
        array_shapes(min_dims=2, max_dims=2, max_side=9),
        elements=st.sampled_from([FREE, OCCUPIED, UNKNOWN]),
    ),
    st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    st.floats(1e-6, 10.0),
)
@settings(max_examples=60, deadline=None)
def test_the_server_reads_what_was_written(tmp_path_factory, cells, origin, resolution):
    folder = tmp_path_factory.getbasetemp()
    write(folder, OccupancyGrid(np.array(origin), resolution, cells))
    read, side, corner = serve(folder)
    np.testing.assert_array_equal(read, cells)
    assert side == resolution
    assert corner == [*origin, 0.0]


def test_other_readers_agree(tmp_path):
    from PIL import Image

    cells = np.full((4, 7), UNKNOWN, dtype=np.int8)
    cells[0, 1], cells[3, 6] = OCCUPIED, FREE  # lower left, and upper right
    write(tmp_path, OccupancyGrid(np.array([-1.25, 1e-7]), 0.05, cells))
    with Image.open(tmp_path / "map.pgm") as image:
        assert (image.mode, image.size) == ("L", (7, 4))
        assert (image.getpixel((1, 3)), image.getpixel((6, 0)), image.getpixel((0, 0))) == (0, 254, 128)
    yaml = pytest.importorskip("ruamel.yaml").YAML(typ="safe")
    told = yaml.load((tmp_path / "map.yaml").read_text())
    assert told == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-1.25, 1e-7, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    }


@pytest.mark.parametrize("free_thresh", [0.25, 0.196])
def test_unknown_stays_unknown_for_both_servers(free_thresh):
    """ROS 1 draws the line of free cells elsewhere; the grey usual for unknown would be free with Nav2's."""
    pixel = pgm_bytes(OccupancyGrid(np.zeros(2), 0.05, np.full((1, 1), UNKNOWN, dtype=np.int8)))[-1]
    assert free_thresh < (255 - pixel) / 255 < 0.65
    assert (255 - 205) / 255 < 0.25
