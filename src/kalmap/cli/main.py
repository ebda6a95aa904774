"""The `kalmap` command. Each verb has a file of its own, imported when it is called."""

from __future__ import annotations

import os
import sys
from importlib import import_module

import click

from kalmap._version import __version__
from kalmap.cli.messages import say

_VERBS = {
    "demo": "Run the main job on the built-in world.",
    "run": "Run a filter over a log or a simulated world.",
    "compare": "Run several filters over the same log.",
    "join": "Join two finished maps, of two robots or two days.",
    "why": "Say why sightings went to the landmarks they went to.",
    "check": "Say what is in a log and what is wrong with it.",
    "reproduce": "Make a paper's tables and figures again.",
}

BAD_INPUT, INTERNAL, INTERRUPTED = 2, 70, 130


class _Verbs(click.Group):
    """A group that knows its verbs' one-line helps without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _VERBS:
            return None
        return import_module(f"kalmap.cli.{cmd_name}").command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_VERBS.items()))


@click.group(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="kalmap", message="%(prog)s %(version)s")
def kalmap() -> None:
    """2-D SLAM from logs: trajectory, map and honest covariances. No ROS needed.

    Exit codes: 0 all is well; 1 `check` found problems or a claim did not hold; 2 bad input or usage (what was
    computed before is written); 70 a fault of kalmap itself; 130 interrupted (what there is is written).
    """


def main() -> None:
    """Entry point: every error becomes one line and an exit code."""
    for name in (
        "OPENBLAS_NUM_THREADS",
        "OMP_NUM_THREADS",
    ):  # many small products: threads cost more than they bring
        os.environ.setdefault(name, "1")
    try:
        code = kalmap.main(prog_name="kalmap", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit as leaving:  # click's answer to a reader of our output who has gone: no fault of anyone
        _drop_output()
        code = 0 if leaving.code == 1 else leaving.code
    except BrokenPipeError:
        _drop_output()
        code = 0
    except (click.Abort, KeyboardInterrupt):
        say("interrupted")
        code = INTERRUPTED
    except Exception as problem:  # the one place where errors meet the user
        code = _explain(problem)
    sys.exit(code if isinstance(code, int) else 0)


def _explain(problem: Exception) -> int:
    """Say on the error stream what is wrong; returns the exit code for it."""
    from kalmap.records.errors import KalmapError  # not at the top: `--help` has no use for it

    if isinstance(problem, KalmapError):
        say(f"error: {problem}")
        return BAD_INPUT
    if isinstance(problem, click.exceptions.NoArgsIsHelpError):
        click.echo(problem.format_message(), err=True)
        return BAD_INPUT
    if isinstance(problem, click.ClickException):
        say(f"error: {problem.format_message()}{_where_help_is(problem)}")
        return problem.exit_code
    if os.environ.get("KALMAP_DEBUG"):
        raise problem
    if isinstance(
        problem, OSError
    ):  # the disk is full, a folder cannot be made: nothing that kalmap could help
        say(f"error: {_of_system(problem)}")
        return BAD_INPUT
    say(f"internal error: {type(problem).__name__}: {problem} (KALMAP_DEBUG=1 shows where; please report it)")
    return INTERNAL


def _where_help_is(problem: click.ClickException) -> str:
    context = problem.ctx if isinstance(problem, click.UsageError) else None
    return "" if context is None else f" (see {context.command_path} --help)"


def _of_system(problem: OSError) -> str:
    reason = (problem.strerror or str(problem) or type(problem).__name__).lower()
    return reason if problem.filename is None else f"{problem.filename}: {reason}"


def _drop_output() -> None:
    """Send what is still to be written nowhere, so that nobody complains when the interpreter ends."""
    sys.stdout = sys.__stdout__
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
