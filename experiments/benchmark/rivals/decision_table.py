"""The table of decisions: initial sets one below the other, a procedure a row."""

from typing import Any

import numpy as np
from rich.table import Table

from experiments import report
from experiments.benchmark.rivals.decisions import totals
from experiments.benchmark.rivals.table import blocks
from experiments.benchmark.timing import cells

DECISIONS_NOTE = """\
lead: how much farther ahead;  margin: the least room that trajectories leave
first: all sets in one process, compilation included unless JAX has a cache
warm: median of later calls;  programs: linear ones, of the proofs of decide
numpy: affine forms, rounding ignored; they refute nothing
samples: simulations alone; they prove nothing
- not told, or ended by --patience (!);  * no warm call"""


def decision_table(rows: list[dict[str, Any]]) -> Table:
    """All sets, and at last the totals of each procedure."""
    names = list(dict.fromkeys(row["set"] for row in rows))
    ordered = sorted(rows, key=lambda row: names.index(row["set"]))
    shown = blocks(ordered, "set", _words, _cells)
    summed = [{"set": f"all {len(names)}"} | row for row in totals(rows)]
    shown += blocks(summed, "set", lambda row: [row["set"]], _total_cells)
    title = f"is the distance kept? verdicts and {rows[0]['clock']} seconds"
    left, right = ("lead", "method", "verdict"), ("first", "warm", "programs")
    return report.table(title, left, right, shown[:-1])


def _words(row: dict[str, Any]) -> list[str]:
    """What is said of a set, line by line."""
    return [row["set"], f"margin {row['margin']:.3g}"]


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a procedure on a set."""
    verdict = row["verdict"]
    return _line(row, "-" if verdict is None else report.coloured(verdict, verdict.lower()))


def _total_cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a procedure on all sets."""
    return _line(row, f"{row['proved'] + row['refuted']} of {row['sets']}")


def _line(row: dict[str, Any], verdict: str) -> tuple[str, ...]:
    """Cells after the first column."""
    warm, first = ("-", "-") if np.isnan(row["first"]) else cells(row)
    programs = "-" if row["programs"] is None else str(row["programs"])
    return row["method"] + " !" * bool(row["problem"]), verdict, first, warm, programs
