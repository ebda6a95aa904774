"""How well a detector finds what is there, scan by scan."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np

from kalmap.evaluation.landmarks import pair_by_nearest
from kalmap.geometry.angles import wrap
from kalmap.records import ConfigError


class DetectionScore(msgspec.Struct, frozen=True, kw_only=True):
    """Detections in a stretch of range, against those given.

    low, high: m, low <= range < high. Precision counts the found ones in the stretch, recall the given ones;
    each is None if there are none.
    found, given: how many. right: found ones with a partner. hit: given ones with a partner.
    range_bias, range_scatter: m, mean and standard deviation of found less given over the given ones with a
        partner; bearing_bias, bearing_scatter: rad, likewise. None if there are none.
    """

    low: float
    high: float
    found: int
    given: int
    right: int
    hit: int
    precision: float | None
    recall: float | None
    range_bias: float | None
    range_scatter: float | None
    bearing_bias: float | None
    bearing_scatter: float | None


def pair_detections(
    found: Sequence[np.ndarray], given: Sequence[np.ndarray], cutoff: float
) -> tuple[np.ndarray, np.ndarray]:
    """One-to-one pairs, scan by scan, of least total distance in the plane, each below `cutoff` m.

    found, given: for every scan, (n, 2) range m and bearing rad. Returns rows (K,) in all found ones and in
    all given ones, each list put end to end. Raises `ConfigError` if there are not as many scans of both.
    """
    if len(found) != len(given):
        raise ConfigError(f"detections of {len(found)} scans against those of {len(given)}: expected as many")
    mine, theirs = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    before_mine = before_theirs = 0
    for a, b in zip(found, given):
        if len(a) and len(b):
            rows, columns = pair_by_nearest(_plane(a), _plane(b), cutoff)
            mine.append(rows + before_mine)
            theirs.append(columns + before_theirs)
        before_mine, before_theirs = before_mine + len(a), before_theirs + len(b)
    return np.concatenate(mine), np.concatenate(theirs)


def detection_score(
    found: Sequence[np.ndarray],
    given: Sequence[np.ndarray],
    cutoff: float = 0.5,
    edges: Sequence[float] = (0.0, np.inf),
) -> list[DetectionScore]:
    """One score for every stretch of range between neighbouring `edges` (m); see `pair_detections`.

    Partners are sought over all ranges, so that one just beyond an edge is still a partner.
    """
    rows, columns = pair_detections(found, given, cutoff)
    mine, theirs = _stacked(found), _stacked(given)
    right, hit = np.zeros(len(mine), dtype=bool), np.zeros(len(theirs), dtype=bool)
    right[rows], hit[columns] = True, True
    error = mine[rows] - theirs[columns]
    error[:, 1] = wrap(error[:, 1])
    scores = []
    for low, high in pairwise(edges):
        of_mine, of_theirs, of_pair = (
            (values[:, 0] >= low) & (values[:, 0] < high) for values in (mine, theirs, theirs[columns])
        )
        scores.append(_score((low, high), right[of_mine], hit[of_theirs], error[of_pair]))
    return scores


def _score(
    span: tuple[float, float], right: np.ndarray, hit: np.ndarray, error: np.ndarray
) -> DetectionScore:
    bias = error.mean(axis=0).tolist() if len(error) else [None, None]
    scatter = error.std(axis=0).tolist() if len(error) else [None, None]
    return DetectionScore(
        low=span[0],
        high=span[1],
        found=len(right),
        given=len(hit),
        right=int(right.sum()),
        hit=int(hit.sum()),
        precision=float(right.mean()) if len(right) else None,
        recall=float(hit.mean()) if len(hit) else None,
        range_bias=bias[0],
        range_scatter=scatter[0],
        bearing_bias=bias[1],
        bearing_scatter=scatter[1],
    )


def _plane(detections: np.ndarray) -> np.ndarray:
    distance, bearing = detections[:, 0], detections[:, 1]
    return np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing)])


def _stacked(frames: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 2)), *(np.asarray(frame)[:, :2] for frame in frames)])
