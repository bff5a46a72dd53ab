"""The command `python -m reachjax recheck FILE`: a tube or a verdict is proved anew.

Nothing is searched, and of the file nothing is believed but what it is about. Of a loop with a
function that a user wrote a file has no more than a seal: `--loop` says where it is.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Any

import jax


def _loop(name: str) -> Any:
    """What a module calls so, or what its function of that name gives."""
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split(".") if path else ():
        found = getattr(found, part)
    return found() if callable(found) else found


def main(arguments: Sequence[str] | None = None) -> int:
    """Recheck a file, and say what is proved; 0 if it is what the file says."""
    parser = argparse.ArgumentParser(prog="python -m reachjax", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    recheck = commands.add_parser("recheck", help="prove a tube or a verdict anew")
    recheck.add_argument("file", help="that save(...) wrote")
    recheck.add_argument("--loop", metavar="MODULE:NAME", help="a loop, or what makes it")
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    from reachjax.verdicts.loading import load

    try:
        loop = _loop(given.loop) if given.loop else None
        found = load(given.file, loop, recheck=True)
    except (OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    print(found)  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
