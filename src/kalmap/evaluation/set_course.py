"""The map as a set, instant by instant, against those landmarks that have been in view until then."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from kalmap.evaluation.sets import SetError, checked_positions, pair_sets
from kalmap.geometry.angles import wrap

# pairs of pose and landmark that are looked at in one go: keeps the memory of large worlds flat
_PAIRS = 500_000


class SetCourse(msgspec.Struct, frozen=True, eq=False):
    """Distances between estimated and true map at K instants, (K,) each; see `ospa` and `gospa`.

    ospa, localisation, cardinality: m, OSPA and its two parts. gospa: m. estimated, true: int64, how many
    features the map has, and how many it should have.
    """

    ospa: np.ndarray
    localisation: np.ndarray
    cardinality: np.ndarray
    gospa: np.ndarray
    estimated: np.ndarray
    true: np.ndarray

    def __len__(self) -> int:
        return len(self.ospa)


def set_errors_over_time(
    estimated: Sequence[np.ndarray],
    true: np.ndarray,
    seen: np.ndarray,
    *,
    order: float = 2.0,
    cutoff: float,
    alpha: float = 2.0,
) -> SetCourse:
    """Judge the maps of K instants, each by the true landmarks that have been in view until then.

    estimated: K maps (N_k, 2), m. true: (M, 2), m. seen: (K, M) bool, as of `seen_so_far`. order, cutoff,
    alpha: as for `ospa` and `gospa`. Raises `SetError`, as these do, and where the sizes do not fit.
    """
    true, seen = checked_positions("true", true), np.asarray(seen)
    if seen.shape != (len(estimated), len(true)) or seen.dtype != np.bool_:
        raise SetError(
            f"seen: expected booleans of shape {(len(estimated), len(true))}, got {seen.dtype} {seen.shape}"
        )
    rows = []
    for k, positions in enumerate(estimated):
        try:
            pairing = pair_sets(positions, true[seen[k]], order=order, cutoff=cutoff)
            whole, general = pairing.ospa(), pairing.gospa(alpha)
        except SetError as problem:
            raise SetError(f"instant {k}: {problem}") from None
        parts = (whole.value, whole.localisation, whole.cardinality, general.value)
        rows.append((*parts, pairing.estimated, pairing.true))
    columns = np.array(rows, dtype=np.float64).reshape(-1, 6).T
    return SetCourse(*columns[:4], *columns[4:].astype(np.int64))


def seen_so_far(
    poses: np.ndarray, landmarks: np.ndarray, max_range: float, field_of_view: float
) -> np.ndarray:
    """(K, M) bool: whether each landmark has been in view from any of the poses up to this one.

    poses: (K, 3) of the sensor, x m, y m, heading rad. landmarks: (M, 2), m. max_range: m. field_of_view:
    rad, the full angle, centred ahead. In view means nearer than `max_range`, and a bearing strictly inside
    the field of view (2 pi or more: any). What hides behind something else counts as in view.
    """
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    landmarks = np.asarray(landmarks, dtype=np.float64).reshape(-1, 2)
    seen = np.zeros((len(poses), len(landmarks)), dtype=bool)
    rows = max(1, _PAIRS // max(1, len(landmarks)))
    for first in range(0, len(poses), rows):
        part = slice(first, first + rows)
        seen[part] = _in_view(poses[part], landmarks, max_range, field_of_view)
    return np.logical_or.accumulate(seen, axis=0)


def _in_view(poses: np.ndarray, landmarks: np.ndarray, max_range: float, field_of_view: float) -> np.ndarray:
    x, y, heading = (column[:, None] for column in poses.T)
    dx, dy = landmarks[:, 0] - x, landmarks[:, 1] - y
    near = dx * dx + dy * dy < max_range**2
    if field_of_view >= 2.0 * math.pi:
        return near
    if field_of_view == math.pi:
        # no arctangent decides about a landmark exactly abeam
        return near & (dx * np.cos(heading) + dy * np.sin(heading) > 0.0)
    return near & (np.abs(wrap(np.arctan2(dy, dx) - heading)) < 0.5 * field_of_view)
