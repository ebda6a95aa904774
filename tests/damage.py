"""Saved files cut short or with a byte flipped, and what loading makes of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from kalmap.records import LogError


def cuts(saved: bytes, step: int) -> list[int]:
    """Lengths to cut a file to: almost nothing, every so many bytes, and all but the last."""
    return [0, 1, 3, 30, *range(100, len(saved), step), len(saved) - 1]


def refused(load: Callable[[Path], object], path: Path) -> bool:
    """Whether loading raises LogError, which must name the file."""
    try:
        load(path)
    except LogError as problem:
        assert problem.file == path
        return True
    return False


def refused_cuts(saved: bytes, path: Path, load: Callable[[Path], object], lengths: list[int]) -> list[int]:
    """Which of these beginnings of the file are refused."""
    found = []
    for length in lengths:
        path.write_bytes(saved[:length])
        if refused(load, path):
            found.append(length)
    return found


@dataclass
class Flips:
    """Positions of flipped bytes: refused, of no meaning, or believed as something that was not saved."""

    refused: list[int] = field(default_factory=list)
    harmless: list[int] = field(default_factory=list)
    believed: list[int] = field(default_factory=list)


def flipped(saved: bytes, path: Path, state: Callable[[Path], object], step: int) -> Flips:
    """Every so many bytes one flipped; state: loads the file and says all that it holds, to be compared."""
    path.write_bytes(saved)
    good, found = state(path), Flips()
    for position in range(0, len(saved), step):
        broken = bytearray(saved)
        broken[position] ^= 0xFF
        path.write_bytes(bytes(broken))
        try:
            same = state(path) == good
        except LogError as problem:
            assert problem.file == path, position
            found.refused.append(position)
            continue
        (found.harmless if same else found.believed).append(position)
    return found
