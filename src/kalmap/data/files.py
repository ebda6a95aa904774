"""How files are written: whole or not at all, values as JSON, tables as csv; and text read with errors that name it."""

from __future__ import annotations

import csv
import io
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.records import LogError


@contextmanager
def moved_into_place(path: Path) -> Iterator[Path]:
    """A path beside the file to write to: at the end it takes the file's place, on an error it is removed.

    A reader sees the file that was there before, or all of the new one, whatever happens.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        yield part
        with open(part, "r+b") as stream:
            os.fsync(stream.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old one or all of the new one."""
    with moved_into_place(path) as part:
        part.write_bytes(content)


def json_ready(value: Any) -> Any:
    """Turn structs, arrays and paths into what JSON holds; a number that is not finite becomes None."""
    if isinstance(value, np.ndarray | np.generic):
        return json_ready(value.tolist())
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [json_ready(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, msgspec.Struct):
        return {name: json_ready(getattr(value, name)) for name in value.__struct_fields__}
    return msgspec.to_builtins(value)


def json_text(value: Any) -> str:
    """Anything that `json_ready` takes as indented JSON, a line break at its end."""
    encoded: bytes = msgspec.json.format(msgspec.json.encode(json_ready(value)), indent=2)
    return encoded.decode() + "\n"


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Comma-separated text; `csv` writes floats with as many digits as bring them back exactly."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()


def read_text(path: Path) -> str:
    """The file's text. Raises `LogError` if it cannot be read."""
    try:
        return path.read_bytes().decode()
    except FileNotFoundError as error:
        raise LogError("no such file", file=path) from error
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}", file=path) from error
    except UnicodeDecodeError as error:
        raise LogError("not a text file", file=path) from error
