"""Several methods on one log, or in one world over several seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec

from kalmap.evaluation import PairedTest
from kalmap.records import AssociationConfig, ConfigError, KalmapError, Log, RunConfig
from kalmap.simulate import FloorWorld, World
from kalmap.slam import Outcome, run, slam_from_config
from kalmap.study.cases import Method, judge
from kalmap.study.montecarlo import Progress, run_study
from kalmap.study.result import StudyResult


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


def compare_methods(
    log: Log,
    methods: Sequence[Method],
    *,
    config: RunConfig | None = None,
    tolerant: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> list[Compared]:
    """Each method on the same log, one after the other in this process, so that their times compare.

    config: all settings but the method; None takes the log's own. progress: called with (method, time
    reached). A method that fails is reported and does not stop the others; an interrupted one (Ctrl-C) is
    the last in the list.
    """
    base = config or log.defaults
    results = []
    for method in methods:
        results.append(_one(log, method.name, method.on(base), tolerant, progress))
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
    world: World | FloorWorld,
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
