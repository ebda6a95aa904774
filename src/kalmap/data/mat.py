"""The variables a reader asks of a MATLAB file, or a `LogError` that names what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kalmap.data.mat5 import variables
from kalmap.data.text import reason
from kalmap.records import LogError

Value = np.ndarray | list[np.ndarray]


def load_mat(path: Path, names: Sequence[str]) -> dict[str, Value]:
    """The named variables of a `.mat` file, level 5: matrices as float64, cell arrays as lists.

    Raises `LogError` if the file is damaged, or one of them is missing or holds no real numbers.
    """
    found: dict[str, Value] = {}
    at = None
    try:
        for variable in variables(path.read_bytes()):
            if variable.name in names:
                at = variable.name
                found[at] = variable.value()
            at = None
    except OSError as error:
        raise LogError(f"cannot be read: {reason(error)}", file=path) from error
    except ValueError as error:
        raise LogError(f"not a readable MATLAB file: {error}", file=path, field=at) from error
    for name in names:
        if name not in found:
            raise LogError("expected this variable, the file does not hold it", file=path, field=name)
    return found


def variable_names(path: Path) -> list[str]:
    """The names of the variables in a `.mat` file; those before the damage if it is damaged."""
    names = []
    try:
        for variable in variables(path.read_bytes()):
            names.append(variable.name)
    except (OSError, ValueError):
        pass
    return names


def vector(found: dict[str, Value], name: str, path: Path, length: int | None = None) -> np.ndarray:
    """A variable as (n,), whether it is a row or a column; n must be `length` if that is given."""
    values = _numeric(found[name], name, path)
    if values.ndim != 2 or min(values.shape) > 1:
        raise LogError(f"expected a row or a column, found {_size(values)}", file=path, field=name)
    if length is not None and values.size != length:
        raise LogError(f"expected {length} values, found {values.size}", file=path, field=name)
    return values.ravel()


def matrix(
    found: dict[str, Value], name: str, path: Path, *, rows: int | None = None, columns: int | None = None
) -> np.ndarray:
    """A variable as (rows, columns), C-contiguous."""
    values = _numeric(found[name], name, path)
    wanted = (rows, columns)
    if values.ndim != 2 or any(w is not None and w != n for w, n in zip(wanted, values.shape)):
        size = " x ".join("any" if w is None else str(w) for w in wanted)
        raise LogError(f"expected {size} numbers, found {_size(values)}", file=path, field=name)
    return values


def cells(found: dict[str, Value], name: str, path: Path, length: int) -> list[np.ndarray]:
    """A cell array of `length` matrices."""
    values = found[name]
    if not isinstance(values, list) or len(values) != length:
        raise LogError(f"expected {length} cells, found {_size(values)}", file=path, field=name)
    return values


def _numeric(values: Value, name: str, path: Path) -> np.ndarray:
    if isinstance(values, list):
        raise LogError(f"expected real numbers, found {_size(values)}", file=path, field=name)
    return values


def _size(values: Value) -> str:
    if isinstance(values, list):
        return f"{len(values)} cells"
    return " x ".join(map(str, values.shape))
