"""The commands of experiments, as processes of their own, which no test has set up."""

import subprocess
import sys

LOOK = """
import importlib, pkgutil
import jax
import experiments

for found in pkgutil.walk_packages(experiments.__path__, "experiments."):
    if not found.name.endswith("__main__"):
        module = importlib.import_module(found.name)
        for name, value in vars(module).items():
            for leaf in jax.tree.leaves(value):
                if getattr(leaf, "dtype", None) == "float32":
                    print(found.name, name)
"""


def test_no_numbers_are_made_before_a_command_asks_for_64_bits():
    done = subprocess.run([sys.executable, "-c", LOOK], capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_policies_that_choose_are_trained_bounded_and_drawn(tmp_path):
    quick = ["--rounds", "20", "--samples", "200", "--time-limit", "1", "--output", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "experiments.nonlinear.actions", *quick], check=True)
    assert (tmp_path / "actions.png").stat().st_size > 10_000
