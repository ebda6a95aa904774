"""The command itself: help, version, usage errors, and an output that nobody reads any more."""

from __future__ import annotations

import re
import subprocess

import pytest

from command import COMMAND, environment, kalmap, kalmap_all_inside
from kalmap import __version__

VERBS = ("demo", "run", "compare", "check", "reproduce")
HEAVY = ("numba", "scipy", "matplotlib")
OPTIONS = (
    *(
        "--method",
        "--particles",
        "--filter",
        "--scope",
        "--coordinates",
        "--use",
        "--association",
        "--out",
        "--seed",
        "--config",
        "--set",
    ),
    *("--robot", "--variant", "--tolerant", "--quiet", "--no-figures"),
)

USAGE = {
    "unknown verb": (["fly"], "No such command 'fly'"),
    "unknown option": (["run", "course-35", "--turbo"], "--turbo"),
    "no log": (["run"], "LOG"),
    "unknown filter": (["run", "course-35", "--filter", "pf"], "'pf' is not one of 'ekf'"),
    "unknown scope": (["run", "course-35", "--scope", "half"], "'half'"),
    "negative seed": (["run", "course-35", "--seed", "-1"], "--seed"),
    "robot in words": (["run", "course-35", "--robot", "two"], "--robot two"),
    "robot as a power": (["run", "course-35", "--robot", "\u00b2"], "--robot"),
    "all robots compared": (["compare", "course-35", "--methods", "ekf", "--robot", "all"], "--robot all"),
    "no methods": (["compare", "course-35"], "--methods"),
    "unknown paper": (["reproduce", "fastslam"], "fastslam"),
    "no runs": (["reproduce", "crcdkf", "--runs", "0"], "--runs"),
}


def imported(*words: str) -> set[str]:
    """The modules that a command line loads. Oracle: the interpreter's own `-X importtime`."""
    line = [COMMAND[0], "-X", "importtime", *COMMAND[1:], *words]
    answer = subprocess.run(line, capture_output=True, text=True, env=environment(), check=True)
    return set(re.findall(r"\| +(\S+)$", answer.stderr, flags=re.MULTILINE))


def test_help_loads_nothing_that_takes_time():
    """`kalmap --help` imports no numerics at all; `kalmap run --help` none of the heavy packages."""
    first = imported("--help")
    assert "click" in first and "kalmap.cli.main" in first
    assert not first & {"numpy", *HEAVY}
    assert not imported("run", "--help") & set(HEAVY)


def test_every_verb_has_help_and_the_version_is_the_packages():
    """All helps come with code 0 and nothing on the error stream; the main one lists every verb."""
    answers = kalmap_all_inside(
        {verb: [verb, "--help"] for verb in VERBS} | {"": ["--help"], "v": ["--version"]}
    )
    assert all(answer.code == 0 and answer.err == "" for answer in answers.values())
    assert all(f"  {verb} " in answers[""].out for verb in VERBS)
    assert all(answers[verb].out.startswith(f"Usage: kalmap {verb} ") for verb in VERBS)
    assert answers["v"].out == f"kalmap {__version__}\n"
    assert set(OPTIONS) <= set(re.findall(r"--[a-z-]+", answers["run"].out))


@pytest.fixture(scope="module")
def usage():
    return kalmap_all_inside({name: words for name, (words, _) in USAGE.items()})


@pytest.mark.parametrize("name", USAGE)
def test_wrong_usage_is_one_line_and_code_2(usage, name):
    """A command line that makes no sense: nothing on the output, one line that says what is wrong."""
    assert usage[name].code == 2 and usage[name].out == ""
    assert USAGE[name][1] in usage[name].error


def test_without_a_verb_the_help_is_shown():
    """`kalmap` alone: the help, on the error stream, and code 2."""
    answer = kalmap()
    assert (answer.code, answer.out) == (2, "") and answer.err.startswith("Usage: kalmap ")


def test_an_output_that_nobody_reads_is_no_error():
    """`kalmap --help | head -0`: the reader is gone before anything is written; code 0, no complaint."""
    for words in (["--help"], ["check", "course-35"]):
        process = subprocess.Popen(
            [*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
        )
        process.stdout.close()
        complaint = process.stderr.read()
        process.stderr.close()
        assert (process.wait(timeout=60), complaint) == (0, "")
