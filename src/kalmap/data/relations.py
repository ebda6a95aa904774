"""Relations files: the true motion between pairs of instants of a laser log (Kuemmerle et al. 2009).

One relation a line, `t1 t2 x y z roll pitch yaw`: the robot at t2 seen from the robot at t1, m and rad.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kalmap.data.text import read_table, read_text
from kalmap.records import LogError, Reference, Relations

COLUMNS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")
PACKED = (".xz", ".bz2", ".gz")


def read_relations(path: Path | str) -> Relations:
    """The relations in a file. Raises LogError, naming file, line and field, if a line is not eight finite numbers."""
    path = Path(path)
    table = read_table(read_text(path), COLUMNS)
    for row, why in sorted(table.malformed.items()):
        raise LogError(why.problem, file=path, record=int(table.records[row]), field=why.field)
    wrong = np.argwhere(~np.isfinite(table.values))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise LogError(
            f"expected a finite number, found {table.values[row, column]}",
            file=path,
            record=int(table.records[row]),
            field=COLUMNS[column],
        )
    if not len(table.values):
        raise LogError("holds no relations", file=path)
    first, second = (np.ascontiguousarray(table.values[:, column]) for column in (0, 1))
    return Relations(first, second, np.ascontiguousarray(table.values[:, [2, 3, 7]]))


def relations_beside(path: Path) -> tuple[Reference, ...]:
    """The relations that belong to a log by their name (`intel.clf.xz`, `intel.relations`), if there are any."""
    name = path.name
    for ending in PACKED:
        name = name.removesuffix(ending)
    found = path.with_name(Path(name).stem + ".relations")
    return (Reference(kind="relations", relations=read_relations(found)),) if found.is_file() else ()
