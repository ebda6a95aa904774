"""Worlds with a known truth: landmark maps, a driven course, noisy odometry and sightings."""

from kalmap.simulate.catalogue import world_by_name, world_names
from kalmap.simulate.courses import (
    bailey_world,
    course_world,
    lawn_world,
    random_landmarks,
    same_world,
    wide_world,
)
from kalmap.simulate.drive import Drive, drive
from kalmap.simulate.run import simulate
from kalmap.simulate.world import World

__all__ = [
    "Drive",
    "World",
    "bailey_world",
    "course_world",
    "drive",
    "lawn_world",
    "random_landmarks",
    "same_world",
    "simulate",
    "wide_world",
    "world_by_name",
    "world_names",
]
