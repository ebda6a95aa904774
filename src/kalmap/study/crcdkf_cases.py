"""Which runs the reproduction of Chen & Cheng 2012 is made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from kalmap.data import read_map
from kalmap.records import ConfigError, FilterConfig
from kalmap.records.config import Use
from kalmap.simulate import World, landmark_world_by_name
from kalmap.study.cases import Case, Method
from kalmap.study.methods import parse_methods
from kalmap.study.result import StudyResult

Maps = Callable[[str], tuple[np.ndarray, np.ndarray]]

# "a": 35 features, 0.3 m/s and 3 deg; "b": 70 features, twice the control noise
SETS = ("a", "b")
ADDITIVE = ("ekf", "cdkf", "cr-ukf", "cr-cdkf", "cr-ckf")
INVARIANT = ("ekf", "cr-ukf", "cr-cdkf", "cr-ckf")
SLOW = "cdkf"
# full and reduced: the same filter
_SAME = ("cdkf:additive", "cr-cdkf:additive")
_BAILEY = {"a": "bailey-35", "b": "bailey-70"}
_OWN = {"a": "course-35", "b": "course-70"}


class Plan(msgspec.Struct, frozen=True):
    """Two worlds and their cases. comparable: the worlds are the paper's, not the package's own course."""

    worlds: dict[str, World]
    cases: list[Case]
    comparable: bool

    def methods(self, which: str, suffix: str) -> list[str]:
        """The methods of a set ("a", "b") in "additive" or "invariant" coordinates."""
        name = self.worlds[which].name
        names = dict.fromkeys(case.method.name for case in self.cases if case.world.name == name)
        return [method for method in names if method.endswith(f":{suffix}")]


class Agreement(msgspec.Struct, frozen=True):
    """How far the full and the reduced CDKF are from each other at the end of one run.

    mean: largest difference of the joint mean over its largest entry. covariance: largest difference of two
    entries of the joint covariance over the product of their standard deviations. size: of the state.
    """

    mean: float
    covariance: float
    size: int

    @property
    def worst(self) -> float:
        return max(self.mean, self.covariance)


def bailey_maps(root: Path | str) -> Maps | None:
    """Reader of the maps below a data folder (`bailey_sim/<name>.mat`); None if the map is not there."""
    folder = Path(root) / "bailey_sim"
    if not (folder / "example_webmap.mat").is_file():
        return None

    def maps(name: str) -> tuple[np.ndarray, np.ndarray]:
        world = read_map(folder / f"{name}.mat")
        return world.landmarks, world.waypoints

    return maps


def make_plan(
    maps: Maps | None, runs: int, full_runs: int | None, use: Use, full_b: bool, laps: int | None = None
) -> Plan:
    """The cases; the full CDKF, which takes most of the time, first, so that no worker ends up alone with it.

    laps: other than the world's own two, for a quick look.
    """
    if runs < 1 or (full_runs is not None and not 0 <= full_runs <= runs):
        raise ConfigError("runs must be 1 or more, and full_runs between 0 and runs")
    if use not in ("joint", "sequential"):
        raise ConfigError(f"use: {use!r} is none of joint, sequential")
    worlds = {s: landmark_world_by_name((_BAILEY if maps else _OWN)[s], maps) for s in SETS}
    if laps is not None:
        worlds = {s: msgspec.structs.replace(world, laps=laps) for s, world in worlds.items()}
    base = FilterConfig(use=use)
    texts = [f"{name}:additive" for name in ADDITIVE] + [f"{name}:invariant" for name in INVARIANT]
    cases = []
    for which, world in worlds.items():
        for method in parse_methods(texts, base):
            count = runs if full_runs is None or not _full(method) else full_runs
            if not _full(method) or which == "a" or full_b:
                same = which == "a" and method.name in _SAME
                cases += [Case(world, method, s, keep_joint=same and s == 1) for s in range(1, count + 1)]
    cases.sort(key=lambda case: not _full(case.method))
    return Plan(worlds, cases, comparable=maps is not None and laps is None)


def _full(method: Method) -> bool:
    return method.filter.name == SLOW


def agreement(plan: Plan, result: StudyResult) -> Agreement | None:
    """The last states of the full and the reduced CDKF on the first seed of set a; None if one is missing.

    Chen & Cheng 2012, Theorem 1: the two are the same filter, up to rounding.
    """
    world = plan.worlds["a"].name
    states = {
        r.method: r.joint for r in result.records if r.world == world and r.seed == 1 and r.joint is not None
    }
    if len(states) < len(_SAME):
        return None
    full, reduced = (states[name] for name in _SAME)
    full_mean, full_cov = np.array(full.mean), np.array(full.covariance)
    deviations = np.sqrt(np.diagonal(full_cov))
    apart = np.abs(np.array(reduced.covariance) - full_cov) / np.outer(deviations, deviations)
    return Agreement(
        mean=float(np.abs(np.array(reduced.mean) - full_mean).max() / np.abs(full_mean).max()),
        covariance=float(apart.max()),
        size=len(full_mean),
    )
