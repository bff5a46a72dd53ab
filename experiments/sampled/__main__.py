"""The command."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

from experiments.command import run_experiment
from experiments.sampled.study import Settings, main

if __name__ == "__main__":
    run_experiment(main, Settings)
