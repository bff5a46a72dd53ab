"""Seconds of one Reach-SDP step, and the bounds they buy, method by method in one run.

One step of the double integrator with its input box and the paper's eight facets, for networks
with two hidden layers: some trained on the MPC and started from the paper's small initial set, some
with random weights and a set of the same size where most of their neurons switch. All methods run
one after the other in this process, with one BLAS thread and one thread for Clarabel, so their
ratios mean more than their seconds.

    python -m experiments.benchmark --help
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")  # Clarabel's

import jax
import rich

from experiments.benchmark_cases import Settings, cases
from experiments.benchmark_methods import measure, methods
from experiments.benchmark_report import NOTE, compare, table, write
from experiments.command import bar, require_folder, run_experiment


def main(settings: Settings) -> None:
    """Measure every method on every network; each table is printed as soon as it is complete."""
    require_folder(settings.output)
    jax.config.update("jax_enable_x64", True)
    results, networks, named = [], cases(settings), methods(settings)
    with bar() as shown:
        task = shown.add_task("", total=len(networks) * len(named))
        for case in networks:
            rows = []
            for name, method in named.items():
                shown.update(task, description=f"{case.name}: {name}")
                rows.append(measure(case, name, method, settings))
                shown.advance(task)
            results.append(compare(rows))
            shown.console.print(table(results[-1]))
            write(settings, results)
    rich.print(NOTE)
    rich.print(f"written: {write(settings, results)}")


if __name__ == "__main__":
    run_experiment(main, Settings)
