"""The field's yearly competition (ARCH-COMP AINNCS), decided in one command.

    python -m experiments.competition PATH  # a clone of the public benchmark repository

Each instance is decided in a process of its own, in which nothing is compiled yet, with a time
limit: at all times, in between samples too, rounding accounted for, by the same options for all.
The verdict is kept in a file, and proved anew from it in another process, which searches nothing;
a counterexample is kept as numbers that anybody can check. Without `PATH` networks of the same
shapes are trained here.
"""

import csv
import dataclasses
import hashlib
import json
import multiprocessing
import os
import platform
import resource
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import rich
import tyro
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.benchmark.rivals.processes import Stopped, TookTooLong, from_process, workers
from experiments.command import bar, configure_jax, require_options
from experiments.competition import figures
from experiments.competition.instances import Instance, instances
from experiments.competition.networks import networks

WORDS = {"PROVED": "verified", "REFUTED": "falsified", "UNKNOWN": "unknown"}
"""What the competition's evaluation platform calls verdicts."""

AGAIN = 60.0
"""A call that took longer, in seconds, is not made again."""

DRAWING = 120.0
"""Seconds that sets may take of which figures are drawn and widths measured."""

NOTE = """\
first: wall seconds of `decide` in a new process, where nothing is compiled, reading apart
warm: of one more call;  recheck: of proving the verdict's file anew in another process
margin: the least certified one, or by how much a trajectory breaks the requirement
width: at the end, of affine forms over the cells of the proof, over that of sampled states
GB: the most memory that the process took, and those that it gave cells to"""


@dataclass(frozen=True)
class Settings:
    """Decide every instance of the competition whose networks are there, all by the same options.

    Results are kept under `output`; an interrupted run continues with what is there.
    """

    path: tyro.conf.Positional[Path | None] = None
    """A clone of the public benchmark repository; none to train networks of the same shapes."""
    only: tuple[str, ...] = ()
    """Instances whose titles contain one of these, with hyphens or spaces; all without any."""
    limit: float = 120.0
    """Seconds that a decision may take."""
    processes: int = dataclasses.field(default_factory=lambda: os.cpu_count() or 1)
    """That cells are decided in, where one cell is not enough; 1 for none besides."""
    simulations: int = 1000
    """Trajectories that are drawn, and that widths are compared with."""
    training_steps: int = 2000
    """Steps of Adam, where networks are trained."""
    output: Path = Path("results/competition")
    """Where everything is written."""

    def __post_init__(self):
        require_options(self, "limit", processes=1, simulations=1, training_steps=1)
        if self.path is not None and not self.path.is_dir():
            raise ValueError(f"PATH must be a folder, but {self.path} arrived")
        for word in self.only:
            if not any(is_named(title, word) for title in instances()):
                raise ValueError(
                    f"--only must name some of {', '.join(instances())}, but {word} arrived (PATH "
                    "comes before the options)"
                )

    @property
    def chosen(self) -> list[Instance]:
        """The instances that are asked for."""
        every = instances().items()
        return [
            instance
            for title, instance in every
            if not self.only or any(is_named(title, word) for word in self.only)
        ]


def is_named(title: str, word: str) -> bool:
    """Whether a word of `--only` names an instance.

    Example:
        >>> is_named("single-pendulum-reach", "Single Pendulum")
        True
    """
    return word.lower().replace(" ", "-") in title


def loop_of(title: str, settings: Settings) -> rj.ClosedLoop:
    """The loop of an instance."""
    instance = instances()[title]
    given = settings.path, settings.training_steps, settings.output / "networks"
    return instance.loop(networks(instance, *given))


def decided(title: str, settings: Settings) -> Iterator[dict]:
    """What is found of an instance, in a process in which nothing is compiled yet."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", None)
    instance, loop = instances()[title], loop_of(title, settings)
    yield {}
    with workers(settings.processes) as executor:
        yield from _decided(instance, loop, executor, settings)


def _decided(
    instance: Instance, loop: rj.ClosedLoop, executor: Executor | None, settings: Settings
) -> Iterator[dict]:
    title, given = instance.title, (loop, instance.X0, instance.horizon)
    options: dict[str, Any] = {**instance.required, "time_limit": settings.limit}
    options |= {"executor": executor}
    began = time.perf_counter()
    verdict = rj.decide(*given, **options)
    first = time.perf_counter() - began
    found = {"verdict": verdict.status.name, "first": first, "cells": max(len(verdict.cells), 1)}
    found |= {"margin": least(verdict), "peak": peak()}
    yield found
    folder = settings.output / "verdicts"
    folder.mkdir(parents=True, exist_ok=True)
    if not verdict.unknown and verdict.asked is not None:
        verdict.save(folder / f"{title}.verdict")
    if verdict.counterexample is not None:
        verdict.counterexample.save(folder / f"{title}.json")
    if first < AGAIN:
        began = time.perf_counter()
        rj.decide(*given, **options)
        yield {"warm": time.perf_counter() - began}
    yield {"width": width(instance, loop, verdict, settings)}


def rechecked(title: str, settings: Settings) -> Iterator[dict]:
    """The seconds in which a verdict's file is proved anew, in a new process and its workers."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", None)
    loop = loop_of(title, settings)
    yield {}
    path, began = settings.output / "verdicts" / f"{title}.verdict", time.perf_counter()
    with workers(settings.processes) as executor:
        rj.load(path, loop, recheck=True, executor=executor)
        yield {"recheck": time.perf_counter() - began}


def least(verdict: rj.Verdict) -> float:
    """The least certified margin; of a refuted specification, less what it is broken by."""
    if verdict.counterexample is not None:
        return -verdict.counterexample.violation
    known = [row[~np.isnan(row)] for row in verdict.margins.values()]
    return float(np.concatenate(known).min())


def peak() -> float:
    """Gigabytes that this process took at most, and those that it began, where Linux tells."""
    found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for process in multiprocessing.active_children():
        with suppress(OSError), open(f"/proc/{process.pid}/status") as told:
            found += sum(int(line.split()[1]) for line in told if line.startswith("VmHWM"))
    return found / 2**20


def width(
    instance: Instance, loop: rj.ClosedLoop, verdict: rj.Verdict, settings: Settings
) -> float | None:
    """How much wider forms over the cells are at the end than sampled states; a figure too.

    None where they have no bounds at the end.
    """
    states = instance.X0.sample(jax.random.key(0), settings.simulations)
    states = np.concatenate([corners(instance.X0), np.asarray(states)])
    runs = np.asarray(loop.simulate(states, instance.horizon))
    tubes = tubes_of(instance, loop, verdict, settings)
    plant: Any = loop.plant
    period = float(plant.period) if plant.continuous else None
    path = settings.output / f"{instance.title}.png"
    figures.draw(instance, period, runs, tubes, verdict, path)
    if not tubes or min(tube.horizon for tube in tubes) < instance.horizon:
        return None
    last = [tube.sets[-1].bounding_box() for tube in tubes]
    lower, upper = np.min([box.lower for box in last], 0), np.max([box.upper for box in last], 0)
    certified, seen = upper - lower, np.ptp(runs[:, -1], axis=0)
    moves = seen > 1e-9 * max(seen.max(), 1e-300)
    return float((certified[moves] / seen[moves]).max()) if moves.any() else None


def tubes_of(
    instance: Instance, loop: rj.ClosedLoop, verdict: rj.Verdict, settings: Settings
) -> list[rj.ReachTube]:
    """Boxes at samples by forms, from each cell that a proof takes, else from the whole set.

    Nothing where forms have no bounds, or take longer than `DRAWING`, or than a decision may.
    """
    cells = [rj.Box(cell.lower, cell.upper) for cell in verdict.cells if verdict.proved]
    template, until = rj.Template.box(loop.states), time.monotonic() + min(settings.limit, DRAWING)
    found = []
    for X0 in cells or [instance.X0]:
        left = until - time.monotonic()
        if left <= 0:
            return []
        given = loop, X0, instance.horizon, template, rj.LinearBounds()
        try:
            found.append(rj.reach(*given, time_limit=left))
        except (ValueError, RuntimeError):
            return []
    return found


def corners(box: rj.Box) -> np.ndarray:
    """Corners of a box, of as many coordinates as are not flat, at most ten."""
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    free = np.flatnonzero(upper > lower)[:10]
    found = np.tile(lower, (2 ** len(free), 1))
    for number, row in enumerate(found):
        up = free[[bool(number >> k & 1) for k in range(len(free))]]
        row[up] = upper[up]
    return found


def row_of(instance: Instance, settings: Settings) -> dict:
    """What is found of an instance, whatever becomes of its processes."""
    title = instance.title
    row: dict[str, Any] = {"title": title, "benchmark": instance.benchmark, "name": instance.name}
    row |= {"verdict": "UNKNOWN", "limit": settings.limit, "note": instance.note}
    row |= {"path": settings.path and settings.path.resolve()}
    row |= {"training_steps": settings.training_steps}
    patience = 1.3 * settings.limit + AGAIN
    (settings.output / "verdicts" / f"{title}.verdict").unlink(missing_ok=True)
    try:
        for found in from_process(decided, title, settings, patience=patience):
            row |= found
    except Stopped as stopped:
        row["stopped"], row["failed"] = str(stopped), not isinstance(stopped, TookTooLong)
    if (settings.output / "verdicts" / f"{title}.verdict").exists():
        try:
            for found in from_process(rechecked, title, settings, patience=patience):
                row |= found
        except Stopped as stopped:
            row["recheck_stopped"] = str(stopped)
    return row


def key_of(instance: Instance, settings: Settings) -> str:
    """What a row depends on: networks, limit and version."""
    found = hashlib.sha256(
        f"{settings.limit} {settings.processes} {settings.training_steps} {version()}".encode()
    )
    for path in instance.paths(settings.path) if settings.path is not None else []:
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def version() -> str:
    """The commit, or the release where there is none."""
    try:
        command = ["git", "rev-parse", "--short", "HEAD"]
        folder = Path(__file__).parent
        return subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return rj.__version__


def table(rows: list[dict]) -> Table:
    """An instance a row."""
    names = ("first", "warm", "recheck", "margin", "cells", "width", "peak")
    shown = [
        (
            f"{row['benchmark']} {row['name']}",
            report.coloured(row["verdict"]),
            *(_shown(name, row.get(name)) for name in names),
        )
        for row in rows
    ]
    headings = ("first", "warm", "recheck", "margin", "cells", "width", "GB")
    title = "ARCH-COMP AINNCS, seconds"
    if any(row["path"] is None for row in rows):
        title += ", networks trained here"
    return report.table(title, ("instance", "verdict"), headings, shown)


def _shown(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if name == "cells":
        return f"{value}"
    return f"{value:.3g}" if name == "margin" or value >= 1000 else f"{value:.2f}"


def write_markdown(rows: list[dict], path: Path) -> None:
    """The table for the docs, with the machine, the date and the commit."""
    names = ("first", "warm", "recheck", "margin", "cells", "width", "peak")
    head = ("benchmark", "instance", "verdict", *names[:-1], "GB")
    lines = [" | ".join(head), " | ".join(["---"] * 3 + ["---:"] * len(names))]
    for row in rows:
        numbers = (_shown(name, row.get(name)) for name in names)
        lines.append(" | ".join((row["benchmark"], row["name"], row["verdict"], *numbers)))
    on = machine()
    commits = ", ".join(dict.fromkeys(row["commit"] for row in rows))
    told = f"{on['date']}, commit {commits}, {on['cores']} cores ({on['machine']}), no GPU."
    path.write_text("\n".join(f"| {line} |" for line in lines) + f"\n\n{told}\n")


def write_csv(rows: list[dict], path: Path) -> None:
    """An instance a line, as the evaluation platform takes them: result, and its seconds."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["benchmark", "instance", "result", "time"])
        for row in rows:
            seconds = row.get("first", row["limit"])
            out.writerow([row["benchmark"], row["name"], WORDS[row["verdict"]], f"{seconds:.2f}"])


def main(settings: Settings) -> None:
    """Decide, print, and write the table, figures, verdicts and counterexamples."""
    configure_jax(settings.output)
    path = settings.output / "results.json"
    known = {row["title"]: row for row in stored(path)}
    rows, missing = [], []
    with bar() as shown:
        task = shown.add_task("", total=len(settings.chosen))
        for instance in settings.chosen:
            shown.update(task, description=instance.title)
            try:
                key = key_of(instance, settings)
            except FileNotFoundError:
                missing.append(instance.title)
            else:
                row = known.get(instance.title, {})
                if row.get("key") != key:
                    row = row_of(instance, settings) | {"commit": version()}
                    row |= {} if row.get("failed") else {"key": key}  # what failed is tried again
                rows.append(row)
                known[instance.title] = row
                report.write(path, settings, machine=machine(), rows=list(known.values()))
            shown.advance(task)
    if not rows:
        raise ValueError(
            f"PATH must be a clone of the benchmark repository, but {settings.path} has no "
            f"network of {', '.join(missing)}"
        )
    rich.print(table(rows))
    rich.print(NOTE)
    for row in rows:
        if "stopped" in row:
            rich.print(f"{row['title']}: {row['stopped']}")
    every = [known[title] for title in instances() if title in known]
    write_csv(every, settings.output / "results.csv")
    write_markdown(every, settings.output / "results.md")
    if missing:
        rich.print(f"without networks in {settings.path}: {', '.join(missing)}")
    rich.print(f"written: results.csv, results.json, figures, verdicts under {settings.output}")


def machine() -> dict[str, Any]:
    """What it ran on, and when."""
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "date": time.strftime("%Y-%m-%d"),
    }


def stored(path: Path) -> list[dict]:
    """The rows of a file of results; none where there is no such file."""
    try:
        return json.loads(path.read_text())["rows"]
    except (OSError, ValueError, KeyError):
        return []
