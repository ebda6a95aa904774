"""Worlds with a known truth: landmark maps, a driven course, noisy odometry, and sightings or scans."""

from kalmap.simulate.breakers import (
    breaker_world,
    clusters_world,
    clutter_world,
    djnn_world,
    doubles_world,
    grove_world,
    missed_world,
    orchard_world,
)
from kalmap.simulate.catalogue import landmark_world_by_name, world_by_name, world_names
from kalmap.simulate.courses import (
    bailey_world,
    course_world,
    lawn_world,
    random_landmarks,
    same_world,
    wide_world,
)
from kalmap.simulate.disturb import with_clutter
from kalmap.simulate.disturb_scans import (
    with_bad_ranges,
    with_beams,
    with_clock_jump,
    with_cover,
    without_odometry,
    without_scans,
)
from kalmap.simulate.drive import Drive, drive
from kalmap.simulate.floor import FloorWorld
from kalmap.simulate.floor_drive import FloorDrive, floor_drive
from kalmap.simulate.floor_run import simulate_floor
from kalmap.simulate.floors import crowd, floor_115, floor_170, hall, standstill, straight_corridor
from kalmap.simulate.movers import mover_tracks
from kalmap.simulate.raycast import SICK, SICK_180, URG, Scanner, cast, cast_hits, noisy
from kalmap.simulate.rooms import office, rooms_world
from kalmap.simulate.run import simulate
from kalmap.simulate.set_worlds import (
    cluttered_world,
    faded_world,
    field_world,
    phd_world,
    restless_world,
    rfs_world,
)
from kalmap.simulate.world import World

__all__ = [
    "with_bad_ranges",
    "with_beams",
    "with_clock_jump",
    "with_cover",
    "with_clutter",
    "without_odometry",
    "without_scans",
    "SICK",
    "SICK_180",
    "URG",
    "Drive",
    "FloorDrive",
    "FloorWorld",
    "Scanner",
    "World",
    "bailey_world",
    "breaker_world",
    "cast",
    "cast_hits",
    "clusters_world",
    "clutter_world",
    "cluttered_world",
    "course_world",
    "crowd",
    "djnn_world",
    "doubles_world",
    "drive",
    "faded_world",
    "field_world",
    "floor_115",
    "floor_170",
    "floor_drive",
    "grove_world",
    "hall",
    "landmark_world_by_name",
    "lawn_world",
    "missed_world",
    "mover_tracks",
    "noisy",
    "office",
    "orchard_world",
    "phd_world",
    "random_landmarks",
    "restless_world",
    "rfs_world",
    "same_world",
    "rooms_world",
    "simulate",
    "simulate_floor",
    "standstill",
    "straight_corridor",
    "wide_world",
    "world_by_name",
    "world_names",
]
