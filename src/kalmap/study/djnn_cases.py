"""Which runs the reproduction of Zhou, Zhao & Zhang 2010 is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from kalmap.records import AssociationConfig, ConfigError, FilterConfig
from kalmap.records.config import AssociationName
from kalmap.simulate import World, djnn_world
from kalmap.study.cases import Case, Method

# weak and strong interference: tables 1 and 2
FEW, MANY = 10, 50
MDA = "mda"
MOST_MDA_RUNS = 6  # with five pairs no signed-rank test can be significant
_GATE = 0.95


def _paper(method: AssociationName, **settings: Any) -> AssociationConfig:
    """The paper's gate of 95 %, beyond which at once a new feature begins; nothing is merged afterwards."""
    return AssociationConfig(
        method=method, gate=_GATE, new_gate=_GATE, joint_gate=_GATE, ambiguity=0.0, merge=False, **settings
    )


_ALL: dict[str, Any] = {"management": "keep", "local": False}
_OFF: dict[str, Any] = {"interference": False, "widen": 0.0}
_COUNTER: dict[str, Any] = {"management": "counter", "confirm": 2}

PAPER = "the paper's gate"
PARTS = "NN and one part of DJNN"
OWN = "kalmap's own gates"
GROUPS = {
    PAPER: {
        "nn": _paper("nearest", **_ALL),
        "jcbb": _paper("jcbb", **_ALL),
        MDA: _paper("mda", window=2, **_ALL),
        "mda, local": _paper("mda", window=2, management="keep"),
        "djnn": _paper("djnn", widen=3.0, **_COUNTER),
    },
    PARTS: {
        "nn + interference": _paper("djnn", widen=3.0, **_ALL),
        "nn + tentative": _paper("djnn", local=False, **_COUNTER, **_OFF),
        "nn + local": _paper("djnn", management="keep", **_OFF),
    },
    OWN: {
        "djnn, own gates": AssociationConfig(method="djnn"),
        "djnn, existence": AssociationConfig(method="djnn", management="existence"),
        "jcbb, own": AssociationConfig(method="jcbb", management="existence"),
    },
}
"""Methods by group: what is varied is the association alone."""

_KNOWN = {name: association for group in GROUPS.values() for name, association in group.items()}
# the longest first, so that no worker ends up alone with them
_SLOWEST = (MDA, "mda, local", "nn", "jcbb", "nn + interference", "nn + local")


class Plan(msgspec.Struct, frozen=True):
    """Worlds by their number of movers, and all cases. altered: the worlds are not the study's own."""

    worlds: dict[int, World]
    methods: tuple[str, ...]
    cases: list[Case]
    altered: bool = False


def djnn_case(world: World, method: str, seed: int) -> Case:
    """A method of `GROUPS` with the filter that all share, the default one."""
    return Case(world, Method(method, FilterConfig(), _KNOWN[method]), seed)


def group_of(method: str) -> str:
    """The group that a method belongs to."""
    return next(group for group, members in GROUPS.items() if method in members)


def make_plan(
    runs: int,
    mda_runs: int | None = None,
    methods: Sequence[str] | None = None,
    world: Mapping[str, Any] | None = None,
) -> Plan:
    """The cases: every method with seeds 1 to `runs`, MDA on all features with seeds 1 to `mda_runs`.

    mda_runs: None for at most six. methods: names, None for all. world: fields of `World` other than the study's,
    for a quick look. Raises `ConfigError` for numbers and names that make no sense.
    """
    count = min(runs, MOST_MDA_RUNS) if mda_runs is None else mda_runs
    if runs < 1 or not 0 <= count <= runs:
        raise ConfigError("runs must be 1 or more, and mda_runs between 0 and runs")
    chosen = tuple(_KNOWN) if methods is None else tuple(methods)
    unknown = [name for name in chosen if name not in _KNOWN]
    if unknown:
        raise ConfigError(f"method {unknown[0]!r}: unknown; known are {'; '.join(_KNOWN)}")
    worlds = {movers: djnn_world(movers, **(world or {})) for movers in (FEW, MANY)}
    cases = [
        djnn_case(worlds[movers], name, seed)
        for name in sorted(chosen, key=_place)
        for movers in (MANY, FEW)
        for seed in range(1, (count if name == MDA else runs) + 1)
    ]
    return Plan(worlds, chosen, cases, bool(world))


def _place(method: str) -> int:
    return _SLOWEST.index(method) if method in _SLOWEST else len(_SLOWEST)
