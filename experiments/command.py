"""What experiments share at the command line: how they run, their options and their bars."""

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from reachjax import keep_compilations

CONTINUES = "run again to continue with what is stored"


def run_experiment(
    main: Callable[[Any], None], settings: type, interrupted: str = CONTINUES
) -> None:
    """`main(settings)` as the command line has them; mistakes end it with one line."""
    spec = sys.modules["__main__"].__spec__
    command = spec and f"python -m {spec.name.removesuffix('.__main__')}"
    try:
        main(tyro.cli(settings, prog=command))
    except (ValueError, OSError, ImportError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit(f"interrupted: {interrupted}") from None


def require_folder(output: Path) -> None:
    """Make the folder of results, or raise a `ValueError` that says why it cannot be one."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--output must be a folder, but {output} arrived: {error}") from None


def configure_jax(output: Path) -> None:
    """64-bit floats, and a compilation cache in the folder of results unless there is one."""
    require_folder(output)
    jax.config.update("jax_enable_x64", True)
    if jax.config.values["jax_compilation_cache_dir"] is None:
        keep_compilations(output / "jax_cache")


def bar(progress=True):
    """A bar that counts; silent without `progress`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), disable=not progress)


def at_least_one(**counts):
    """Raise a `ValueError` that names the first count below one."""
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def require_options(settings: Any, *positive: str, **least: float) -> None:
    """Check options, each a number, or numbers of which each counts; None is none to check.

    Args:
        settings: the options.
        positive: names of those that must be above 0.
        least: the least values of others.

    Raises:
        ValueError: one is not that large, not finite, or there is none of several.

    Example:
        >>> from types import SimpleNamespace
        >>> require_options(SimpleNamespace(hidden=(10, 0)), hidden=1)
        Traceback (most recent call last):
            ...
        ValueError: --hidden must be finite and at least 1, but (10, 0) arrived
    """
    for name in (*positive, *least):
        value = getattr(settings, name)
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        smallest = least.get(name, 0)
        enough = all(smallest <= each < math.inf for each in values)
        if value == () or not enough or (name in positive and 0 in values):
            wanted = "above 0" if name in positive else f"at least {smallest:g}"
            option = f"--{name.replace('_', '-')}"
            raise ValueError(f"{option} must be finite and {wanted}, but {value} arrived")
