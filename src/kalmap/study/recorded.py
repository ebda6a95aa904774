"""A recorded log in a study, in the place of a world."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from kalmap.data import open_log
from kalmap.records import Log, RunConfig


class Recorded(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A log whose seeds are of the method alone: the data is the same in every run.

    path: of its folder. sha256: of its files by name. config: all settings but the method's.
    """

    name: str
    path: str
    sha256: dict[str, str]
    config: RunConfig

    def defaults(self) -> RunConfig:
        """The settings that the methods start from."""
        return self.config

    def log(self) -> Log:
        """The log, with these settings as its own."""
        opened = open_log(self.path)
        return msgspec.structs.replace(opened, name=self.name, defaults=self.config)


def recorded(name: str, folder: Path, config: RunConfig) -> Recorded:
    """The log in this folder. Raises LogError if there is none."""
    files = open_log(str(folder)).files
    hashes = {Path(file).name: hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files}
    return Recorded(name=name, path=str(folder), sha256=hashes, config=config)
