"""Where the drive is now, in the newest joined frame: the chain of ends, tied by the landmarks that the maps share.

Maps that stand side by side in the forest have not been joined yet, but what they share already says how they lie.
Of each map only its end and some of the shared landmarks are looked at: leaving the others out of a Gaussian is exact,
and the work does not grow with the map. The maps themselves are not touched.
"""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.gaussian import NotPositiveError
from kalmap.geometry.ellipses import chi_square
from kalmap.geometry.se2 import compose
from kalmap.slam.submaps.join import NotSettledError, join
from kalmap.slam.submaps.joiner import ById
from kalmap.slam.submaps.local_map import LocalMap

_MOST = 16  # landmarks by which two maps are tied


def newest(maps: tuple[LocalMap, ...], gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the last of consecutive maps ends, in the frame of the first: T_first_end (3,) and its covariance.

    Their landmarks have identities. gate: probability of the joint distance, beyond which two maps are only chained.
    Of a map in information form the end alone is looked at: its other covariances would have to be recovered first.
    """
    if not maps:
        return np.zeros(3), np.zeros((3, 3))
    wanted = _wanted(maps)
    whole = _narrowed(maps[0], wanted)
    for number, each in enumerate(maps[1:], 1):
        whole = _tied(whole, _narrowed(each, wanted), gate)
        later = [np.intersect1d(wanted, other.ids) for other in maps[number + 1 :]]
        whole = _kept(whole, _rows(whole, np.concatenate([whole.ids[:0], *later])))
    return whole.end, whole.end_covariance


def _tied(first: LocalMap, second: LocalMap, gate: float) -> LocalMap:
    """Both joined, if they fit; else one behind the other."""
    pairs = ById()(first, second)
    try:
        joined = join(first, second, pairs)
        squared = joined.squared - first.squared - second.squared
        if not len(pairs) or squared <= chi_square(gate, 2 * len(pairs)):
            return joined
    except (NotSettledError, NotPositiveError):
        pass
    alone = _kept(second, np.setdiff1d(np.arange(len(second)), pairs[:, 1]))
    return join(first, alone, np.zeros((0, 2), dtype=np.int64))


def _narrowed(map_: LocalMap, wanted: np.ndarray) -> LocalMap:
    """The end and those landmarks that are wanted."""
    if map_.covariance is None:
        return _bare(map_, np.zeros(0, dtype=np.int64), map_.end_covariance)
    return _kept(map_, _rows(map_, wanted))


def _wanted(maps: tuple[LocalMap, ...]) -> np.ndarray:
    """The identities by which the maps are tied: of what any two share, the nearest to where the drive is now.

    And of what two neighbours share the nearest to where one ends and the other begins.
    """
    way, wanted = _way_left(maps), [maps[0].ids[:0]]
    for number, first in enumerate(maps):
        if first.covariance is None:
            continue
        now = compose(first.end, way[number])
        for other in maps[number + 1 :]:
            rows = _rows(first, other.ids)
            wanted.append(first.ids[_nearest(first, rows, now)])
            if other is maps[number + 1]:
                wanted.append(first.ids[_nearest(first, rows, first.end)])
    return np.unique(np.concatenate(wanted))


def _rows(map_: LocalMap, ids: np.ndarray) -> np.ndarray:
    """Rows of those of its landmarks that have one of these identities."""
    return np.flatnonzero(np.isin(map_.ids, ids))


def _way_left(maps: tuple[LocalMap, ...]) -> list[np.ndarray]:
    """For each map (3,) from its end to where the last one ends, as the ends alone have it."""
    way = [np.zeros(3)]
    for each in maps[:0:-1]:
        way.append(compose(each.end, way[-1]))
    return way[::-1]


def _nearest(map_: LocalMap, rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    """So many of the rows that are nearest to a place."""
    apart = np.linalg.norm(map_.landmarks[rows] - place[:2], axis=1)
    return rows[np.argsort(apart, kind="stable")[:_MOST]]


def _kept(map_: LocalMap, rows: np.ndarray) -> LocalMap:
    """A dense map's end and these landmarks, the rest left out."""
    first = 3 * len(map_.frames)
    entries = np.concatenate([first + np.arange(3), (first + 3 + 2 * rows[:, None] + np.arange(2)).ravel()])
    return _bare(map_, rows, map_.dense()[np.ix_(entries, entries)])


def _bare(map_: LocalMap, rows: np.ndarray, covariance: np.ndarray) -> LocalMap:
    return msgspec.structs.replace(
        map_,
        ids=map_.ids[rows],
        landmarks=map_.landmarks[rows],
        sightings=map_.sightings[rows],
        covariance=covariance,
        end_covariance=covariance[:3, :3],
        frames=np.zeros((0, 3)),
        parts=(),
        aliases=np.zeros((0, 2), dtype=np.int64),
    )
