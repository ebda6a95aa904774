"""The tree of joins on several machines: dask.distributed, an extra (`pip install kalmap[cluster]`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kalmap.slam.submaps.forest import Forest, Joiner, M, Tree, carried

Grown = tuple[Tree[M], int]  # a tree, and how many joins were refused while it grew


def join_on_cluster(client: Any, joiner: Joiner[M], maps: Iterable[M]) -> Forest[M]:
    """What a `Forest` makes of these maps, `finish` included, with every join where a worker is free.

    client: a `distributed.Client`. joiner: `LandmarkJoiner`, `join_contours`, or another; it and the maps must pickle.
    The joins are those of the binary counter and the numbers the same to the last bit, on machines that calculate
    alike; joins that do not need each other run at the same time.
    """
    standing: list[tuple[int, Any]] = []  # level and future of each tree
    for each in maps:
        standing.append((0, client.scatter((Tree(0, (each,)), 0), hash=False)))
        while len(standing) > 1 and standing[-2][0] == standing[-1][0]:
            _carry(client, joiner, standing)
    while len(standing) > 1:
        _carry(client, joiner, standing)
    if not standing:
        return Forest(joiner)
    tree, refusals = standing[0][1].result()
    return Forest(joiner, [tree], refusals)


def _carry(client: Any, joiner: Joiner[M], standing: list[tuple[int, Any]]) -> None:
    """Put the last two trees' join in their place."""
    (level, first), (other, second) = standing[-2:]
    standing[-2:] = [(max(level, other) + 1, client.submit(_grown, joiner, first, second, pure=False))]


def _grown(joiner: Joiner[M], first: Grown[M], second: Grown[M]) -> Grown[M]:
    tree, refused = carried(joiner, first[0], second[0])
    return tree, first[1] + second[1] + refused
