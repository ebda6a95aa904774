"""`kalmap check`: what is in a log, and what is wrong with it."""

from __future__ import annotations

import click

from kalmap.cli.options import parse_robot, topic_options, topics


@click.command("check", short_help="Say what is in a log and what is wrong with it.")
@click.argument("log")
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
@click.option("--robot", metavar="K", help="Which robot of a log of several.")
@click.option("--variant", help="Which form of a log that has several.")
@click.option("--seed", type=click.IntRange(min=0), default=1, help="Seed of a simulated world.")
@topic_options
def command(
    log: str, as_json: bool, robot: str | None, variant: str | None, seed: int, **given: str | None
) -> None:
    """Counts, rates, gaps, clock jumps, late or repeated stamps, NaN and impossible values of LOG.

    Exit code 0 if the log is good, 1 if it has problems, 2 if it cannot be read.
    """
    import msgspec

    from kalmap.cli.source import open_source
    from kalmap.data import check_log, format_report

    opened = open_source(log, seed, {}, parse_robot(robot), variant, topics=topics(given))
    report = check_log(opened)
    click.echo(
        msgspec.json.format(msgspec.json.encode(report), indent=2) if as_json else format_report(report)
    )
    unreadable = any(finding.what == "cannot be read" for finding in report.findings)
    click.get_current_context().exit(2 if unreadable else 1 if report.verdict == "problems" else 0)
