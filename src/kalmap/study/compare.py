"""Several methods on one log, or in one world over several seeds; and methods by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec

from kalmap.evaluation import PairedTest
from kalmap.records import (
    AssociationConfig,
    ConfigError,
    FilterConfig,
    KalmapError,
    Log,
    RunConfig,
)
from kalmap.simulate import World
from kalmap.slam import ASSOCIATIONS, FILTERS, Outcome, resolve_filter, run, slam_from_config
from kalmap.study.cases import Method, judge
from kalmap.study.montecarlo import Progress, run_study
from kalmap.study.result import StudyResult

_SUFFIXES = {
    "additive": ("coordinates", "additive"),
    "invariant": ("coordinates", "invariant"),
    "joint": ("use", "joint"),
    "sequential": ("use", "sequential"),
}


class Compared(msgspec.Struct, frozen=True):
    """One method's run on a log. metrics: as `kalmap.evaluation.evaluate` gives them.

    outcome and metrics are None where the run could not even start; `error` says why a run did not reach the
    end of the log, and what there is then holds up to that point.
    """

    method: str
    config: RunConfig
    outcome: Outcome | None
    metrics: dict[str, float | int | None] | None
    error: KalmapError | None


class PairedRow(msgspec.Struct, frozen=True):
    """One method's mean of a metric over the seeds, and its paired test against the first method.

    test: this method minus the first, by Wilcoxon; None for the first itself or without a common seed.
    """

    method: str
    metric: str
    mean: float | None
    runs: int
    failed: int
    test: PairedTest | None


def parse_method(
    text: str, base: FilterConfig | None = None, association: AssociationConfig | None = None
) -> Method:
    """The method of "ekf", "cr-cdkf:additive", "ekf:invariant:sequential", "cr-cdkf:djnn".

    association: where its settings come from if the text names a method of association. base: where coordinates
    and use come from if the text does not say; the scope is the name's. The name is the text in lower case, as
    a label. Raises `ConfigError` for unknown names, listing those that exist.
    """
    label = text.strip().lower()
    name, *suffixes = label.split(":")
    if name not in FILTERS:
        raise ConfigError(f"method {text!r}: unknown filter {name!r}; known are {', '.join(FILTERS)}")
    said: dict[str, str] = {}
    own: AssociationConfig | None = None
    for suffix in suffixes:
        if suffix in ASSOCIATIONS:
            if own is not None and own.method != suffix:
                raise ConfigError(f"method {text!r}: {own.method} and {suffix} contradict each other")
            own = msgspec.structs.replace(association or AssociationConfig(), method=suffix)
            continue
        if suffix not in _SUFFIXES:
            known = ", ".join(f":{known}" for known in (*_SUFFIXES, *ASSOCIATIONS))
            raise ConfigError(f"method {text!r}: unknown suffix {suffix!r}; known are {known}")
        field, value = _SUFFIXES[suffix]
        if said.setdefault(field, value) != value:
            raise ConfigError(f"method {text!r}: {said[field]} and {value} contradict each other")
    parsed = msgspec.structs.replace(base or FilterConfig(), name=name, scope=None, **said)
    resolve_filter(parsed)
    return Method(label, parsed, own)


def parse_methods(
    texts: Iterable[str], base: FilterConfig | None = None, association: AssociationConfig | None = None
) -> list[Method]:
    """Several of them, each at most once."""
    methods = [parse_method(text, base, association) for text in texts]
    names = [method.name for method in methods]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"method {name!r} is asked for twice")
    return methods


def compare_methods(
    log: Log,
    methods: Sequence[Method],
    *,
    config: RunConfig | None = None,
    tolerant: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> list[Compared]:
    """Each method on the same log, one after the other in this process, so that their times compare.

    config: all settings but the filter; None takes the log's own. progress: called with (method, time
    reached). A method that fails is reported and does not stop the others; an interrupted one (Ctrl-C) is
    the last in the list.
    """
    base = config or log.defaults
    results = []
    for method in methods:
        chosen = msgspec.structs.replace(
            base, filter=method.filter, association=method.association or base.association
        )
        results.append(_one(log, method.name, chosen, tolerant, progress))
        outcome = results[-1].outcome
        if outcome is not None and outcome.interrupted:
            break
    return results


def _one(
    log: Log,
    name: str,
    config: RunConfig,
    tolerant: bool,
    progress: Callable[[str, float], None] | None,
) -> Compared:
    try:
        slam = slam_from_config(config, log)
    except KalmapError as problem:
        return Compared(name, config, None, None, problem)
    tell = None if progress is None else lambda reached: progress(name, reached)
    outcome = run(slam, log, tolerant=tolerant, progress=tell)
    return Compared(name, config, outcome, judge(outcome, log, config), outcome.error)


def compare_seeds(
    world: World,
    methods: Sequence[Method],
    seeds: Iterable[int],
    *,
    association: AssociationConfig | None = None,
    workers: int | None = None,
    out: Path | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Each method in one world over several seeds: `run_study` with one world, for `paired_rows`."""
    return run_study(
        [world], methods, seeds, association=association, workers=workers, out=out, progress=progress
    )


def paired_rows(result: StudyResult, metric: str) -> list[PairedRow]:
    """One row a method of a study in one world, each tested against the first.

    Raises `ConfigError` if the study holds several worlds.
    """
    groups = result.groups()
    if len({world for world, _ in groups}) > 1:
        raise ConfigError("methods are compared in one world at a time")
    rows = []
    for world, method in groups:
        summary, first = result.summary(world, method), groups[0][1]
        test = None if method == first else result.paired(world, method, first, metric)
        rows.append(PairedRow(method, metric, summary.mean[metric], summary.runs, summary.failed, test))
    return rows
