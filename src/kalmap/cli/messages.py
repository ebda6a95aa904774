"""What the command says on the error stream: one line each."""

from __future__ import annotations

import click


def say(text: str) -> None:
    """`kalmap: ...` on one line, whatever line breaks a file name or a library's message holds."""
    click.echo(f"kalmap: {' '.join(text.split())}", err=True)
