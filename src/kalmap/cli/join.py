"""`kalmap join`: two finished maps into one."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("join", short_help="Join two finished maps, of two robots or two days.")
@click.argument("first", type=click.Path(path_type=Path))
@click.argument("second", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Result folder; default kalmap-join.")
@click.option("--by-id", is_flag=True, help="The same number is the same landmark in both maps.")
@click.option("--no-figures", is_flag=True, help="Draw nothing.")
@click.option("--quiet", "-q", is_flag=True, help="Say nothing.")
def command(first: Path, second: Path, out: Path | None, by_id: bool, no_figures: bool, quiet: bool) -> None:
    """Join FIRST.kalmap and SECOND.kalmap, whose frames have nothing to do with each other, into one map.

    How the maps lie to each other is found by the shapes that their landmarks form, or by their numbers with --by-id;
    maps of contours are laid on each other at all places and turns.
    The joined map is in the first one's frame. Maps that do not overlap, or fit in more than one way, are refused.
    """
    from kalmap.cli.folder import make_folder
    from kalmap.study.map_joining import join_files

    folder = make_folder(out or Path("kalmap-join"))
    report = join_files(first, second, folder, by_id=by_id, figures=not no_figures)
    if quiet:
        return
    click.echo(report.found())
    click.echo(
        f"second map in the first: {report.x:.3f} m, {report.y:.3f} m, {report.heading_deg:.3f} deg "
        f"(sigma {report.sigma_x:.3f} m, {report.sigma_y:.3f} m, {report.sigma_heading_deg:.3f} deg)"
    )
    click.echo(f"written to {folder}")
