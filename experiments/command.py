"""What experiments share at the command line: how they run, their bars, tables and checks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

CONTINUES = "run again to continue with what is stored"


def run_experiment(
    main: Callable[[Any], None], settings: type, interrupted: str = CONTINUES
) -> None:
    """`main(settings)` as the command line has them; mistakes end it with one line."""
    try:
        main(tyro.cli(settings))
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
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(output / "jax_cache"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def bar(progress=True):
    """A bar that counts; silent without `progress`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), disable=not progress)


def blank_table(title: str, *headings: str) -> Table:
    """An empty table in the style of all experiments."""
    style = {"box": SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_style": "bold"}
    return Table(*headings, title=title, **style)


def at_least_one(**counts):
    """Raise a `ValueError` that names the first count below one."""
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
