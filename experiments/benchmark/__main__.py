"""The command."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")  # Clarabel's

from experiments.benchmark.cases import Settings
from experiments.benchmark.study import main
from experiments.command import run_experiment

if __name__ == "__main__":
    # ratios are of one run: an interrupted one is not continued
    run_experiment(main, Settings, "rows so far are in the folder of results")
