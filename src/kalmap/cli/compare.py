"""`kalmap compare`: several methods over the same log, or over several seeds of a world."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from kalmap.cli.messages import say
from kalmap.cli.options import gather, parse_robot, refuse_for_sets_only, shared_options, topics

_SHOWN = (
    "position_rmse_m",
    "heading_rmse_deg",
    "feature_rmse_m",
    "ospa_m",
    "nees_mean",
    "association_f1",
    "step_ms_mean",
    "landmarks",
)


@click.command("compare", short_help="Run several methods over the same log.")
@click.argument("log")
@click.option(
    "--methods",
    required=True,
    metavar="A,B,...",
    help="By name, as --method of `kalmap run` takes them. Behind a filter, if wanted, :additive, :invariant, :joint, "
    ":sequential or an association, as in cr-cdkf:djnn; behind a method of sets :motion, :sightings or a weighting, as "
    "in srckf-phd:motion:single-feature; behind slasem and dc-slasem a filter, :additive or :invariant, as in "
    "dc-slasem:ekf.",
)
@click.option(
    "--runs", type=click.IntRange(min=1), default=1, show_default=True, help="Seeds of a simulated world."
)
@click.option("--workers", type=click.IntRange(min=1), help="Processes for several seeds.")
@click.option("--out", type=click.Path(path_type=Path), help="Result folder; default kalmap-compare-LOG.")
@shared_options
def command(log: str, methods: str, runs: int, workers: int | None, out: Path | None, **given: Any) -> None:
    """Run METHODS over LOG, on the same data and one after the other, and set them side by side.

    With --runs N, for a world: seeds 1 to N (or from --seed on), with a paired test against the first method.
    """
    if runs > 1:
        if given["clutter"] is not None:
            raise click.UsageError("--clutter: with --runs take a world with clutter, as clutter-5")
        code = _seeds(log, methods, runs, workers, out, given)
    else:
        code = _single(log, methods, out, given)
    click.get_current_context().exit(code)


def _single(text: str, methods: str, out: Path | None, given: dict[str, Any]) -> int:
    import msgspec

    from kalmap.cli.folder import default_folder, make_folder, savable
    from kalmap.cli.interrupt import stop_between_events
    from kalmap.cli.progress import progress_bar, time_span
    from kalmap.cli.run import merge_seed
    from kalmap.cli.settings import check_detector, resolve
    from kalmap.cli.source import open_source
    from kalmap.records import RunConfig
    from kalmap.study import compare_methods
    from kalmap.study.present import save_comparison

    started = datetime.now(UTC)
    settings, world = gather(given, several=True)
    seed = resolve(RunConfig(), {key: settings[key] for key in ("seed",) if key in settings}).seed
    log = open_source(
        text, seed, world, parse_robot(given["robot"]), given["variant"], given["clutter"], topics(given)
    )
    config = resolve(log.defaults, merge_seed(settings, seed))
    chosen = _methods(methods, config, given)
    for method in chosen:
        check_detector(log.defaults, settings, method.on(config))
    folder = make_folder(out or default_folder("kalmap-compare", log.name))
    span = time_span(log)
    with progress_bar(log.name, given["quiet"]) as show, stop_between_events() as stop:

        def reached(_: str, now: float) -> None:
            stop()
            if show is not None:
                show(now - span[0] if span else 0.0, span[1] - span[0] if span else None)

        results = compare_methods(
            log,
            chosen,
            config=config,
            tolerant=config.tolerant,
            progress=reached,
        )
    if all(result.outcome is None for result in results):
        raise next(result.error for result in results if result.error is not None)
    results = [
        result if result.outcome is None else msgspec.structs.replace(result, outcome=savable(result.outcome))
        for result in results
    ]
    metrics = save_comparison(folder, results, log, started=started)
    if not given["quiet"]:
        _table([(result.method, metrics.get(result.method, {})) for result in results])
        click.echo(f"written to {folder}")
    return _say_how_it_ended(results)


def _methods(text: str, config: Any, given: dict[str, Any]) -> list[Any]:
    """The methods by name, with the settings that they share."""
    from kalmap.study import parse_methods

    chosen = parse_methods(text.split(","), config.filter, config.association, config.finite_set)
    if all(method.finite_set is None for method in chosen):
        refuse_for_sets_only(given, text)
    return chosen


def _say_how_it_ended(results: list[Any]) -> int:
    """One line an error, with the methods that met it; returns the exit code."""
    from kalmap.cli.run import exit_code

    met: dict[str, list[str]] = {}
    for result in results:
        if result.error is not None:
            met.setdefault(str(result.error), []).append(result.method)
    codes = [exit_code(f"{', '.join(methods)}: {error}", False) for error, methods in met.items()]
    if any(result.outcome is not None and result.outcome.interrupted for result in results):
        codes.append(exit_code(None, True))
    return max(codes, default=0)


def _seeds(
    text: str, methods: str, runs: int, workers: int | None, out: Path | None, given: dict[str, Any]
) -> int:
    from kalmap.cli.progress import progress_bar
    from kalmap.cli.settings import check_detector, resolve
    from kalmap.cli.source import find_world
    from kalmap.records import ConfigError
    from kalmap.study import compare_seeds
    from kalmap.study.seeds_report import write_seeds

    settings, overrides = gather(given, several=True)
    world = find_world(text, overrides)
    if world is None:
        raise ConfigError(f"--runs {runs}: {text} is a log; only a world can be run with several seeds")
    extra = sorted(set(settings) - {"filter", "association", "finite_set", "seed"})
    if extra:
        raise ConfigError(f"{extra[0]}: with --runs the filters take the world's own noise and sensor")
    config = resolve(world.defaults(), settings)  # a world of scans has no ids to go by
    chosen = _methods(methods, config, given)
    for method in chosen:
        check_detector(world.defaults(), settings, method.on(config))
    folder = out or Path(f"kalmap-compare-{world.name}")
    folder.mkdir(parents=True, exist_ok=True)
    with progress_bar(world.name, given["quiet"]) as show:
        result = compare_seeds(
            world,
            chosen,
            range(config.seed, config.seed + runs),
            association=config.association,
            workers=workers,
            out=folder,
            progress=None if show is None else lambda done, total: show(done, total),
        )
    paired = write_seeds(folder, result)
    if not given["quiet"]:
        for metric in ("position_rmse_m", "feature_rmse_m", "ospa_m", "nees_mean"):
            _paired(metric, paired[metric])
        click.echo(f"written to {folder}")
    for failure in result.failures():
        say(f"error: {failure}")
    return 2 if result.failures() else 0


def _table(rows: list[tuple[str, dict[str, Any]]]) -> None:
    """Methods against metrics, as wide as their names."""
    width = max([len(name) for name, _ in rows] + [6])
    click.echo(" ".join(["method".ljust(width), *(key.rjust(16) for key in _SHOWN)]))
    for name, metrics in rows:
        cells = ["-" if metrics.get(key) is None else f"{metrics[key]:.4g}" for key in _SHOWN]
        click.echo(" ".join([name.ljust(width), *(cell.rjust(16) for cell in cells)]))


def _paired(metric: str, rows: list[Any]) -> None:
    click.echo(
        f"{metric}: mean over the seeds; difference from {rows[0].method} with 95 % interval; Wilcoxon p"
    )
    for row in rows:
        mean = "-" if row.mean is None else f"{row.mean:.4g}"
        test = row.test
        against = (
            ""
            if test is None
            else (
                f"  {test.mean_difference:+.4g} [{test.low:+.4g}, {test.high:+.4g}]  p = {test.p_value:.2g}"
            )
        )
        click.echo(f"  {row.method}: {mean} ({row.runs} runs){against}")
