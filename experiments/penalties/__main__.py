"""The command."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read by processes that run side by side

from experiments.command import run_experiment
from experiments.penalties.study import Settings, main

if __name__ == "__main__":
    run_experiment(main, Settings)
