"""The command `python -m reachjax recheck FILE`: a tube or a verdict is proved anew.

Nothing is searched, and of the file nothing is believed but what it is about. Of a loop with a
function that a user wrote a file has no more than a seal: `--loop` says where it is. The cells of
a verdict are proved by as many processes as `--processes` says.
"""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import jax


def _loop(name: str) -> Any:
    """What a module calls so, or what its function of that name gives.

    Raises:
        ValueError: it is no name of a module and one in it.
    """
    module, _, path = name.partition(":")
    if not module or not path:
        raise ValueError(
            f"--loop must be MODULE:NAME, such as plants:make_loop, but {name} arrived"
        )
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found() if callable(found) else found


def _count(word: str) -> int:
    """A number of processes.

    Raises:
        ArgumentTypeError: it is none.
    """
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 on, but {word} arrived")
    return int(word)


def _workers(count: int) -> AbstractContextManager[ProcessPoolExecutor | None]:
    """An executor of new processes, as JAX's threads cannot be forked; none for one."""
    if count == 1:
        return nullcontext()
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Recheck a file, and say what is proved; 0 if it is what the file says."""
    parser = argparse.ArgumentParser(prog="python -m reachjax", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    recheck = commands.add_parser("recheck", help="prove a tube or a verdict anew")
    recheck.add_argument("file", help="that save(...) wrote")
    recheck.add_argument("--loop", metavar="MODULE:NAME", help="a loop, or what makes it")
    recheck.add_argument(
        "--processes",
        metavar="N",
        type=_count,
        default=1,
        help="that prove the cells of a verdict, at least 1 (default: %(default)s)",
    )
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    from reachjax.verdicts.loading import load

    try:
        loop = _loop(given.loop) if given.loop else None
        with _workers(given.processes) as executor:
            found = load(given.file, loop, recheck=True, executor=executor)
    except (OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    print(f"{given.file}, rechecked from what it is about alone:\n{found}")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
