"""`kalmap reproduce`: a paper's tables and figures again."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from kalmap.cli.messages import say

Use = Literal["joint", "sequential"]
PAPERS = ("crcdkf",)


@click.command("reproduce", short_help="Make a paper's tables and figures again.")
@click.argument("paper", type=click.Choice(PAPERS))
@click.option("--runs", type=click.IntRange(min=1), default=50, show_default=True, help="Seeds a method.")
@click.option(
    "--full-runs", type=click.IntRange(min=1), help="Seeds of the full CDKF (slow); default as --runs."
)
@click.option("--use", type=click.Choice(["joint", "sequential"]), default="joint", show_default=True)
@click.option("--workers", type=click.IntRange(min=1), help="Processes; default one a core.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder; default kalmap-reproduce-PAPER.")
@click.option("--quiet", "-q", is_flag=True, help="No progress, no table.")
def command(
    paper: str, runs: int, full_runs: int | None, use: Use, workers: int | None, out: Path | None, quiet: bool
) -> None:
    """Reproduce PAPER: crcdkf, Chen & Cheng 2012, tables 1 and 2 and figure 2.

    Stopped, it goes on where it was when called again with the same folder. Exit code 1 if a claim does not hold.
    """
    from kalmap.cli.progress import progress_bar
    from kalmap.cli.source import data_root
    from kalmap.study import bailey_maps, reproduce_crcdkf

    folder = out or Path(f"kalmap-reproduce-{paper}")
    maps = bailey_maps(data_root())
    if maps is None:
        say(
            f"Bailey's map is not in {data_root()} (set KALMAP_DATA): the package's own course stands in, "
            "and the paper's numbers do not apply"
        )
    with progress_bar(f"reproduce {paper}", quiet) as show:
        reproduction = reproduce_crcdkf(
            folder,
            runs=runs,
            workers=workers,
            maps=maps,
            progress=None if show is None else lambda done, total: show(done, total),
            full_runs=full_runs,
            use=use,
        )
    if not quiet:
        click.echo((folder / "crcdkf.md").read_text(encoding="utf-8"))
        click.echo(f"written to {folder}")
    click.get_current_context().exit(
        1 if any(claim.verdict == "fails" for claim in reproduction.claims) else 0
    )
