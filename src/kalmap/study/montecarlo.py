"""Monte Carlo over methods x worlds x seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path

from kalmap.records import AssociationConfig, ConfigError
from kalmap.simulate import FloorWorld, World
from kalmap.slam import check_method
from kalmap.study.cases import Case, Method, RunRecord, run_case
from kalmap.study.result import StudyResult
from kalmap.study.store import Store
from kalmap.study.workers import carry_out, worker_count

Progress = Callable[[int, int], None]


def run_study(
    worlds: Sequence[World | FloorWorld],
    methods: Sequence[Method],
    seeds: Iterable[int],
    *,
    association: AssociationConfig | None = None,
    workers: int | None = None,
    out: Path | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Every method in every world with every seed.

    A seed's log depends on world and seed alone: every method sees the same one, and so does a method that
    joins later. The result does not depend on the number of workers.

    association: how sightings find their landmarks, for methods that do not say; None takes the world's own.
    workers: processes, None for one a processor, 1 for none beside this one.
    out: a folder; every finished run is kept in its `runs/`, so a study that was stopped goes on where it
        was. progress: called with (runs done, runs in all).

    Raises `ConfigError` before the first run for settings that contradict each other, and for names or seeds
    that stand there twice. A filter that gives up ends its own run only (`RunRecord.error`).
    """
    cases = [Case(*chosen, association) for chosen in product(worlds, methods, list(seeds))]
    return run_cases(cases, workers=workers, out=out, progress=progress)


def run_cases(
    cases: Sequence[Case],
    *,
    workers: int | None = None,
    out: Path | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """The same for a list of cases, such as one that gives a slow method fewer seeds."""
    _check(cases)
    worker_count(workers)
    store = Store(Path(out) / "runs") if out is not None else None
    found = {k: record for k, case in enumerate(cases) if store and (record := store.read(case)) is not None}
    missing = [k for k in range(len(cases)) if k not in found]
    if progress is not None:
        progress(len(found), len(cases))
    for index, record in carry_out(run_case, [cases[k] for k in missing], workers):
        found[missing[index]] = record
        if store is not None:
            store.write(cases[missing[index]], record)
        if progress is not None:
            progress(len(found), len(cases))
    records: list[RunRecord] = [found[k] for k in range(len(cases))]
    return StudyResult(tuple(records))


def _check(cases: Sequence[Case]) -> None:
    """Refuse what would fail, or be mixed up, after hours."""
    seen: set[tuple[str, str, int]] = set()
    for case in cases:
        name = (case.world.name, case.method.name, case.seed)
        if name in seen:
            raise ConfigError(f"study: {name[1]} in world {name[0]} with seed {name[2]} stands there twice")
        seen.add(name)
        if case.seed < 0:
            raise ConfigError(f"study: a seed must be 0 or more, got {case.seed}")
        check_method(case.config())
