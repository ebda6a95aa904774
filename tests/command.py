"""Runs the `kalmap` command as a script would, and writes the tiny logs that it is run on."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

COMMAND = [sys.executable, "-m", "kalmap"]
HANGS = 600.0
"""s: longer than to compile everything for the first time on a core that several processes share."""

ODOMETRY = ["0.0,1.0,0.0", "0.1,1.0,0.02", "0.2,1.1,0.02", "0.3,1.0,-0.01", "0.4,1.0,0.0", "0.5,1.0,0.0"]
SIGHTINGS = ["0.05,4.0,0.3,7", "0.05,9.1,-0.8,9", "0.15,3.9,0.31,7", "0.25,3.8,0.31,7", "0.45,8.7,-0.83,9"]


class Answer(NamedTuple):
    """What a run of the command came to."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line on the error stream; fails if there are more or it is a traceback."""
        assert self.err.startswith("kalmap: error: ") and self.err.endswith("\n"), self.err
        assert self.err.count("\n") == 1 and "Traceback" not in self.err, self.err
        return self.err.strip()


def environment() -> dict[str, str]:
    """One thread a process, pictures without a screen, no colours, no debugging."""
    said = {name: value for name, value in os.environ.items() if name not in ("KALMAP_DEBUG", "FORCE_COLOR")}
    return said | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}


def start(*words: object, cwd: Path | None = None) -> subprocess.Popen[str]:
    """The command, started; Ctrl-C reaches it even where the tests run in the background."""
    return subprocess.Popen(
        [*COMMAND, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        cwd=cwd,
        env=environment(),
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def kalmap(*words: object, cwd: Path | None = None) -> Answer:
    """The command, run to its end."""
    process = start(*words, cwd=cwd)
    try:
        out, err = process.communicate(timeout=HANGS)
    finally:
        process.kill()
    return Answer(process.returncode, out, err)


def kalmap_inside(*words: object) -> Answer:
    """The command in this process: everything but a fresh interpreter, for where many calls would each pay for one."""
    from kalmap.cli.main import main

    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    code = 0
    said = patch.object(sys, "argv", ["kalmap", *map(str, words)])
    alone = patch.dict(os.environ, environment(), clear=True)
    try:
        with said, alone, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    return Answer(code, *(stream.buffer.getvalue().decode() for stream in (out, err)))


def kalmap_all_inside(calls: Mapping[str, Iterable[object]]) -> dict[str, Answer]:
    """Several command lines by name, one after the other in this process."""
    return {name: kalmap_inside(*words) for name, words in calls.items()}


def write_log(
    folder: Path,
    odometry: Iterable[str] = ODOMETRY,
    sightings: Iterable[str] | None = SIGHTINGS,
    *,
    motion: str = "time,speed,steering",
    seen: str = "time,range,bearing,id",
    **header: Any,
) -> Path:
    """A log in the csv layout; `header` goes into log.json."""
    folder.mkdir(parents=True)
    (folder / "odometry.csv").write_text("\n".join([motion, *odometry]) + "\n")
    if sightings is not None:
        (folder / "sightings.csv").write_text("\n".join([seen, *sightings]) + "\n")
    if header:
        (folder / "log.json").write_text(json.dumps(header))
    return folder


def changed(rows: list[str], line: int, text: str) -> list[str]:
    """The rows with the one on that line of the file (the header is 1) replaced."""
    return [*rows[: line - 2], text, *rows[line - 1 :]]


def manifest(folder: Path) -> dict[str, Any]:
    """A result's manifest.json."""
    return json.loads((folder / "manifest.json").read_text())


def times(folder: Path) -> list[float]:
    """The first column of a result's trajectory.csv, every cell of which must be a finite number."""
    rows = (folder / "trajectory.csv").read_text().splitlines()[1:]
    table = [[float(cell) for cell in row.split(",")] for row in rows]
    assert all(abs(cell) < float("inf") for row in table for cell in row)
    return [row[0] for row in table]
