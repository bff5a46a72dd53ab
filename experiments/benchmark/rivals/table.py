"""The table of rivals: loops one below the other, a method a row."""

from collections.abc import Callable
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from rich.table import Table

from experiments import report
from experiments.benchmark.timing import cells

NOTE = """\
first: in a process of its own, compilation included unless JAX has a cache
warm: median of later calls;  /HiGHS: warm seconds over its own
done: facets of all steps that are bounded; for reach and HiGHS, to 1e-4
size: last set over the largest values that trajectories or HiGHS attain, in
area or in the worst width;  gap: median of bound less such a value, as a part
of the facet's range
> ended by then: --patience;  * no warm call;  < HiGHS was not done;  ! failed"""


def table(rows: list[dict[str, Any]]) -> Table:
    """All loops."""
    shown = blocks(rows, "loop", _words, _cells)
    headings = ("first", "warm", "/HiGHS", "done", "size", "gap")
    title = f"tubes of the library and its rivals, {rows[0]['clock']} seconds"
    return report.table(title, ("loop", "method"), headings, shown[:-1])


def blocks(
    rows: list[dict[str, Any]],
    by: str,
    words: Callable[[dict[str, Any]], list[str]],
    line: Callable[[dict[str, Any]], tuple[str, ...]],
) -> list[tuple[str, ...]]:
    """Lines of a table, a block for each group of rows and an empty line after it.

    Args:
        rows: those of a group one after the other.
        by: the key whose value a group shares.
        words: what the first column says of a group, line by line.
        line: cells of a row, in the columns after it.
    """
    shown = []
    for _, group in groupby(rows, itemgetter(by)):
        members = list(group)
        said, lines = words(members[0]), [line(row) for row in members]
        said += [""] * (len(lines) - len(said))
        lines += [("",) * len(lines[0])] * (len(said) - len(lines))
        shown += [(word, *rest) for word, rest in zip(said, lines, strict=True)]
        shown.append(("",) * len(shown[-1]))
    return shown


def _words(row: dict[str, Any]) -> list[str]:
    """What is said of a loop, line by line."""
    steps = f"{row['horizon']} step{'s' * (row['horizon'] > 1)}"
    words = [row["loop"], steps, f"{row['facets']} facets"]
    return [*words, f"margin {row['margin']:.3g}"] if np.isfinite(row["margin"]) else words


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a method."""
    warm, first = cells(row)
    if not row["finished"]:
        first = f">{first}"
        warm = f">{warm}" if row["calls"] else "-"
    failed = bool(row["problem"]) and "exit code" in row["problem"]
    size, gap = (
        "-" if np.isnan(row[name]) else format(row[name], digits)
        for name, digits in (("size", ".3f"), ("gap", ".0e"))
    )
    return (
        row["method"] + " !" * failed,
        first,
        warm,
        row["ratio"],
        f"{row['done']:.0%}",
        size,
        gap,
    )
