"""Maps of the SLAM simulator by T. Bailey and J. Nieto: landmarks, and waypoints to drive along."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.mat import load_mat, matrix
from kalmap.data.text import parse_rows, read_text
from kalmap.records import LogError


class WorldMap(msgspec.Struct, frozen=True):
    """A world to simulate in. landmarks: (N, 2) m. waypoints: (M, 2) m."""

    landmarks: np.ndarray
    waypoints: np.ndarray


def read_map(path: str | Path) -> WorldMap:
    """A map from a `.mat` file (`lm` 2 x N, `wp` 2 x M) or from its text form.

    The text form holds a head `lm 2 N` with N lines `x y` after it, and `wp 2 M` with M lines; blank
    lines and lines that begin with `#` are passed over. Raises `LogError`.
    """
    path = Path(path)
    if path.suffix == ".mat":
        variables = load_mat(path, ("lm", "wp"))
        found = {name: matrix(variables, name, path, rows=2).T for name in ("lm", "wp")}
    else:
        found = _read_text_map(path)
    for name, points in found.items():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise LogError("expected finite numbers", file=path, record=int(bad[0]) + 1, field=name)
    return WorldMap(np.ascontiguousarray(found["lm"]), np.ascontiguousarray(found["wp"]))


def _read_text_map(path: Path) -> dict[str, np.ndarray]:
    numbered = [(k, line.split()) for k, line in enumerate(read_text(path).splitlines(), start=1)]
    rows = [(k, words) for k, words in numbered if words and not words[0].startswith("#")]
    found: dict[str, np.ndarray] = {}
    at = 0
    while at < len(rows):
        number, head = rows[at]
        if len(head) != 3 or head[0] not in ("lm", "wp") or head[1] != "2" or not head[2].isdecimal():
            raise LogError(
                "expected `lm 2 <count>` or `wp 2 <count>`", file=path, record=number, field="head"
            )
        count = int(head[2])
        body = rows[at + 1 : at + 1 + count]
        table = parse_rows([words for _, words in body], np.array([k for k, _ in body]), ("x", "y"))
        for row, why in sorted(table.malformed.items()):
            raise LogError(why.problem, file=path, record=int(table.records[row]), field=why.field)
        if len(body) < count:
            raise LogError(f"expected {count} points, found {len(body)}", file=path, field=head[0])
        found[head[0]] = table.values.reshape(count, 2)
        at += 1 + count
    for name in ("lm", "wp"):
        if name not in found:
            raise LogError("is missing", file=path, field=name)
    return found
