"""MATLAB's files of level 5 (versions 5 to 7): their variables, read within the bounds of the file.

Source: MathWorks, "MAT-File Format", chapter 1. A file is a header of 128 bytes and elements, each
a tag of a type and a length, and data that is padded to eight bytes. Here no length is believed
before the data is there, so a damaged file ends in an error and not in the process.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, NamedTuple

import numpy as np

HEADER = 128
HDF5 = b"\x89HDF\r\n\x1a\n"

NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""Types of data that are numbers."""

TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
"""Types of data that a text may have."""

MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, TEXT = 1, 2, 4
NUMERIC = range(6, 16)
OTHERS = {3: "an object", 5: "a sparse array", 16: "a function", 17: "an object"}
IMAGINARY = 0x0800

DEPTH = 16
"""Cells and structs within one another; networks have three."""

UNPACKED = 2**28
"""Bytes that the compressed parts of a file may hold together: 33 million numbers."""


class Unread(NamedTuple):
    """A variable that is no array of numbers, no text, cell or struct.

    Attributes:
        reason: what it is.
    """

    reason: str


def read_variables(content: bytes) -> dict[str, Any]:
    """The variables of a file by name.

    Numbers are arrays, texts are lists of their rows, cells arrays of objects, a struct of one
    element is a dictionary.

    Raises:
        ValueError: it is no such file, damaged or cut off, or too large once it is unpacked.
    """
    if content[:8] == HDF5 or content[512:520] == HDF5:
        raise ValueError("it is of version 7.3 (HDF5): save it with MATLAB's option '-v7'")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:HEADER])
    if order is None:
        raise ValueError(
            "it is no MATLAB file of level 5: its header does not end in IM or MI. Files of "
            "version 4 cannot hold cells: save it with MATLAB's option '-v7'"
        )
    if int.from_bytes(content[124:126], "little" if order == "<" else "big") != 0x0100:
        raise ValueError("its header is none of a MATLAB file of level 5")
    found: dict[str, Any] = {}
    room = UNPACKED
    source = _Bytes(memoryview(content)[HEADER:], order)
    while source.left:
        kind, data = source.element(padded=False)
        if kind == COMPRESSED:
            unpacked = _unpacked(data, room)
            room -= len(unpacked)
            kind, data = _Bytes(memoryview(unpacked), order).element(padded=False)
        if kind != MATRIX:
            raise ValueError(f"it holds an element of type {kind}, where only arrays may stand")
        name, value = _array(data, order, 0)
        if name in found:
            raise ValueError(f"it holds two variables that are called {name!r}")
        found[name] = value
    return found


class _Bytes:
    """Bytes that are read from the front."""

    def __init__(self, data: memoryview, order: str):
        self.data, self.order, self.left = data, order, len(data)

    def take(self, count: int) -> memoryview:
        """The next bytes, as many as asked for."""
        if count > self.left:
            raise ValueError(f"it ends too early: {count} bytes are announced, {self.left} left")
        start = len(self.data) - self.left
        self.left -= count
        return self.data[start : start + count]

    def element(self, padded: bool = True) -> tuple[int, memoryview]:
        """The type and the data of the next element."""
        kind, size = (int(each) for each in np.frombuffer(self.take(8), f"{self.order}u4"))
        if kind >> 16:  # a small element: its data stands in place of its length
            start = len(self.data) - self.left - 4
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise ValueError(f"a small element holds {size} bytes, but four is the most")
            return kind, self.data[start : start + size]
        data = self.take(size)
        if padded:
            self.take(min(-size % 8, self.left))
        return kind, data

    def numbers(self) -> np.ndarray:
        """The data of the next element, which must be numbers."""
        kind, data = self.element()
        if kind not in NUMBERS or len(data) % np.dtype(NUMBERS[kind]).itemsize:
            raise ValueError(f"{len(data)} bytes of type {kind} are no numbers")
        return np.frombuffer(data, self.order + NUMBERS[kind])

    def text(self) -> str:
        """The data of the next element, which must be a text."""
        kind, data = self.element()
        if kind not in TEXTS:
            raise ValueError(f"{len(data)} bytes of type {kind} are no text")
        ends = {"<": "-le", ">": "-be"}[self.order] if kind in (4, 17, 18) else ""
        return bytes(data).decode(TEXTS[kind] + ends)


def _unpacked(data: memoryview, room: int) -> bytes:
    unpacking = zlib.decompressobj()
    try:
        found = unpacking.decompress(data, room)
    except zlib.error as error:
        raise ValueError(f"a compressed part is damaged: {error}") from None
    if unpacking.eof:
        return found
    if len(found) >= room:
        raise ValueError(f"it holds more than {UNPACKED} bytes once it is unpacked")
    raise ValueError("a compressed part ends too early")


def _array(data: memoryview, order: str, depth: int) -> tuple[str, Any]:
    """The name and the value of an array."""
    if not data:  # MATLAB's way to write []
        return "", np.zeros((0, 0))
    if depth > DEPTH:
        raise ValueError(f"cells and structs stand in one another, more than {DEPTH} deep")
    source = _Bytes(data, order)
    flags = source.numbers()
    if len(flags) != 2:
        raise ValueError("an array has no flags")
    kind = int(flags[0]) & 0xFF
    if kind == 17:
        return bytes(source.element()[1]).decode("latin-1"), Unread(OTHERS[17])
    shape = tuple(int(each) for each in source.numbers())
    name = source.text()
    if kind in OTHERS:
        return name, Unread(OTHERS[kind])
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"{name!r} has the shape {shape}")
    if kind in NUMERIC:
        value: Any = _shaped(source.numbers(), shape, name)
        if flags[0] & IMAGINARY:
            value = value + 1j * _shaped(source.numbers(), shape, name)
    elif kind == TEXT:
        letters = _shaped(np.array(list(source.text()), "U1"), shape, name)
        value = ["".join(row) for row in letters.reshape(shape[0], -1)]
    elif kind == CELL:
        value = _shaped(_children(source, order, depth, math.prod(shape)), shape, name)
    elif kind == STRUCT:
        value = _struct(source, order, depth, shape)
    else:
        raise ValueError(f"{name!r} is of a class that is not known, {kind}")
    if source.left:
        raise ValueError(f"{source.left} bytes are left after the array {name!r}")
    return name, value


def _shaped(entries: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if len(entries) != math.prod(shape):
        raise ValueError(f"{name!r} has shape {shape}, but {len(entries)} entries")
    return entries.reshape(shape, order="F")


def _children(source: _Bytes, order: str, depth: int, count: int) -> np.ndarray:
    if count > source.left // 8:  # each has a tag at least
        raise ValueError(f"it ends too early: {count} arrays are announced")
    found = np.empty(count, object)
    for k in range(count):
        kind, data = source.element()
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} stands where an array should")
        found[k] = _array(data, order, depth + 1)[1]
    return found


def _struct(source: _Bytes, order: str, depth: int, shape: tuple[int, ...]) -> Any:
    (length,) = source.numbers()
    _, names = source.element()
    if length < 1 or len(names) % length:
        raise ValueError("the names of a struct's fields have no common length")
    fields = [
        bytes(names[k : k + length]).split(b"\0")[0].decode("latin-1")
        for k in range(0, len(names), int(length))
    ]
    values = _children(source, order, depth, len(fields) * math.prod(shape))
    if math.prod(shape) != 1:
        return Unread("an array of structs")
    if len(set(fields)) != len(fields):
        raise ValueError(f"two fields of a struct have one name: {fields}")
    return dict(zip(fields, values, strict=True))
