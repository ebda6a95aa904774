"""A binary counter of closed maps: two of the same level are joined, the result carries to the next.

Paz, Tardos & Neira 2008. Of N closed maps at most log2(N) + 1 stand side by side, and each takes part in at most as
many joins. What a map holds is none of this file's business.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, Protocol, TypeVar

import msgspec
import numpy as np

from kalmap.geometry.se2 import compose, quarter_turn


class Joinable(Protocol):
    """A closed map in the frame of its own start."""

    @property
    def end(self) -> np.ndarray:
        """(3,) T_start_end."""
        ...

    @property
    def end_covariance(self) -> np.ndarray:
        """(3, 3)."""
        ...


M = TypeVar("M", bound=Joinable)
M_contra = TypeVar("M_contra", bound=Joinable)


class Joiner(Protocol[M]):
    """Makes one map of two consecutive ones; None says that they would not fit together."""

    def __call__(self, first: M, second: M) -> M | None: ...


class Tree(msgspec.Struct, Generic[M], frozen=True, eq=False):
    """What 2^level closed maps have become: one map, or several where a join was refused."""

    level: int
    maps: tuple[M, ...]


class Forest(Generic[M]):
    """The trees, the largest and oldest first. Maps are never changed, so a refused join leaves nothing to undo.

    refusals: how many joins were refused so far; a pair that stays apart is tried again whenever it is carried on.
    """

    def __init__(self, joiner: Joiner[M], trees: Iterable[Tree[M]] = (), refusals: int = 0) -> None:
        self.joiner = joiner
        self.trees: list[Tree[M]] = list(trees)
        self.refusals = refusals

    @property
    def maps(self) -> tuple[M, ...]:
        """All maps in the order of the drive."""
        return tuple(each for tree in self.trees for each in tree.maps)

    def close(self, closed: M) -> None:
        """Take in the next map of the drive, and join what carries."""
        self.trees.append(Tree(0, (closed,)))
        while len(self.trees) > 1 and self.trees[-2].level == self.trees[-1].level:
            self.trees[-2:] = [self._carried(*self.trees[-2:])]

    def finish(self) -> None:
        """Join what is left, the smallest first: one map, or several where joins are still refused."""
        while len(self.trees) > 1:
            self.trees[-2:] = [self._carried(*self.trees[-2:])]

    def _carried(self, first: Tree[M], second: Tree[M]) -> Tree[M]:
        tree, refused = carried(self.joiner, first, second)
        self.refusals += refused
        return tree


def carried(joiner: Joiner[M], first: Tree[M], second: Tree[M]) -> tuple[Tree[M], int]:
    """Two neighbouring trees as one, and how many joins were refused on the way.

    Neighbours are joined, the two at the seam first, then those that were refused before, until none fits.
    """
    maps, refused = [*first.maps, *second.maps], 0
    seam = len(first.maps) - 1
    order = [seam, *(place for place in range(len(maps) - 1) if place != seam)]
    while order:
        for place in order:
            joined = joiner(maps[place], maps[place + 1])
            if joined is not None:
                maps[place : place + 2] = [joined]
                order = list(range(len(maps) - 1))
                break
            refused += 1
        else:
            break
    return Tree(max(first.level, second.level) + 1, tuple(maps)), refused


def chain(maps: Iterable[Joinable]) -> tuple[np.ndarray, np.ndarray]:
    """Where the last of consecutive maps ends, in the frame of the first: T_first_end (3,) and its covariance."""
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for each in maps:
        pose, covariance = composed(pose, covariance, each.end, each.end_covariance)
    return pose, covariance


def composed(
    T_map_a: np.ndarray, cov_a: np.ndarray, T_a_b: np.ndarray, cov_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """T_map_b (..., 3) and its covariance (..., 3, 3) from independent poses: first order, additive."""
    pose = compose(T_map_a, T_a_b)
    by_a = np.zeros((*pose.shape, 3))
    by_a[..., [0, 1, 2], [0, 1, 2]] = 1.0
    by_b = by_a.copy()
    by_a[..., :2, 2] = quarter_turn(pose[..., :2] - T_map_a[..., :2])
    c, s = np.cos(T_map_a[..., 2]), np.sin(T_map_a[..., 2])
    by_b[..., 0, 0], by_b[..., 0, 1], by_b[..., 1, 0], by_b[..., 1, 1] = c, -s, s, c
    return pose, by_a @ cov_a @ by_a.swapaxes(-1, -2) + by_b @ cov_b @ by_b.swapaxes(-1, -2)
