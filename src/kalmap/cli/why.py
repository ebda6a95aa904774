"""`kalmap why`: what the association decided in a run, and why."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from kalmap.data import Audit
    from kalmap.records import Frame


@click.command("why", short_help="Say why sightings went to the landmarks they went to.")
@click.argument("result", type=click.Path(path_type=Path))
@click.option("--landmark", metavar="N", type=int, help="The story of a landmark.")
@click.option("--frame", metavar="K", type=int, help="Every decision of a frame of sightings.")
@click.option("--time", metavar="T", type=float, help="The same for the frame nearest to T seconds.")
@click.option("--all", "everything", is_flag=True, help="All sightings of a landmark, also of a long life.")
@click.option("--json", "as_json", is_flag=True, help="As JSON: all there is, NaN and infinity as null.")
@click.option("--figure", metavar="OUT.png", type=click.Path(path_type=Path), help="Draw the frame too.")
def command(
    result: Path,
    landmark: int | None,
    frame: int | None,
    time: float | None,
    everything: bool,
    as_json: bool,
    figure: Path | None,
) -> None:
    """Print the audit trail of RESULT, a result folder or its association.sqlite.

    Without an option: the counts, and the frames with the most trouble. --figure draws the frame; of a landmark, the
    frame in which it was most in doubt; without an option, the worst frame. Exit code 2 if there is no such thing.
    """
    if sum(one is not None for one in (landmark, frame, time)) > 1:
        raise click.UsageError("--landmark, --frame and --time: one of them at a time")
    if everything and landmark is None:
        raise click.UsageError("--all: it is about the sightings of a --landmark")
    if figure is not None and figure.suffix.lower() != ".png":
        raise click.UsageError(f"--figure {figure}: expected a name that ends in .png")
    from kalmap.data import open_audit

    with open_audit(result) as audit:
        if landmark is not None:
            shown = _landmark(audit, landmark, everything, as_json)
        elif frame is not None or time is not None:
            shown = audit.frame(frame) if frame is not None else audit.frame_at(float(time or 0.0))
            _frame(audit, shown, as_json)
        else:
            shown = _summary(audit, result, as_json)
        if figure is not None:
            _draw(figure, shown, as_json)


def _landmark(audit: Audit, number: int, everything: bool, as_json: bool) -> Frame | None:
    """Print a landmark's story; returns the frame in which it was most in doubt."""
    from kalmap.cli.why_json import landmark_json
    from kalmap.cli.why_text import landmark_text, most_in_doubt

    story = audit.landmark(number)
    if as_json:
        _print_json(landmark_json(story, audit.reasons()))
    else:
        click.echo(landmark_text(story, audit.reasons(), everything))
    seen = most_in_doubt(story.sightings, 1)
    return audit.frame(seen[0].frame) if seen else None


def _frame(audit: Audit, frame: Frame, as_json: bool) -> None:
    from kalmap.cli.why_json import frame_json
    from kalmap.cli.why_text import frame_text

    if as_json:
        _print_json(frame_json(frame, audit.reasons()))
    else:
        click.echo(frame_text(frame, audit.reasons(), audit.frames()))


def _summary(audit: Audit, result: Path, as_json: bool) -> Frame | None:
    """Print the counts; returns the worst frame."""
    from kalmap.cli.why_json import summary_json
    from kalmap.cli.why_text import summary_text

    summary = audit.summary()
    if as_json:
        _print_json(summary_json(summary, audit.about()))
    else:
        click.echo(summary_text(summary, audit.reasons(), str(result)))
    return audit.frame(summary.worst[0][0]) if summary.worst else None


def _draw(path: Path, frame: Frame | None, as_json: bool) -> None:
    from kalmap.data.files import write_atomically
    from kalmap.records import KalmapError
    from kalmap.view import decision_figure
    from kalmap.view.style import png_bytes

    if frame is None:
        raise KalmapError(
            f"{path}: nothing was in doubt, so no frame to draw stands out: name one with --frame"
        )
    write_atomically(path, png_bytes(decision_figure(frame)))
    if not as_json:
        click.echo(f"frame {frame.number} drawn to {path}")


def _print_json(value: Any) -> None:
    from kalmap.data.files import json_text

    click.echo(json_text(value), nl=False)
