"""A predicted map with given distances, and associators driven by hand."""

from __future__ import annotations

import copy

import numpy as np

from kalmap.association import Expected
from kalmap.records import Sightings


class Fake:
    """A predicted map with given distances; landmarks in `view` lie 10 m ahead, the others out of range."""

    explain = False
    sensor_pose = (0.0, 0.0, 0.0)
    min_range, max_range, half_view, position_sigma = 0.0, 30.0, 0.5 * np.pi, 0.0

    def __init__(self, squared, log_volume=None, view=None, count=None) -> None:
        self.squared = np.asarray(squared, dtype=float)
        self.log_volume = np.zeros_like(self.squared) if log_volume is None else log_volume
        self.count = self.squared.shape[1] if count is None else count
        self.view = np.ones(self.count, bool) if view is None else np.asarray(view, bool)
        self.noises = np.tile(np.eye(2), (len(self.squared), 1, 1))

    def positions(self, indices):
        return np.c_[np.where(self.view[indices], 10.0, 31.5), np.zeros(len(indices))]

    def within(self, reach, front):
        return np.arange(self.count)

    def expect(self, indices):
        many = len(indices)
        return Expected(
            indices, self.positions(indices), np.zeros((many, 2, 5)), np.tile(np.eye(2), (many, 1, 1))
        )

    def distances(self, expected):
        return self.squared[:, expected.indices].copy(), self.log_volume[:, expected.indices]

    def cross(self, expected):
        many = len(expected.indices)
        out = np.zeros((many, many, 2, 2))
        out[np.arange(many), np.arange(many)] = expected.spreads
        return out

    def separations(self, first, second, extent):
        return np.full(len(first), np.inf)

    def joint(self, indices):
        return self.positions(indices).ravel(), np.eye(2 * len(indices))

    def hidden(self, expected):
        return np.zeros(len(expected.indices), dtype=bool)


def decide(method, memory, sightings, predicted):
    """Associate, check that this changed nothing, and settle."""
    before = copy.deepcopy(memory)
    association = method.associate(memory, sightings, predicted)
    assert memory == before
    method.settle(memory, association)
    return association


def memory_of(method, count: int):
    """The memory of an associator whose first frame founded `count` landmarks."""
    memory = method.start()
    decide(method, memory, frame(count), Fake(np.zeros((count, 0))))
    assert method.fits(memory, count)
    return memory


def frame(count: int, ids=None, time: float = 1.0) -> Sightings:
    z = np.c_[np.full(count, 5.0), np.zeros(count)]
    return Sightings(time, z, None if ids is None else np.array(ids, dtype=np.int64))
