"""What a running estimator leaves on disk: a header and arrays beside it, exact to the last bit, without pickling."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from kalmap.gaussian import Belief
from kalmap.records import ConfigError, LogError

State = TypeVar("State", bound=msgspec.Struct)

_NAME = "array{}"


class _BeliefRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A belief's numbers, without the room to grow."""

    mean: np.ndarray
    packed: np.ndarray
    phi: np.ndarray
    pending: bool


class Writing:
    """Takes the arrays out of what msgspec encodes, and leaves their numbers in it."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}

    def hook(self, value: Any) -> Any:
        """msgspec's `enc_hook`. Raises TypeError for what is no part of a filter that kalmap can name."""
        if isinstance(value, np.ndarray):
            number = len(self.arrays)
            self.arrays[_NAME.format(number)] = value
            return number
        if isinstance(value, Belief):
            n = value.n
            return _BeliefRecord(value.mean[:n], value.packed[: n * (n + 1) // 2], value.phi, value.pending)
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"{type(value).__name__} cannot be written")


class Reading:
    """Puts the arrays back in."""

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.arrays = arrays

    def hook(self, kind: type, value: Any) -> Any:
        """msgspec's `dec_hook`. Raises ValueError for what cannot have been written."""
        if kind is np.ndarray and isinstance(value, int):
            return self.arrays[_NAME.format(value)]
        if kind is Belief:
            record = msgspec.convert(value, _BeliefRecord, dec_hook=self.hook)
            return belief_of(record.mean, record.packed, record.phi, record.pending)
        raise ValueError(f"{value!r} is no {kind.__name__}")


def belief_of(mean: np.ndarray, packed: np.ndarray, phi: np.ndarray, pending: bool) -> Belief:
    """The belief of these numbers. Raises ValueError if they do not fit together."""
    n, robot = len(mean), len(phi)
    check_arrays((mean, (n,)), (packed, (n * (n + 1) // 2,)), (phi, (robot, robot)))
    belief = Belief(mean[:robot], np.zeros((robot, robot)))
    belief.reserve(n)
    belief.mean[:n], belief.packed[: len(packed)], belief.n = mean, packed, n
    belief.phi[:], belief.pending = phi, pending
    return belief


def check_arrays(*arrays: tuple[Any, ...]) -> None:
    """Each: array or None, shape, numpy's kinds of number (any real one if left out). Raises ValueError."""
    for array, shape, *kinds in arrays:
        if array is None:
            continue
        if array.shape != shape or array.dtype.kind not in (kinds[0] if kinds else "iuf"):
            raise ValueError(f"an array is {array.shape} of {array.dtype}, expected {shape}")


def write_archive(
    path: str | os.PathLike[str], state: msgspec.Struct, arrays: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write atomically; arrays: those that go by a name of their own, the others take numbers.

    Raises ConfigError if the state holds something that kalmap cannot name.
    """
    writing = Writing()
    try:
        header = msgspec.msgpack.encode(state, enc_hook=writing.hook)
        msgspec.msgpack.decode(header, type=type(state), dec_hook=Reading(writing.arrays).hook)
    except (TypeError, msgspec.ValidationError) as problem:
        raise ConfigError(
            f"this filter holds a part that is not built in and cannot be saved: {problem}"
        ) from problem
    buffer = io.BytesIO()
    text = np.frombuffer(header, dtype=np.uint8)
    np.savez(buffer, header=text, **(arrays or {}), **writing.arrays)  # type: ignore[arg-type]
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    partial.write_bytes(buffer.getvalue())
    os.replace(partial, target)


@contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[Mapping[str, np.ndarray]]:
    """The arrays of a file. Raises LogError if it is not there, or for what goes wrong while it is made use of."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            yield stored
    except FileNotFoundError:
        raise LogError("no such file", file=path) from None
    except (*_DAMAGE, ConfigError) as problem:
        raise LogError(f"is no saved filter of kalmap, or is damaged ({problem})", file=path) from problem


# what numpy and zipfile raise on files that are something else or have been damaged, beside their own errors
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    MemoryError,
    RuntimeError,
    zipfile.BadZipFile,
    msgspec.MsgspecError,
)


def read_header(stored: Mapping[str, np.ndarray], kind: type[State], name: str) -> State:
    """The header of a file. Raises ValueError if it is of another format."""
    header = stored["header"].tobytes()
    state = msgspec.msgpack.decode(header, type=kind, dec_hook=Reading(stored).hook)
    said = getattr(state, "format", None)
    if said != name:
        raise ValueError(f"format {said!r}, expected {name!r}")
    return state
