"""Arrays kept in a file together with the settings that made them.

A file is used again when the settings agree, and made anew, with a word about it, when they do not.
"""

import json
import os
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import rich


def settings_of(path):
    """The settings that made a file, None where it cannot be read."""
    try:
        with np.load(path) as file:
            return json.loads(str(file["settings"]))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def load(path, settings):
    """The arrays at `path` if `settings` made them, else None."""
    if path is None or not Path(path).exists():
        return None
    try:
        with np.load(path) as file:
            arrays = dict(file)
        found = json.loads(str(arrays.pop("settings")))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        rich.print(f"{path} cannot be read ({type(error).__name__}): making it anew")
        return None
    if found == settings:
        return arrays
    changed = [name for name in settings | found if settings.get(name) != found.get(name)]
    rich.print(f"{path} was made with other settings ({', '.join(changed)}): making it anew")
    return None


def save(path, settings, **arrays):
    """Write `path` whole or not at all: an interruption leaves the file that was there."""
    if path is None:
        return
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(f"{path}.unfinished")
    with unfinished.open("wb") as file:
        np.savez(file, settings=json.dumps(settings), **arrays)
    os.replace(unfinished, path)
