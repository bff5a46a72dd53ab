"""The command."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one network after the other, on few cores

from experiments.certified_training.study import Settings, main
from experiments.command import run_experiment

if __name__ == "__main__":
    run_experiment(main, Settings)
