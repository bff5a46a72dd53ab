"""Archives of arrays with a document in JSON (`.npz`), read without trust in what they say.

Nothing is allocated before it is known how large it is, and that it is no larger than files of this
size are. What the document does not name is not there.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reachjax.numerics.checks import require_kind

DOCUMENT = "document"

LEAST, RATIO = 2**30, 64
"""Bytes that any archive may hold, and how many for each of its own: zeros shrink a thousand times.
What would hold more is written without being compressed."""

KINDS = "biufc"
"""Kinds of numbers: arrays of anything else are not read."""


class UnreadableError(ValueError):
    """A file that was not written by this package, or not by this version of it, or is broken."""


def write_archive(path: Path, head: dict[str, Any], arrays: Sequence[np.ndarray]) -> None:
    """Write a file; one that is there is replaced once the new one is whole.

    Args:
        path: of the file.
        head: the document.
        arrays: of numbers.

    Raises:
        OSError: it cannot be written.
    """
    held = {f"a{number}": array for number, array in enumerate(arrays)}
    held[DOCUMENT] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    partial = path.with_name(path.name + ".part")
    try:
        for save in (np.savez_compressed, np.savez):
            with partial.open("wb") as file:
                save(file, allow_pickle=False, **held)
            if 2 * sum(array.nbytes for array in held.values()) <= _most(partial):
                break
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_archive(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The document and the arrays of a file.

    Raises:
        Exception: of any kind: it is no archive, or broken; one bit is enough for that.
        UnreadableError: it holds more than it may, or other arrays than the document names.
    """
    with zipfile.ZipFile(path) as file:
        entries = {info.filename.removesuffix(".npy"): info for info in file.infolist()}
        size, most = sum(info.file_size for info in file.infolist()), _most(path)
        if len(entries) != len(file.infolist()) or DOCUMENT not in entries:
            raise UnreadableError("it has no document, or several arrays of one name")
        if size > most:
            raise UnreadableError(f"it holds {size} bytes, more than the {most} that it may")
        head = json.loads(_array(file, entries.pop(DOCUMENT)).tobytes())
        if not isinstance(head, dict):
            raise UnreadableError("its document says nothing")
        named = set(_numbers(head.get("value")))
        if named != set(range(len(entries))) or set(entries) != {f"a{k}" for k in named}:
            raise UnreadableError("it has other arrays than its document names")
        return head, [_array(file, entries[f"a{number}"]) for number in range(len(entries))]


def digest(described: Any, arrays: Sequence[np.ndarray]) -> str:
    """What tells an archive from one that was changed by accident."""
    found = hashlib.blake2b(json.dumps(described).encode(), digest_size=32)
    for array in arrays:
        found.update(f"{array.dtype.str}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _most(path: Path) -> int:
    """How many bytes an archive may hold."""
    return max(LEAST, RATIO * path.stat().st_size)


def _numbers(described: Any) -> Iterator[Any]:
    """The numbers of all arrays that a document names."""
    left = [described]
    while left:
        each = left.pop()
        if isinstance(each, dict):
            if "array" in each:
                yield each["array"]
            left += each.values()
        elif isinstance(each, list):
            left += each


def _array(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """An array of the size that its header says, which is that of the entry."""
    with file.open(info) as entry:
        version = np.lib.format.read_magic(entry)
        headers = {(1, 0): np.lib.format.read_array_header_1_0}
        headers[2, 0] = np.lib.format.read_array_header_2_0
        shape, by_columns, kind = headers[version](entry)
        size, left = kind.itemsize, info.file_size - entry.tell()
        for length in shape:
            size *= length  # whole numbers of Python's, which do not overflow
        if kind.kind not in KINDS or kind.names or min(shape, default=0) < 0 or size != left:
            raise UnreadableError(f"{info.filename} is no array of {left} bytes of numbers")
        held = np.frombuffer(bytearray(entry.read()), kind)
    return held.reshape(shape, order="F" if by_columns else "C")


def existing_file(name: str, path: Any) -> Path:
    """The path of a file.

    Raises:
        FileNotFoundError: there is none.
        TypeError: it is no path.
    """
    require_kind(name, path, (str, os.PathLike), "the path of a file")
    found = Path(path)
    if not found.is_file():
        raise FileNotFoundError(f"{name} must be that of a file, but there is none at {found}")
    return found


def writable(name: str, path: Any) -> Path:
    """The path of a file that may be written.

    Raises:
        FileNotFoundError: its folder does not exist.
        IsADirectoryError: it is that of a folder.
        TypeError: it is no path.
    """
    require_kind(name, path, (str, os.PathLike), "the path of a file")
    found = Path(path)
    if found.is_dir():
        raise IsADirectoryError(
            f"{name} must be that of a file, but {found} is a folder: give the name of a file in "
            f"it, such as {found / 'tube.reach'}"
        )
    if not found.parent.is_dir():
        raise FileNotFoundError(f"{name} must lie in a folder, but there is none at {found.parent}")
    return found
