"""MATLAB level 5 files, as far as logs need them: real matrices and cells of real matrices.

Own code because `scipy.io.loadmat` crashes the whole process on some corrupt files. Here every length
is checked against the bytes that are there, and whatever is wrong is a `ValueError`. The layout is that
of MathWorks, "MAT-File Format": a head of 128 bytes, then elements of a tag (type, length) and data.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator

import msgspec
import numpy as np

_HEAD = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _NUMERIC_CLASSES = 1, range(6, 16)
_COMPLEX = 0x800


class Variable(msgspec.Struct, frozen=True):
    """A variable that is not decoded yet. order: "<" or ">", the file's byte order."""

    name: str
    order: str
    kind: int
    complex: bool
    shape: tuple[int, ...]
    body: bytes

    def value(self) -> np.ndarray | list[np.ndarray]:
        """A matrix as float64 in its shape; a cell array as a list, column after column."""
        if self.kind == _CELL:
            return self._cells()
        return self._numbers()

    def _numbers(self) -> np.ndarray:
        if self.kind not in _NUMERIC_CLASSES or self.complex:
            raise ValueError("expected real numbers, found something else")
        number, data, _ = _element(self.body, 0, self.order)
        if number not in _NUMBERS:
            raise ValueError(f"expected numbers, found elements of type {number}")
        kind = np.dtype(self.order + _NUMBERS[number])
        if len(data) != math.prod(self.shape) * kind.itemsize:
            raise ValueError(f"expected {math.prod(self.shape)} numbers, found {len(data)} bytes")
        with np.errstate(invalid="ignore"):
            values = np.frombuffer(data, dtype=kind).astype(np.float64)
        return np.ascontiguousarray(values.reshape(self.shape, order="F"))

    def _cells(self) -> list[np.ndarray]:
        cells, at = [], 0
        while at < len(self.body):
            number, data, at = _element(self.body, at, self.order)
            if number != _MATRIX:
                raise ValueError(f"expected a cell, found an element of type {number}")
            cells.append(_variable(data, self.order)._numbers() if data else np.zeros((0, 0)))
        if len(cells) != math.prod(self.shape):
            raise ValueError(f"expected {math.prod(self.shape)} cells, found {len(cells)}")
        return cells


def variables(content: bytes) -> Iterator[Variable]:
    """The variables of a file, one after the other. Raises `ValueError` where it is damaged."""
    mark = content[_HEAD - 2 : _HEAD]
    if mark not in (b"IM", b"MI"):
        raise ValueError("the head of a MATLAB level 5 file is missing")
    order = "<" if mark == b"IM" else ">"
    at = _HEAD
    while at < len(content):
        number, data, at = _element(content, at, order)
        if number == _COMPRESSED:
            try:
                number, data, _ = _element(zlib.decompress(data), 0, order)
            except zlib.error as error:
                raise ValueError(f"compressed data are damaged ({error})") from None
        if number == _MATRIX and data:
            yield _variable(data, order)


def _element(content: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Type and data of the element at a place, and where the next one begins."""
    if at + 8 > len(content):
        raise ValueError("the file ends inside a tag")
    first, size = np.frombuffer(content, dtype=order + "u4", count=2, offset=at).tolist()
    if first >> 16:
        # The small form: the length in the upper half of the type's word, data in the second word.
        number, size, begin, after = first & 0xFFFF, first >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError("an element is longer than its tag allows")
    else:
        number, begin = first, at + 8
        # Everything but compressed data is padded to a multiple of 8 bytes.
        after = begin + (size if number == _COMPRESSED else -(-size // 8) * 8)
    if begin + size > len(content):
        raise ValueError(f"{begin + size - len(content)} bytes are missing at the end")
    return number, content[begin : begin + size], after


def _variable(data: bytes, order: str) -> Variable:
    _, flags, at = _element(data, 0, order)
    _, sizes, at = _element(data, at, order)
    _, name, at = _element(data, at, order)
    if len(flags) < 4 or len(sizes) < 8 or len(sizes) % 4:
        raise ValueError("a variable without class or size")
    word = int(np.frombuffer(flags, dtype=order + "u4", count=1)[0])
    shape = tuple(np.frombuffer(sizes, dtype=order + "i4").tolist())
    if min(shape) < 0:
        raise ValueError(f"a variable of size {shape}")
    label = name.rstrip(b"\0").decode("ascii", errors="replace")
    return Variable(label, order, word & 0xFF, bool(word & _COMPLEX), shape, data[at:])
