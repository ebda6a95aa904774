"""Text files, plain, packed (xz, bz2, gz) or in a zip, and the tables of numbers in them."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.streams import Malformed
from kalmap.records import LogError


class Table(msgspec.Struct, frozen=True):
    """Numbers out of a text file. values: (n, c); records: (n,) line numbers from 1.

    malformed: index of a row -> why it could not be read; its numbers are NaN.
    """

    values: np.ndarray
    records: np.ndarray
    malformed: dict[int, Malformed]


_UNPACK: dict[str, Callable[[bytes], bytes]] = {
    ".xz": lzma.decompress,
    ".bz2": bz2.decompress,
    ".gz": gzip.decompress,
}
_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    lzma.LZMAError,
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,
)


def read_text(path: Path, member: str | None = None) -> str:
    """The whole text of a file; of an `.xz`, `.bz2` or `.gz` unpacked; of a `.zip` the given member.

    Bytes that are not UTF-8 come out as replacement characters, so that the number parser can name
    their row. Raises `LogError` if the file is missing, cannot be opened or is cut short.
    """
    try:
        if member is not None:
            with zipfile.ZipFile(path) as archive:
                data = archive.read(member)
        else:
            data = _UNPACK.get(path.suffix, bytes)(path.read_bytes())
    except KeyError:
        raise LogError(f"the archive holds no {member}", file=path) from None
    except _UNREADABLE as error:
        raise LogError(f"cannot be read: {reason(error)}", file=path) from error
    return data.decode("utf-8", errors="replace").removeprefix("\ufeff")


def reason(error: BaseException) -> str:
    """What an error of the system or of a library says, without the path that the caller names anyway."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error) or type(error).__name__


def read_table(text: str, columns: Sequence[str]) -> Table:
    """Blank-separated numbers, one row a line; lines that are blank or begin with `#` are passed over."""
    lines = text.splitlines()
    numbers = [k for k, line in enumerate(lines) if line and not line.isspace() and line.lstrip()[0] != "#"]
    rows = [lines[k].split() for k in numbers]
    return parse_rows(rows, np.array(numbers, dtype=np.int64) + 1, columns)


def parse_rows(
    rows: list[list[str]], records: np.ndarray, columns: Sequence[str], blank: Sequence[str] = ()
) -> Table:
    """Cells to numbers. columns: names, in the order of the cells. blank: those whose cells may be empty.

    A row with too few or too many cells, or with one that is no number, is `malformed`.
    """
    shape = (len(rows), len(columns))
    try:
        values = np.array(rows, dtype=np.float64)
        if values.shape == shape:
            return Table(values, records, {})
    except ValueError:
        pass
    values = np.full(shape, np.nan)
    malformed = {}
    for k, cells in enumerate(rows):
        parsed = _parse_cells(cells, columns, blank)
        if isinstance(parsed, Malformed):
            malformed[k] = parsed
        else:
            values[k] = parsed
    return Table(values, records, malformed)


def _parse_cells(cells: list[str], columns: Sequence[str], blank: Sequence[str]) -> list[float] | Malformed:
    if len(cells) < len(columns):
        missing = columns[len(cells)]
        return Malformed(missing, f"is missing: expected {len(columns)} columns, found {len(cells)}")
    if len(cells) > len(columns):
        return Malformed(f"column {len(columns) + 1}", f"expected {len(columns)} columns, found {len(cells)}")
    numbers = []
    for name, cell in zip(columns, cells):
        if not cell.strip() and name in blank:
            numbers.append(np.nan)
            continue
        try:
            numbers.append(float(cell))
        except ValueError:
            return Malformed(name, f"expected a number, found {cell!r}")
    return numbers
