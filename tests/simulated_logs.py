"""A simulated log taken apart: its frames, the poses they were seen from, all sightings in one array."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.records import Odometry
from kalmap.simulate import drive


def frames(log):
    return [event for event in log if not isinstance(event, Odometry)]


def looks(world):
    return drive(world).poses[world.observe_every :: world.observe_every]


def flat(log):
    """Frame (M,), id (M,) and values (M, 2) of all sightings of a log."""
    seen = frames(log)
    number = np.repeat(np.arange(len(seen)), [len(frame.ids) for frame in seen])
    return number, np.concatenate([f.ids for f in seen]), np.concatenate([f.values for f in seen])


def by_identity(log):
    """The sightings of features, as rows of frame, id, range, bearing in that order."""
    number, ids, values = flat(log)
    rows = np.column_stack([number, ids, values])[ids >= 0]
    return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]


def exact(poses, points):
    """Range and bearing (..., 2) from poses (..., 3) to points (..., 2)."""
    dx, dy = points[..., 0] - poses[..., 0], points[..., 1] - poses[..., 1]
    return np.stack([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - poses[..., 2])], axis=-1)
