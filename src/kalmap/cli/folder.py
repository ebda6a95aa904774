"""The folder that a result goes into, looked at before a long run starts."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.data.results import check_result_folder
from kalmap.records import KalmapError

if TYPE_CHECKING:
    from kalmap.slam import Outcome

_DRAWN = (
    "report.html",
    "figures/map.png",
    "figures/plan.png",
    "figures/plan-close-up.png",
    "figures/errors.png",
    "figures/consistency.png",
    "figures/timing.png",
    "figures/set.png",
    "figures/intensity.png",
)


def default_folder(prefix: str, name: str) -> Path:
    """A folder here, named after the log, whose name is made fit for that."""
    return Path(f"{prefix}-{re.sub(r'[^A-Za-z0-9._-]+', '-', name).strip('.-') or 'log'}")


def make_folder(folder: Path) -> Path:
    """The folder, made if it is missing. Raises KalmapError if no result may or can be written into it."""
    try:
        check_result_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        reason = (problem.strerror or str(problem)).lower()
        raise KalmapError(f"{folder}: cannot hold a result: {reason}") from problem
    if not os.access(folder, os.W_OK | os.X_OK):
        raise KalmapError(f"{folder}: cannot hold a result: no permission to write")
    return folder


def savable(outcome: Outcome) -> Outcome:
    """The outcome; one of a run that ended before its first event, with the start at time 0."""
    if np.isfinite(outcome.estimate.time):
        return outcome
    return msgspec.structs.replace(outcome, estimate=msgspec.structs.replace(outcome.estimate, time=0.0))


def drop_drawn(folder: Path) -> None:
    """Remove the page and pictures of an earlier result, which would not fit the new one."""
    for name in _DRAWN:
        (folder / name).unlink(missing_ok=True)
