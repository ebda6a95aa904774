"""An occupancy grid as Nav2's map_server (and ROS 1's) loads it: `map.pgm`, a grey picture, and `map.yaml`.

The server takes a pixel's darkness, (255 - value) / 255, for the probability that the cell is occupied: above
`occupied_thresh` it is occupied, below `free_thresh` free, else unknown. Both thresholds are written out, at Nav2's own
defaults. The grey that map savers write for unknown, 205, would be read as free by them (darkness 0.196, below 0.25);
128 lies between the two, also for ROS 1's thresholds of 0.65 and 0.196.
"""

from __future__ import annotations

import numpy as np

from kalmap.records import OccupancyGrid
from kalmap.records.grid import FREE, OCCUPIED

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.25
OCCUPIED_GREY, UNKNOWN_GREY, FREE_GREY = 0, 128, 254


def pgm_bytes(grid: OccupancyGrid) -> bytes:
    """The picture as a binary portable grey map (P5), its first row the highest in y."""
    height, width = grid.cells.shape
    pixels = np.full((height, width), UNKNOWN_GREY, dtype=np.uint8)
    pixels[grid.cells == FREE] = FREE_GREY
    pixels[grid.cells == OCCUPIED] = OCCUPIED_GREY
    return f"P5\n{width} {height}\n255\n".encode() + pixels[::-1].tobytes()


def map_yaml(grid: OccupancyGrid, image: str) -> str:
    """What the server has to know of the picture. image: its path, relative to the yaml file's folder.

    The origin is the lower left corner of the lower left pixel: x m, y m and a turn of 0 rad.
    """
    x, y = grid.origin.tolist()
    return (
        f"image: {image}\n"
        "mode: trinary\n"
        f"resolution: {_plain(grid.resolution)}\n"
        f"origin: [{_plain(x)}, {_plain(y)}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\n"
        f"free_thresh: {FREE_THRESH}\n"
    )


def _plain(value: float) -> str:
    """The shortest decimal that reads back exactly, never with an exponent, which not every YAML takes for a number."""
    return np.format_float_positional(value, trim="0")
