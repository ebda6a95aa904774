"""`kalmap run`: one filter over one log."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from kalmap.cli.messages import say
from kalmap.cli.options import FILTER_NAMES, METHOD_NAMES, gather, parse_robot, shared_options, topics


@click.command("run", short_help="Run a filter over a log or a simulated world.")
@click.argument("log")
@click.option(
    "--method",
    type=click.Choice(METHOD_NAMES),
    help="A Kalman filter, as --filter takes it; one of random finite sets, without association; or contours from "
    "raw scans: slasem in one map, dc-slasem by divide and conquer.",
)
@click.option("--filter", "filter_name", type=click.Choice(FILTER_NAMES), help="Default: cr-cdkf.")
@click.option("--out", type=click.Path(path_type=Path), help="Result folder; default kalmap-LOG.")
@click.option("--no-figures", is_flag=True, help="Write neither figures nor report.")
@click.option(
    "--audit/--no-audit", default=True, help="Keep why each sighting went where it went (see kalmap why)."
)
@shared_options
def command(log: str, out: Path | None, **given: Any) -> None:
    """Run a filter over LOG and write a result folder.

    LOG is a folder or file (raw scans: CARMEN, ROS 1 or ROS 2 bag, CoreSLAM; landmarks: Victoria Park, car park,
    MRCLAM, DLR, csv; or a map for the simulator), or the name of a world: course-35, course-70, bailey-35, bailey-70,
    course-N, same-N, wide-N, lawn-N; or one made to break association: djnn-N (N movers), clutter-N, missed-35,
    doubles-35, orchard, clusters, breaker, grove (laser scans); or one for random finite sets: phd-N (clutter N),
    field-160, rfs-99-0, rfs-90-1, rfs-70-6, rfs-50-13, missed-50, clutter-20-70, faded-35, restless-35;
    or a floor for maps from raw scans: floor-115, floor-170, office, hall, lab, corridor, crowd, standstill, rooms-N.
    """
    if given["robot"] == "all":
        _every_robot(log, out, given)
        return
    code, _ = run_once(log, out, given, parse_robot(given["robot"]))
    click.get_current_context().exit(code)


def _every_robot(log: str, out: Path | None, given: dict[str, Any]) -> None:
    """One result folder a robot, below the one asked for."""
    from kalmap.cli.folder import default_folder
    from kalmap.data import mrclam_robots
    from kalmap.records import LogError

    robots = mrclam_robots(log)
    if not robots:
        raise LogError("holds no log of several robots", file=log)
    folder = out or default_folder("kalmap", Path(log).resolve().name.lower())
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
    from kalmap.cli.folder import default_folder, drop_drawn, make_folder, savable
    from kalmap.cli.interrupt import stop_between_events
    from kalmap.cli.progress import progress_bar, summary_line, time_span
    from kalmap.cli.settings import check_detector, resolve
    from kalmap.cli.source import open_source
    from kalmap.data import reader_notes
    from kalmap.records import EstimationError, RunConfig

    started = datetime.now(UTC)
    settings, world = gather(given)
    seed = resolve(RunConfig(), {key: settings[key] for key in ("seed",) if key in settings}).seed
    log = open_source(text, seed, world, robot, given["variant"], given["clutter"], topics(given))
    if not given["quiet"]:
        for note in reader_notes(log):
            say(f"note: {note}")
    config = resolve(log.defaults, merge_seed(settings, seed))
    check_detector(log.defaults, settings, config)
    # Compiled code comes in only now, so that a log or setting that cannot be is told at once.
    from kalmap.slam import run, slam_from_config
    from kalmap.study.present import method_label, save_run
    from kalmap.view import contour_warnings

    slam = slam_from_config(config, log)
    folder = make_folder(out or default_folder("kalmap", log.name))
    span, figures = time_span(log), not given["no_figures"]
    title = f"{log.name}: {method_label(config)}"
    with progress_bar(title, given["quiet"]) as show, stop_between_events() as stop:

        def reached(now: float) -> None:
            stop()
            if show is not None:
                show(now - span[0] if span else 0.0, span[1] - span[0] if span else None)

        outcome = run(slam, log, tolerant=config.tolerant, progress=reached, explain=given["audit"])
    if not figures:
        drop_drawn(folder)
    try:
        metrics = save_run(folder, savable(outcome), log, config, started=started, figures=figures)
    except EstimationError as problem:  # what the run met first is what the user has to know
        raise EstimationError(f"{outcome.error}; {problem}" if outcome.error else str(problem)) from problem
    if not given["quiet"]:
        summary_line(f"{log.name}, {method_label(config)}", metrics)
        for warning in contour_warnings(metrics):
            say(f"note: {warning}")
        click.echo(f"written to {folder}{' (see report.html)' if figures else ''}")
        if not (folder / "map.kalmap").exists():
            click.echo("without map.kalmap: the joint covariance of so large a map cannot be written out")
    return exit_code(outcome.error, outcome.interrupted), metrics


def merge_seed(settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """The settings with the seed that the world was simulated from."""
    return {**settings, "seed": seed}


def exit_code(error: object | None, interrupted: bool) -> int:
    """Say on the error stream why a run was cut short, and return the code for it."""
    if error is not None:
        say(f"error: {error} (what was computed before is written)")
        return 2
    if interrupted:
        say("interrupted; what was computed before is written")
        return 130
    return 0
