"""Small drives through simulated rooms, for the tests of mapping from raw scans."""

from __future__ import annotations

import numpy as np

from kalmap.models.motion import motion_from_config
from kalmap.records import ContourConfig, Log, Scan
from kalmap.simulate import FloorWorld, simulate
from kalmap.simulate.disturb_scans import with_beams
from kalmap.slam.contours.slam import ContourSlam


def block_world(**overrides) -> FloorWorld:
    """A room of 8 m x 6 m with a block in the middle and a niche, driven round one and a half times: about 30 m."""
    outer = [(0, 0), (8, 0), (8, 6), (5, 6), (5, 6.5), (3.5, 6.5), (3.5, 6), (0, 6)]
    inner = [(3, 2.5), (3, 3.5), (5.5, 3.5), (5.5, 2.5)]
    walls = [(*a, *b) for line in (outer, inner) for a, b in zip(line, [*line[1:], line[0]], strict=True)]
    way = [(1.4, 1.2), (6.8, 1.2), (6.8, 4.8), (1.4, 4.8), (1.4, 1.2), (6.8, 1.2), (6.8, 4.8)]
    return FloorWorld(name="block", walls=np.array(walls, dtype=float), waypoints=np.array(way), **overrides)


def block_log(seed: int = 1, beams: int = 120, **overrides) -> Log:
    """A drive round the block, with fewer beams than the scanner has."""
    return with_beams(simulate(block_world(**overrides), seed), beams)


def mapper(log: Log, method: str = "dc-slasem", background: bool = False, **settings) -> ContourSlam:
    """An estimator for the log, of local maps of 4 m."""
    contour = ContourConfig(method=method, background=background, **{"close_distance": 4.0, **settings})
    return ContourSlam(motion_from_config(log.defaults.motion), log.defaults.sensor, contour, start=log.start)


def events_of(log: Log, scans: int | None = None) -> list:
    """The log's events up to that many scans."""
    events, seen = [], 0
    for event in log.open(None):
        events.append(event)
        seen += isinstance(event, Scan)
        if seen == scans:
            break
    return events
