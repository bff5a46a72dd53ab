"""The benchmark's tables and its file of results."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
from rich.table import Table

from experiments.benchmark_cases import Settings
from experiments.command import blank_table

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS")
NOTE = """\
n, mult: entries of the basis and multipliers that reach the solver
s/step: all 8 facets, median of warm calls;  first: compilation included
faster: seconds of the first row over this row's
diff: worst relative difference of bounds to the first row (same program)
slack: sum over facets of the bound less the sampled support
~ scaled up from fewer facets;  * first call, longer than --patience"""


def compare(rows: list[dict]) -> list[dict]:
    """The rows of one case, with what relates them to the first: ratio and difference."""
    base = rows[0]
    for row in rows:
        away = np.abs(row["bounds"] - base["bounds"]) / np.abs(base["bounds"])
        row["ratio"] = base["seconds"] / row["seconds"]
        row["difference"] = float(np.nanmax(away)) if row["same_program"] else None
    return rows


def table(rows: list[dict]) -> Table:
    """One case, a method a row."""
    title = f"{rows[0]['case']}, {rows[0]['clock']} seconds"
    shown = blank_table(title)
    shown.add_column("method", no_wrap=True)
    for heading in ("n", "mult", "s/step", "first", "faster", "diff", "slack"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        mark = ("~" if row["facets"] < len(row["bounds"]) else "") + "*" * (not row["calls"])
        shown.add_row(
            row["method"],
            *(str(row["n"]), str(row["multipliers"])),
            *(f"{mark}{row['seconds']:.3g}", f"{row['first']:.3g}", f"{row['ratio']:.3g}"),
            "-" if row["difference"] is None or row is rows[0] else f"{row['difference']:.0e}",
            "-" if np.isnan(row["slack"]) else f"{row['slack']:.4f}",
        )
    return shown


def write(settings: Settings, **results: list[dict]) -> Path:
    """Settings, threads and every row of each table, as JSON."""
    content = {
        "settings": dataclasses.asdict(settings) | {"output": str(settings.output)},
        "threads": {name: os.environ.get(name) for name in THREADS} | {"cores": os.cpu_count()},
    } | {name: [_plain(row) for row in rows] for name, rows in results.items()}
    path = settings.output / f"{settings.study}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))
    return path


def _plain(value):
    """JSON has no NaN: a facet that was not asked for is null."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(entry) for entry in value.tolist()]
    return None if isinstance(value, float) and np.isnan(value) else value
