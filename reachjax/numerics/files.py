"""Paths that users pass in."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from reachjax.numerics.checks import require_kind


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
