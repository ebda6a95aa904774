"""The common worlds: logs made by the peers' own simulator, handed over as kalmap's events.

The peers live outside this repository, in the folder that `KALMAP_PEERS` names (default `../shared/peers`
beside the repository). Their logs go to `benchmarks/out/worlds`. Without the peers `require_peers` ends the
program with a reason and status 0: a benchmark that cannot compare is skipped, not failed.

Close to a landmark the simulator's noise can make a range negative. No sensor says that and kalmap refuses
it, so such a sighting is left out of the events and counted (`World.refused`); the peers get it as it is.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kalmap.records import Odometry, Sightings

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "benchmarks" / "out"
LOGS = OUT / "worlds"


class Scan(NamedTuple):
    """What one scan hands over: the control steps since the last one, and what was seen."""

    odometry: Odometry
    sightings: Sightings


class World(NamedTuple):
    """A log with its truth: poses (S, 3) at every scan, landmarks (N, 2) by id; sightings refused."""

    name: str
    seed: int
    scans: list[Scan]
    truth: np.ndarray
    landmarks: np.ndarray
    refused: int


def peers_folder() -> Path:
    """Where the peers are, whether or not they are there."""
    named = os.environ.get("KALMAP_PEERS")
    return Path(named) if named else ROOT.parent / "shared" / "peers"


def require_peers() -> Path:
    """The peers' folder; ends the program with a reason if it is not there."""
    folder = peers_folder()
    if not (folder / "world.py").is_file():
        print(f"skipped: no peers in {folder}; set KALMAP_PEERS to the folder that holds world.py")
        raise SystemExit(0)
    return folder


def _simulator() -> Any:
    os.environ["PEER_OUT"] = str(LOGS)
    sys.dont_write_bytecode = True
    folder = str(require_peers())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    return importlib.import_module("world")


def load(name: str, seed: int) -> World:
    """One of the common worlds ("web35", "same400", "lawn1000", ...) as events; made where it is missing."""
    simulator = _simulator()
    log = simulator.load(name, seed)
    dt, controls = float(simulator.P["DT"]), np.column_stack([log["V"], log["G"]])
    scans, begin = [], 0
    for j, k in enumerate(log["k_obs"].tolist()):
        end, rows = k + 1, slice(int(log["ptr"][j]), int(log["ptr"][j + 1]))
        odometry = Odometry(dt * end, np.ascontiguousarray(controls[begin:end]), np.full(end - begin, dt))
        values, ids = log["z"][rows].astype(float), log["ids"][rows].astype(np.int64)
        ranges = values[:, 0] >= 0.0
        scans.append(Scan(odometry, Sightings(dt * end, values[ranges], ids[ranges])))
        begin = end
    refused = int((log["z"][:, 0] < 0.0).sum())
    truth = np.ascontiguousarray(log["xtrue"][:, log["k_obs"]].T)
    return World(name, seed, scans, truth, np.ascontiguousarray(log["lm"].T), refused)
