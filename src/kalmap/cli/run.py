"""`kalmap run`: one filter over one log."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from kalmap.cli.options import FILTER_NAMES, gather, parse_robot, shared_options


@click.command("run", short_help="Run a filter over a log or a simulated world.")
@click.argument("log")
@click.option("--filter", "filter_name", type=click.Choice(FILTER_NAMES), help="Default: cr-cdkf.")
@click.option("--out", type=click.Path(path_type=Path), help="Result folder; default kalmap-LOG.")
@shared_options
def command(log: str, out: Path | None, **given: Any) -> None:
    """Run a filter over LOG and write a result folder.

    LOG is a folder or file (Victoria Park, car park, MRCLAM, DLR, csv; or a map for the simulator), or the name of
    a world: course-35, course-70, bailey-35, bailey-70, course-N, same-N, wide-N, lawn-N.
    """
    if given["robot"] == "all":
        _every_robot(log, out, given)
        return
    code, _ = run_once(log, out, given, parse_robot(given["robot"]))
    click.get_current_context().exit(code)


def _every_robot(log: str, out: Path | None, given: dict[str, Any]) -> None:
    """One result folder a robot, below the one asked for."""
    from kalmap.data import mrclam_robots
    from kalmap.records import LogError

    robots = mrclam_robots(log)
    if not robots:
        raise LogError("holds no log of several robots", file=log)
    folder = out or Path(f"kalmap-{Path(log).resolve().name.lower()}")
    worst = 0
    for robot in robots:
        code, _ = run_once(log, folder / f"robot-{robot}", given, robot)
        worst = max(worst, code)
        if code == 130:
            break
    click.get_current_context().exit(worst)


def run_once(
    text: str, out: Path | None, given: dict[str, Any], robot: int | None
) -> tuple[int, dict[str, float | int | None]]:
    """Open, run, write; returns the exit code and the metrics."""
    from kalmap.cli.progress import progress_bar, summary_line, time_span
    from kalmap.cli.settings import resolve
    from kalmap.cli.source import open_source
    from kalmap.data.results import check_result_folder
    from kalmap.perception import ReflectorDetector
    from kalmap.records import RunConfig
    from kalmap.slam import run, slam_from_config
    from kalmap.study.present import method_label, save_run

    started = datetime.now(UTC)
    settings, world = gather(given)
    seed = resolve(RunConfig(), {key: settings[key] for key in ("seed",) if key in settings}).seed
    log = open_source(text, seed, world, robot, given["variant"])
    config = resolve(log.defaults, merge_seed(settings, seed))
    folder = out or Path(f"kalmap-{log.name}")
    check_result_folder(folder)
    slam = slam_from_config(config, log, ReflectorDetector())
    span = time_span(log)
    with progress_bar(f"{log.name}: {method_label(config)}", given["quiet"]) as show:
        reached = None
        if show is not None:

            def reached(now: float) -> None:
                show(now - span[0] if span else 0.0, span[1] - span[0] if span else None)

        outcome = run(slam, log, tolerant=config.tolerant, progress=reached)
    metrics = save_run(folder, outcome, log, config, started=started)
    if not given["quiet"]:
        summary_line(f"{log.name}, {method_label(config)}", metrics)
        click.echo(
            f"written to {folder}{'' if outcome.error or outcome.interrupted else ' (see report.html)'}"
        )
    return exit_code(outcome.error, outcome.interrupted), metrics


def merge_seed(settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """The settings with the seed that the world was simulated from."""
    return {**settings, "seed": seed}


def exit_code(error: Exception | None, interrupted: bool) -> int:
    """Say on the error stream why a run was cut short, and return the code for it."""
    if error is not None:
        click.echo(f"kalmap: error: {error} (what was computed before is written)", err=True)
        return 2
    if interrupted:
        click.echo("kalmap: interrupted; what was computed before is written", err=True)
        return 130
    return 0
