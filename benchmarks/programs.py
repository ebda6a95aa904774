"""Running kalmap and the peers, each in a process of its own, one after the other, on one core."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import worlds

CORE = os.environ.get("KALMAP_BENCH_CORE", "1")
HERE = Path(__file__).resolve().parent


def run_pinned(command: list[str], **options: Any) -> str:
    """The output of a command on one core with one BLAS thread. Raises RuntimeError if it fails."""
    pin = ["taskset", "-c", CORE] if shutil.which("taskset") and (os.cpu_count() or 1) > int(CORE) else []
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    worlds.LOGS.mkdir(parents=True, exist_ok=True)
    env = os.environ | one | {"PEER_OUT": str(worlds.LOGS), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(pin + command, env=env, capture_output=True, text=True, check=False, **options)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    return done.stdout


def kalmap(what: str, world: str, seed: int, filter_name: str, *more: str) -> dict[str, Any]:
    """`kalmap_run.py` in its own process."""
    script = str(HERE / "kalmap_run.py")
    options = ["--world", world, "--seed", str(seed), "--filter", filter_name, *more]
    return dict(json.loads(run_pinned([sys.executable, script, what, *options])))


def has_gtsam() -> bool:
    """Whether GTSAM can be imported, without importing it."""
    return _version("gtsam") is not None


def isam2(world: str, seed: int, marginals_every: int, limit_s: float) -> dict[str, float]:
    """GTSAM's iSAM2, one update a scan, through the peers' program. limit_s: wall seconds, then it stops."""
    script = str(worlds.require_peers() / "gtsam_sim.py")
    out = run_pinned(
        [sys.executable, script, "--world", world, "--seeds", str(seed), "--joint-max", "0", "--no-batch"]
        + ["--marg-every", str(marginals_every), "--max-s", str(limit_s)]
    )
    return {key: float(value) for key, value in json.loads(out[out.index("{") : out.index("}") + 1]).items()}


def mrpt_program() -> Path | None:
    """MRPT's replay program, built if need be; None where MRPT or cmake is missing."""
    folder, source = worlds.OUT / "mrpt", worlds.require_peers() / "mrpt"
    program = folder / "build" / "kfslam2d_replay"
    if program.is_file():
        return program
    if shutil.which("cmake") is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("CMakeLists.txt", "kfslam2d_replay.cpp", "jcbb_kat.cpp"):
        shutil.copy(source / name, folder / name)
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
            return None
    return program


def mrpt_ekf(program: Path, world: str, seed: int, limit_s: float) -> dict[str, float]:
    """MRPT's C++ EKF with known association; it stops after limit_s seconds inside the filter."""
    log = worlds.LOGS / f"{world}_s{seed}.txt"
    if not log.is_file():
        export = str(worlds.require_peers() / "mrpt" / "export.py")
        run_pinned([sys.executable, export, world, str(seed)])
    out = run_pinned([str(program), str(log), "known", "1", "maha", "0.9999", f"{limit_s:g}"])
    line = out.strip().splitlines()[-1]
    done = re.search(r"scans (\d+)/(\d+)", line)
    mean = re.search(r"ms_mean\(cpu\) (\S+)", line)
    if done is None or mean is None:
        raise RuntimeError(f"MRPT said {line!r}")
    scans = float(done[1])
    return {"scans": scans, "of": float(done[2]), "cpu_s": 1e-3 * float(mean[1]) * scans}


def machine() -> dict[str, Any]:
    """What a number depends on: processor, system, versions, date."""
    packages = ("kalmap", "numpy", "scipy", "numba", "gtsam")
    mrpt = subprocess.run(
        ["dpkg-query", "-W", "-f=${Version}", "libmrpt-slam-dev"], capture_output=True, text=True, check=False
    ) if shutil.which("dpkg-query") else None  # fmt: skip
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: _version(name) for name in packages},
        "mrpt": mrpt.stdout or None if mrpt else None,
        "commit": commit(),
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str | None:
    """The commit that was measured, with "+" where its sources have been changed since."""
    if shutil.which("git") is None:
        return None
    asked = (["rev-parse", "--short", "HEAD"], ["status", "--porcelain", "src"])
    head, changed = (
        subprocess.run(
            ["git", *words], cwd=worlds.ROOT, capture_output=True, text=True, check=False
        ).stdout.strip()
        for words in asked
    )
    return head + "+" * bool(changed) if head else None


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    found = re.search(r"model name\s*:\s*(.+)", text)
    wide = " with AVX-512" if "avx512f" in text else ""
    return (found[1] if found else platform.machine()) + wide
