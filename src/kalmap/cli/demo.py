"""`kalmap demo`: the main job on the world that comes with kalmap."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("demo", short_help="Run the main job on the built-in world.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("kalmap-demo"), show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--quiet", "-q", is_flag=True, help="No progress, no summary.")
def command(out: Path, seed: int, quiet: bool) -> None:
    """Drive the built-in course twice, map its 35 features, and write map, figures and report."""
    from kalmap.cli.run import command as run_command
    from kalmap.cli.run import run_once

    words = ["course-35", f"--seed={seed}", *["--quiet"] * quiet]
    given = run_command.make_context("demo", words).params
    code, _ = run_once(given.pop("log"), out, given, None)
    if not quiet and code == 0:
        click.echo(f"open {out / 'report.html'}; the map is {out / 'figures' / 'map.png'}")
    click.get_current_context().exit(code)
