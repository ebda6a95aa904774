"""The csv layout, as `docs/csv-layout.md` describes it: names of files and columns, and `log.json`."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import msgspec

from kalmap.records import RunConfig

ODOMETRY, SIGHTINGS, FIXES = "odometry.csv", "sightings.csv", "fixes.csv"
TRUTH, LANDMARKS, HEADER = "truth.csv", "landmarks.csv", "log.json"

MOTIONS = {
    ("speed", "steering"): ("velocity-steering", "ackermann"),
    ("speed", "turn_rate"): ("unicycle",),
    ("dx", "dy", "dtheta"): ("increments",),
}
"""Columns of the odometry -> motion models that take them; the first where `log.json` names none."""


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`log.json`: what the tables cannot say. Every key may be left out.

    name: short, for titles. config: the settings to start from. start: x m, y m, heading rad in the
    map frame; start_covariance: its 3 x 3 covariance. truth_frame, truth_kind, truth_point: as in
    `Reference`, for `truth.csv` and `landmarks.csv`. truth_ids: whether the ids are the truth about
    association. landmarks_complete: whether an id that `landmarks.csv` does not list is an error.
    """

    name: str | None = None
    config: RunConfig | None = None
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_covariance: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    truth_frame: str = "map"
    truth_kind: str = "truth"
    truth_point: tuple[float, float] = (0.0, 0.0)
    truth_ids: bool = True
    landmarks_complete: bool = True


def covariance_columns(names: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Columns of the upper triangle of a covariance of `names` -> (row, column) in it."""
    variances = {f"var_{name}": (k, k) for k, name in enumerate(names)}
    pairs = combinations(range(len(names)), 2)
    return variances | {f"cov_{names[i]}_{names[j]}": (i, j) for i, j in pairs}


def names(raw: Any, *keys: str) -> bool:
    """Whether a decoded `log.json` has a value at this place, for instance "config", "motion", "model"."""
    for key in keys:
        if not isinstance(raw, dict) or key not in raw:
            return False
        raw = raw[key]
    return True
