"""`kalmap reproduce`: a paper's tables and figures again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from kalmap.cli.messages import say

if TYPE_CHECKING:
    from kalmap.study.paper_report import Reproduction

Use = Literal["joint", "sequential"]
PAPERS = ("crcdkf", "djnn", "srckf-phd", "slasem")
_RUNS = {"crcdkf": 50, "djnn": 20, "srckf-phd": 10, "slasem": 3}
# options that only one of the papers has a use for
_OWN = {"full_runs": "crcdkf", "use": "crcdkf", "mda_runs": "djnn", "methods": "slasem"}


@click.command("reproduce", short_help="Make a paper's tables and figures again.")
@click.argument("paper", type=click.Choice(PAPERS))
@click.option(
    "--runs",
    type=click.IntRange(min=1),
    help="Seeds a method; default 50 for crcdkf, 20 for djnn, 10 for srckf-phd, 3 for slasem.",
)
@click.option(
    "--full-runs",
    type=click.IntRange(min=1),
    help="crcdkf: seeds of the full CDKF (slow); default as --runs.",
)
@click.option(
    "--use", type=click.Choice(["joint", "sequential"]), help="crcdkf: use of a frame; default joint."
)
@click.option(
    "--mda-runs",
    type=click.IntRange(min=0),
    help="djnn: seeds of MDA on the whole map (slow); default 6, if there are so many.",
)
@click.option(
    "--methods", help="slasem: of ekf (as published), cr-cdkf, invariant, with commas between; default ekf."
)
@click.option(
    "--workers", type=click.IntRange(min=1), help="Processes; default one a core, 1 for clean times."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder; default kalmap-reproduce-PAPER.")
@click.option("--quiet", "-q", is_flag=True, help="No progress, no table.")
def command(
    paper: str, runs: int | None, workers: int | None, out: Path | None, quiet: bool, **own: Any
) -> None:
    """Reproduce PAPER.

    crcdkf: Chen & Cheng 2012, tables 1 and 2 and figure 2. djnn: Zhou, Zhao & Zhang 2010, tables 1 and 2 and figure 2.
    srckf-phd: Yan et al. 2014, table 2, figures 2, 3 and 4, and figure 6 where the car park's log is. slasem: Sun et
    al. 2010, figures 4 to 7, on simulated floors, one run after the other.

    Stopped, it goes on where it was when called again with the same folder. Exit code 1 if a claim does not hold.
    """
    from kalmap.cli.progress import progress_bar

    chosen = _of_paper(paper, own)
    folder = out or Path(f"kalmap-reproduce-{paper}")
    make = {"crcdkf": _crcdkf, "djnn": _djnn, "srckf-phd": _srckf_phd, "slasem": _slasem}[paper]
    with progress_bar(f"reproduce {paper}", quiet) as show:
        reproduction = make(
            folder,
            runs=runs or _RUNS[paper],
            workers=workers,
            progress=None if show is None else lambda done, total: show(done, total),
            **chosen,
        )
    if not quiet:
        click.echo((folder / f"{paper}.md").read_text(encoding="utf-8"))
        click.echo(f"written to {folder}")
    failed = any(claim.verdict == "fails" for claim in reproduction.claims)
    click.get_current_context().exit(1 if failed else 0)


def _of_paper(paper: str, own: dict[str, Any]) -> dict[str, Any]:
    """The options that were given; one that belongs to another paper is refused."""
    given = {name: value for name, value in own.items() if value is not None}
    for name in given:
        if _OWN[name] != paper:
            raise click.UsageError(f"--{name.replace('_', '-')} is for {_OWN[name]}, not for {paper}")
    return given


def _crcdkf(folder: Path, **settings: Any) -> Reproduction:
    from kalmap.cli.source import data_root
    from kalmap.study import bailey_maps, reproduce_crcdkf

    maps = bailey_maps(data_root())
    if maps is None:
        say(
            f"Bailey's map is not in {data_root()} (set KALMAP_DATA): the package's own course stands in, "
            "and the paper's numbers do not apply"
        )
    return reproduce_crcdkf(folder, maps=maps, **settings)


def _djnn(folder: Path, **settings: Any) -> Reproduction:
    from kalmap.study import reproduce_djnn

    return reproduce_djnn(folder, **settings)


def _slasem(folder: Path, methods: str = "ekf", **settings: Any) -> Reproduction:
    from kalmap.study import reproduce_slasem

    names = [name.strip() for name in methods.split(",")]
    return reproduce_slasem(folder, methods=names, **settings)


def _srckf_phd(folder: Path, **settings: Any) -> Reproduction:
    from kalmap.cli.source import data_root
    from kalmap.study import reproduce_srckf_phd

    car_park = data_root() / "car_park"
    if not car_park.is_dir():
        say(f"the car park's log is not in {data_root()} (set KALMAP_DATA): figure 6 is left out")
        return reproduce_srckf_phd(folder, **settings)
    return reproduce_srckf_phd(folder, car_park=car_park, **settings)
