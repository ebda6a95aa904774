"""A progress line on the error stream, only where somebody is looking."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from kalmap.records import Log


@contextlib.contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[Callable[[float, float | None], None] | None]:
    """Yields `show(done, total)`; total None when it is not known.

    Yields None when nothing is to be shown: not wanted, or the error stream is no terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)

        def show(done: float, total: float | None) -> None:
            bar.update(task, completed=done, total=total)

        yield show


def time_span(log: Log) -> tuple[float, float] | None:
    """First and last time that a log is known to cover, from its reference; None if it has none."""
    for reference in log.references:
        if len(reference.times) > 1:
            return float(reference.times[0]), float(reference.times[-1])
    return None


def summary_line(name: str, metrics: dict[str, float | int | None]) -> None:
    """The one line that says how a run went."""
    parts = [
        f"{metrics[key]:.3g} {unit}"
        for key, unit in (
            ("position_rmse_m", "m position"),
            ("heading_rmse_deg", "deg heading"),
            ("feature_rmse_m", "m features"),
            ("relations_translation_mean_m", "m mean relations error"),
            ("map_error_rms_m", "m map"),
            ("nees_mean", "NEES (3 is right)"),
        )
        if metrics.get(key) is not None
    ]
    aligned = " (aligned)" if metrics.get("aligned") else ""
    known = f"RMS{aligned}: {', '.join(parts)}; " if parts else ""
    samples = metrics.get("contour_samples")
    size = f"{metrics['landmarks']} landmarks" if samples is None else f"{samples} contour samples"
    click.echo(
        f"{name}: {known}{size}, {metrics['frames']} frames, "
        f"{metrics['steps']} steps in {metrics['runtime_s']:.2f} s"
    )
