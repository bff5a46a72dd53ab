"""The command."""

from experiments.command import run_experiment
from experiments.double_integrator.study import Settings, main

if __name__ == "__main__":
    run_experiment(main, Settings)
