"""A generator that is run in a process of its own, and ended when it takes too long."""

import multiprocessing
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from multiprocessing.connection import Connection
from typing import Any

import jax


class Stopped(Exception):  # noqa: N818
    """A process took too long, or ended by itself before it was done."""


class TookTooLong(Stopped):
    """A process was ended, as it had taken too long."""


def from_process(
    function: Callable[..., Iterator[Any]], *arguments: Any, patience: float
) -> Iterator[Any]:
    """What a generator yields in a new process; imports and arguments there take no patience.

    Args:
        function: of a module's top level.
        arguments: what can be pickled; arrays keep their 64 bits.
        patience: seconds between two results, after which the process is ended.

    Raises:
        TookTooLong: it was.
        Stopped: it failed; what it yielded until then has arrived.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    packed = pickle.dumps((function, arguments))
    process = context.Process(target=_run, args=(theirs, packed))
    process.start()
    theirs.close()
    try:
        waiting = None  # until all is there
        while ours.poll(waiting):
            more, result = ours.recv()
            if not more:
                return
            if waiting is not None:
                yield result
            waiting = patience
    except EOFError:
        process.join()
        raise Stopped(f"it ended with exit code {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
    raise TookTooLong(f"it took more than {patience} seconds")


def workers(count: int) -> AbstractContextManager[ProcessPoolExecutor | None]:
    """So many processes for cells, each begun once it is needed; none for one.

    They end with this one.
    """
    if count == 1:
        return nullcontext()
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """Watch the process that began this one, which may be killed."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _run(connection: Connection, packed: bytes) -> None:
    """Send all that a generator yields, after a first word."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())  # where HiGHS writes what it thinks
    jax.config.update("jax_enable_x64", True)  # before there are arrays
    function, arguments = pickle.loads(packed)
    connection.send((True, None))
    for result in function(*arguments):
        connection.send((True, result))
    connection.send((False, None))
