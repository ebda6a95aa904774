"""The runs that a study has already made, one small file each, so that it goes on where it was stopped."""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

import msgspec

import kalmap
from kalmap.data.files import json_ready, write_atomically
from kalmap.study.cases import CURVE_POINTS, Case, RunRecord

_FORMAT = "kalmap-study-run/1"
# rooms that cannot change what a run comes to, but for the files that make the records
_WITHOUT_EFFECT = ("cli", "view", "data", "study")
_RECORDS = tuple(Path("study", name) for name in ("cases.py", "slasem_cases.py", "slasem_drive.py"))


class Store:
    """Files `<world>-<method>-<seed>-<key>.json`; the key stands for all that the run depends on."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder

    def path(self, case: Case) -> Path:
        """Where a case's record belongs."""
        name = re.sub(r"[^a-z0-9]+", "-", f"{case.world.name}-{case.method.name}".lower()).strip("-")
        return self.folder / f"{name}-{case.seed:04d}-{case_key(case)}.json"

    def read(self, case: Case) -> RunRecord | None:
        """The record of a case if it was made before; a damaged one counts as none and is made again."""
        try:
            record = msgspec.json.decode(self.path(case).read_bytes(), type=RunRecord)
        except (OSError, msgspec.MsgspecError):
            return None
        return msgspec.structs.replace(record, method=case.method.name)

    def write(self, case: Case, record: RunRecord) -> None:
        """Keep a record, on one line."""
        write_atomically(self.path(case), msgspec.json.encode(record) + b"\n")


def case_key(case: Case) -> str:
    """Hash of everything a result depends on: world, settings, seed, kalmap's version and its sources.

    The sources of the rooms that take part in a run are hashed too, so that a study made while kalmap
    itself is being changed never mixes results of two programs.
    """
    content = {
        "format": _FORMAT,
        "joint": case.keep_joint,
        "kalmap": kalmap.__version__,
        "sources": _sources(),
        "points": CURVE_POINTS,
        "world": json_ready(case.world),
        "config": json_ready(case.config()),
    }
    return hashlib.sha256(msgspec.json.encode(content, order="deterministic")).hexdigest()[:16]


@functools.cache
def _sources() -> str:
    """Digest of the package's source files, without the rooms that take no part in a run."""
    root = Path(kalmap.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        inside = path.relative_to(root)
        if inside in _RECORDS or inside.parts[0] not in _WITHOUT_EFFECT:
            digest.update(inside.as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
