"""The container of a native map file: an uncompressed zip, as `.npz` is, of `header.json` and one `.npy` an array."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.records import LogError

# What zipfile raises on damaged files; the last three where a broken entry asks for what it cannot do.
_DAMAGES = (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError, RuntimeError, zlib.error)

Header = dict[str, Any]
Arrays = dict[str, np.ndarray]


def archive_bytes(header: Header, arrays: Mapping[str, np.ndarray], dtypes: Mapping[str, str]) -> bytes:
    """The file's content. Member dates are fixed, so that equal maps are equal files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("header.json"), msgspec.json.encode(header))
        for name, values in arrays.items():
            member = io.BytesIO()
            plain = np.ascontiguousarray(values, dtype=dtypes[name])
            np.lib.format.write_array(member, plain, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue())
    return stream.getvalue()


def read_archive(
    path: Path, check: Callable[[Header, Path], None], dtypes: Callable[[Header], Mapping[str, str]]
) -> tuple[Header, Arrays]:
    """Header and arrays of a file.

    check: raises `LogError` for a header that is of no use. dtypes: which arrays a header promises, and of which type.
    Raises `LogError`, naming the file and the part, if it is missing, is no such file, is cut off or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            header = _read_header(archive, path)
            check(header, path)
            arrays = {name: _read_array(archive, name, kind, path) for name, kind in dtypes(header).items()}
    except FileNotFoundError as error:
        raise LogError("no such file", file=path) from error
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}", file=path) from error
    except _DAMAGES as error:
        raise LogError(f"not a kalmap map, or cut off or damaged: {error}", file=path) from error
    return header, arrays


def _read_header(archive: zipfile.ZipFile, path: Path) -> Header:
    try:
        header: Header = msgspec.json.decode(archive.read("header.json"), type=dict[str, Any])
    except KeyError as error:
        raise LogError("not a kalmap map: the zip file has no header.json", file=path) from error
    except msgspec.MsgspecError as error:
        raise LogError(f"not JSON: {error}", file=path, field="header.json") from error
    return header


def _read_array(archive: zipfile.ZipFile, name: str, kind: str, path: Path) -> np.ndarray:
    """One member as a one-dimensional array of the type that the format fixes."""
    try:
        # Read whole, so that zipfile compares the checksum before anything is believed.
        member = io.BytesIO(archive.read(f"{name}.npy"))
        values = np.lib.format.read_array(member, allow_pickle=False)
    except KeyError as error:
        raise LogError("missing", file=path, field=name) from error
    except (ValueError, EOFError) as error:
        raise LogError(f"damaged: {error}", file=path, field=name) from error
    if values.dtype != np.dtype(kind) or values.ndim != 1:
        raise LogError(
            f"expected a row of {kind}, found {values.dtype} {values.shape}", file=path, field=name
        )
    return values
