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
from kalmap.simulate.catalogue import world_by_name, world_names
from kalmap.simulate.courses import (
    bailey_world,
    course_world,
    lawn_world,
    random_landmarks,
    same_world,
    wide_world,
)
from kalmap.simulate.disturb import with_clutter
from kalmap.simulate.drive import Drive, drive
from kalmap.simulate.movers import mover_tracks
from kalmap.simulate.raycast import SICK, URG, Scanner, cast, cast_hits, noisy
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
    "with_clutter",
    "SICK",
    "URG",
    "Drive",
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
    "djnn_world",
    "doubles_world",
    "drive",
    "faded_world",
    "field_world",
    "grove_world",
    "lawn_world",
    "missed_world",
    "mover_tracks",
    "noisy",
    "orchard_world",
    "phd_world",
    "random_landmarks",
    "restless_world",
    "rfs_world",
    "same_world",
    "simulate",
    "wide_world",
    "world_by_name",
    "world_names",
]
