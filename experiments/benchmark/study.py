"""What the command `python -m experiments.benchmark` does.

`steps`: one step of the double integrator with its input box and the paper's eight facets, for
networks with two hidden layers: some trained on the MPC and started from the paper's small initial
set, some with random weights and a set of the same size where most of their neurons switch.
`growth`: one facet of the paper's program as random networks grow. `loops`: six-step tubes of the
trained 2-10-5-1 network, and training steps. `rivals`: tubes of ever larger loops beside HiGHS's
mixed-integer programs, affine forms in plain numpy, and the paper's programs by cvxpy.
`decisions`: verdicts on six initial sets of a car, beside affine forms and samples. `limits`: every
entry point under a time limit, in a process where nothing is compiled yet. `smooth`: products,
noise, long horizons, many states, differential equations, training steps, beside what is asked of
each; an interrupted run continues with what is there. All methods run
one after the other, with one BLAS thread and one thread for Clarabel (XLA takes what cores there
are), so their ratios mean more than their seconds.
"""

import dataclasses
import os

import jax
import numpy as np
import rich

from experiments import report
from experiments.benchmark.cases import Settings, cases
from experiments.benchmark.growth import (
    GROWTH_NOTE,
    LEAST,
    exponent,
    grown,
    growth_table,
    in_new_process,
    jobs,
    related,
)
from experiments.benchmark.limits import (
    GRACE,
    LIMITS_NOTE,
    limit_rows,
    limits_table,
    too_long,
)
from experiments.benchmark.limits import (
    chosen as limited_calls,
)
from experiments.benchmark.loops import (
    LOOPS_NOTE,
    controller,
    step_rows,
    step_table,
    tube_rows,
    tube_table,
)
from experiments.benchmark.rivals.comparison import Run, rows, unsound
from experiments.benchmark.rivals.decision_table import DECISIONS_NOTE, decision_table
from experiments.benchmark.rivals.decisions import (
    contradictions,
    decision_rows,
    initial_sets,
    margins,
    totals,
)
from experiments.benchmark.rivals.methods import chosen
from experiments.benchmark.rivals.procedures import PROCEDURES
from experiments.benchmark.rivals.table import NOTE, table
from experiments.benchmark.rivals.tasks import tasks
from experiments.benchmark.smooth.run import (
    SMOOTH_NOTE,
    available,
    key_of,
    record,
    rows_of,
    smooth_table,
    stored,
)
from experiments.benchmark.steps import STEPS_NOTE, measured, methods, steps_table
from experiments.command import bar, require_folder

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS")


def steps(settings: Settings) -> None:
    """Every method on every network; each table is printed as soon as it is complete."""
    results, networks, named = [], cases(settings), methods(settings)
    with bar() as shown:
        task = shown.add_task("", total=len(networks) * len(named))
        for case in networks:
            shown.update(task, description=case.name)
            rows = []
            for row in measured(case, named, settings):
                rows.append(row)
                shown.advance(task)
            results += rows
            shown.console.print(steps_table(rows))
            write(settings, rows=results)
    rich.print(STEPS_NOTE)


def growth(settings: Settings) -> None:
    """Every solver on ever larger networks, each in a process of its own."""
    rows, todo = [], jobs(settings)
    with bar() as shown:
        task = shown.add_task("", total=len(todo))
        for width, name in todo:
            shown.update(task, description=f"2x{width}: {name}")
            rows = related([*rows, in_new_process(grown, width, name, settings)])
            shown.advance(task)
            write(settings, rows=rows)
    rich.print(growth_table(rows))
    rich.print(GROWTH_NOTE)
    if np.isfinite(slope := exponent(rows)):
        rich.print(f"InteriorPoint's seconds grow like n^{slope:.2f} from n = {LEAST} on")


def loops(settings: Settings) -> None:
    """Tubes and training steps of one trained network."""
    layers, tubes, trained = controller(settings), [], []
    with bar() as shown:
        task = shown.add_task("tubes", total=None)
        for row in tube_rows(layers, settings):
            tubes.append(row)
            shown.advance(task)
        shown.update(task, description="training steps")
        for row in step_rows(layers):
            trained.append(row)
            shown.advance(task)
    rich.print(tube_table(tubes))
    rich.print(LOOPS_NOTE)
    rich.print(step_table(trained))
    named = [{"solver": name} | dataclasses.asdict(cost) for name, cost in trained]
    write(settings, tubes=tubes, training=named)


def rivals(settings: Settings) -> None:
    """Every method on every loop, each in a process of its own.

    Raises:
        SystemExit: a certified bound is below a value that is attained.
    """
    results, todo = [], tasks(settings)
    methods = {name: chosen(task, settings) for name, task in todo.items()}
    with bar() as shown:
        progress = shown.add_task("", total=sum(map(len, methods.values())))
        for name, task in todo.items():
            runs = []
            for method in methods[name]:
                shown.update(progress, description=f"{name}: {method}")
                runs.append(Run.of(task, method, settings))
                shown.advance(progress)
            results += rows(name, task, runs, settings)
            write(settings, rows=results)
    rich.print(table(results))
    rich.print(NOTE)
    if wrong := unsound(results):
        raise SystemExit(f"error: bounds are below values that are attained: {', '.join(wrong)}")


def decisions(settings: Settings) -> None:
    """Every procedure on six initial sets of one loop, each procedure in a process of its own.

    Raises:
        SystemExit: what is proved is broken by a trajectory, or refuted.
    """
    results, sets = [], initial_sets()
    with bar() as shown:
        progress = shown.add_task("simulations", total=len(PROCEDURES))
        rooms = margins(sets, settings)
        for method in PROCEDURES:
            shown.update(progress, description=method)
            results += decision_rows(method, sets, rooms, settings)
            shown.advance(progress)
            write(settings, rows=results, totals=totals(results))
    rich.print(decision_table(results))
    rich.print(DECISIONS_NOTE)
    if wrong := contradictions(results):
        raise SystemExit(f"error: what is proved is broken: {', '.join(wrong)}")


def limits(settings: Settings) -> None:
    """Every entry point under a time limit, each in a process of its own.

    Raises:
        SystemExit: a call took longer than it may.
    """
    results: list[dict] = []
    with bar() as shown:
        progress = shown.add_task("", total=len(limited_calls(settings)))
        for row in limit_rows(settings):
            results.append(row)
            shown.update(progress, description=f"{row['loop']}: {row['call']}")
            shown.advance(progress)
            write(settings, rows=results)
    rich.print(limits_table(results))
    rich.print(LIMITS_NOTE)
    if late := [f"{row['loop']}: {row['call']}" for row in results if too_long(row)]:
        raise SystemExit(f"error: longer than {GRACE} times the limit: {', '.join(late)}")


def smooth(settings: Settings) -> None:
    """Smooth loops beside what is asked of them, each row in a process of its own.

    Rows of an earlier run of the same commit are taken from its file.
    """
    rows, missing = available(rows_of(settings), settings.folder)
    known = stored(settings.output / "smooth.json")
    results: list[dict] = []
    with bar() as shown:
        task = shown.add_task("", total=len(rows))
        for row in rows:
            shown.update(task, description=row.title)
            key = key_of(row, settings)
            known[key] = known[key] if key in known else record(row, settings)
            results.append(known[key])
            shown.advance(task)
            write(settings, rows=list(known.values()))
    if results:
        rich.print(smooth_table(results))
        rich.print(SMOOTH_NOTE)
    for words in missing:
        rich.print(words)


def write(settings: Settings, **results: list[dict]) -> None:
    """Settings, threads and every row of each table."""
    threads = {name: os.environ.get(name) for name in THREADS} | {"cores": os.cpu_count()}
    results |= {"compilations": jax.config.values["jax_compilation_cache_dir"]}
    path = settings.output / f"{settings.study}.json"
    report.write(path, settings, threads=threads, **results)


def main(settings: Settings) -> None:
    """One study: its tables are printed, and its rows written."""
    require_folder(settings.output)
    jax.config.update("jax_enable_x64", True)
    known = steps, growth, loops, rivals, decisions, limits, smooth
    {study.__name__: study for study in known}[settings.study](settings)
    rich.print(f"written: {settings.output / settings.study}.json")
