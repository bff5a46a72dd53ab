"""Rows in processes of their own, kept in a file, and their table."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.table import Table

from experiments import report
from experiments.benchmark.cases import Settings
from experiments.benchmark.rivals.processes import Stopped, from_process
from experiments.benchmark.smooth import decisions, forms, sets, training, tubes
from experiments.benchmark.smooth.rows import MEMORY, Figures, Row, gigabytes, kept
from experiments.competition.study import version

ROWS: tuple[Row, ...] = (*forms.ROWS, *decisions.ROWS, *tubes.ROWS, *training.ROWS, *sets.ROWS)

MOST_MEMORY = 1.0
"""Gigabytes that are asked of every row that says nothing else of it."""

SMOOTH_NOTE = """\
asked: the most that a figure may be, or the word that it must be;  ! it is not
ms: of warm calls, median;  compilation: the first call less a warm one
GB: the most memory of the row's process, and of those that it gave cells to"""


def rows_of(settings: Settings, rows: Sequence[Row] = ROWS) -> list[Row]:
    """The rows that are asked for; all without any.

    Raises:
        ValueError: no row has one of these names.
    """
    names = list(dict.fromkeys(row.loop for row in rows))
    unknown = [name for name in settings.loops if name not in names]
    if unknown:
        raise ValueError(f"--loops must be some of {', '.join(names)}, but {unknown} arrived")
    return [row for row in rows if not settings.loops or row.loop in settings.loops]


def available(rows: Sequence[Row], folder: Path | None) -> tuple[list[Row], list[str]]:
    """The rows whose networks are there, and a word on each of the others."""
    there, missing = [], []
    for row in rows:
        try:
            row.files(folder)
        except FileNotFoundError as error:
            missing.append(f"{row.title} is left out: {error}")
        else:
            there.append(row)
    return there, missing


def key_of(row: Row, settings: Settings) -> str:
    """What figures depend on: question, networks, options, version."""
    options = settings.training_steps, settings.simulations, settings.repetitions, settings.clock
    found = hashlib.sha256(f"{row.title} {options} {version()}".encode())
    for path in row.files(settings.folder):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def measured(row: Row, settings: Settings) -> Iterator[Figures]:
    """Figures of a row, in a process in which nothing is compiled yet."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", None)
    told = set()
    for figures in row.measure(settings):
        told |= set(figures)
        yield figures
    if MEMORY not in told:
        yield {MEMORY: gigabytes()}


def record(row: Row, settings: Settings) -> dict[str, Any]:
    """What is found of a row, whatever becomes of its process."""
    found: Figures = {}
    told: dict[str, Any] = {"loop": row.loop, "row": row.name, "asked": dict(row.asked)}
    told |= {"found": found, "key": key_of(row, settings), "commit": version()}
    try:
        for figures in from_process(measured, row, settings, patience=row.patience):
            found |= figures
    except Stopped as stopped:
        told["stopped"] = str(stopped)
    return told


def stored(path: Path) -> dict[str, dict[str, Any]]:
    """Records of earlier runs by their keys, but those of processes that were stopped."""
    try:
        records = json.loads(path.read_text())["rows"]
    except (OSError, ValueError, KeyError):
        return {}
    return {each["key"]: each for each in records if "stopped" not in each}


def smooth_table(records: Sequence[dict[str, Any]]) -> Table:
    """A figure a line: what is asked, and beside it what is found."""
    shown, before = [], ("", "")
    for each in records:
        asked, found = {MEMORY: MOST_MEMORY} | each["asked"], each["found"]
        names = [name for name in each["asked"] if name != MEMORY] + [MEMORY]
        names += [name for name in found if name not in names]
        for name in names:
            group = each["loop"], each["row"]
            loop = "" if group[0] == before[0] else group[0]
            row = "" if group == before else group[1]
            wanted, value = asked.get(name), found.get(name)
            missed = kept(wanted, value) is False or (value is None and "stopped" in each)
            shown.append((loop, row, name, _asked(wanted), _figure(value), "!" * missed))
            before = group
    headings = ("asked", "found", "")
    return report.table("smooth loops", ("loop", "row", "figure"), headings, shown)


def _asked(wanted: float | str | None) -> str:
    if wanted is None:
        return ""
    return wanted if isinstance(wanted, str) else f"<= {wanted:.3g}"


def _figure(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.3g}"
