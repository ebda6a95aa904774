"""Ready-made local maps for map joining (Huang, Wang & Dissanayake 2008): `localmap_1.mat`, `localmap_2.mat`, ..."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.mat import load_mat, matrix
from kalmap.records import LogError


class StoredLocalMap(msgspec.Struct, frozen=True):
    """One file: the robot's end pose and the features, in the frame of the robot's start.

    ids: (N,) int64. mean: (3 + 2 N,) x m, y m, heading rad of the end, then x, y of each feature;
    covariance: as many squared.
    """

    ids: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def read_local_maps(folder: Path | str) -> list[StoredLocalMap]:
    """All local maps of a folder, in the order of the drive.

    Raises LogError, naming the file and the field, if there is none or one is not of this kind.
    """
    maps: list[StoredLocalMap] = []
    while (path := Path(folder) / f"localmap_{len(maps) + 1}.mat").is_file():
        maps.append(_read(path))
    if not maps:
        raise LogError("holds no localmap_1.mat", file=folder)
    return maps


def _read(path: Path) -> StoredLocalMap:
    found = load_mat(path, ("localmap_st", "localmap_P"))
    state = matrix(found, "localmap_st", path, columns=2)
    n = len(state)
    covariance = matrix(found, "localmap_P", path, rows=n, columns=n)
    if not (np.isfinite(state).all() and np.isfinite(covariance).all()):
        raise LogError("expected finite numbers", file=path)
    if n < 3 or n % 2 == 0 or state[:3, 0].any():
        raise LogError("expected three rows of the robot, then two a feature", file=path, field="localmap_st")
    ids = state[3::2, 0].astype(np.int64)
    if (state[4::2, 0] != state[3::2, 0]).any() or len(np.unique(ids)) != len(ids):
        raise LogError("expected two rows a feature, each feature once", file=path, field="localmap_st")
    return StoredLocalMap(ids, state[:, 1].copy(), covariance)
