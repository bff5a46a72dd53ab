"""Compilations outlive a process, and go on beside those who do without them."""

import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from conftest import QUICKER, accepted
from reachjax.numerics.compilations import CompiledBeside

RUN = """
import sys
import jax, jax.numpy as jnp
import reachjax as rj
jax.block_until_ready(jnp.sin(jnp.ones(3)))  # compiled before there is a cache
folder = rj.keep_compilations(*sys.argv[1:])
before = set(folder.iterdir())
jax.block_until_ready(jax.jit(lambda x: jnp.cos(x) + 2)(jnp.ones(5)))
print(folder, len([each for each in set(folder.iterdir()) - before if "atime" not in each.name]))
"""


def run(environment, *arguments):
    command = [sys.executable, "-c", RUN, *map(str, arguments)]
    found = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    folder, kept = found.stdout.split()
    return folder, int(kept)


@pytest.fixture
def environment(tmp_path):
    kept = {"PATH", "PYTHONPATH", "HOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH"}
    own = {"XDG_CACHE_HOME": str(tmp_path / "caches"), "JAX_PLATFORMS": "cpu"}
    return {name: value for name, value in os.environ.items() if name in kept} | own


@pytest.mark.costly
def test_a_second_process_compiles_nothing(environment, tmp_path):
    folder = tmp_path / "given"
    first, kept = run(environment, folder)
    assert first == str(folder)
    assert kept > 0
    assert run(environment, folder) == (str(folder), 0)


@pytest.mark.costly
def test_compilations_are_in_the_users_cache_or_where_they_are_kept_already(environment, tmp_path):
    assert run(environment)[0] == str(tmp_path / "caches" / "reachjax")
    there = str(tmp_path / "there")
    assert run(environment | {"JAX_COMPILATION_CACHE_DIR": there})[0] == there


def test_bad_folders_are_named(tmp_path):
    kept = jax.config.values["jax_compilation_cache_dir"]
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ValueError, match="folder must be one that can be written to"):
        rj.keep_compilations(file / "folder")
    with pytest.raises(TypeError, match="folder must be a path, but 3 arrived"):
        rj.keep_compilations(3)  # pyright: ignore[reportArgumentType]
    assert jax.config.values["jax_compilation_cache_dir"] == kept


def beside(size):
    """A function that is compiled beside its callers, and what they give it."""
    return CompiledBeside(jax.jit(lambda x, by: by * x, static_argnames="by")), jnp.ones(size)


def test_what_is_cheap_to_compile_is_there_at_once():
    found, x = beside(3)
    given = {"seconds": lambda: 1e-3, "evaluations": 1000, "left": np.inf}
    assert found.pays(x, by=2.0, **given)
    assert found(x, by=2.0).tolist() == [2.0, 2.0, 2.0]


def test_what_takes_longer_than_is_left_is_not_compiled():
    found, x = beside(4)
    given = {"seconds": lambda: 1e-3, "evaluations": 1, "left": 2.0}  # three seconds
    assert not any(found.pays(x, by=2.0, **given) for _ in range(10_000))


def test_what_is_dear_is_compiled_once_as_much_was_spent():
    found, x = beside(5)
    given = {"seconds": lambda: 1.0, "evaluations": 100, "left": np.inf}  # thirty seconds
    asked = [found.pays(x, by=2.0, **given) for _ in range(10)]
    assert not any(asked)
    for _ in range(1000):
        if found.pays(x, by=2.0, **given):
            break
        time.sleep(0.05)
    else:
        pytest.fail("it was not compiled after thirty seconds had been spent")


def test_what_takes_no_longer_than_one_call_in_numpy_is_compiled_at_once():
    found, x = beside(8)
    given = {"seconds": lambda: 20.0, "evaluations": 3000, "left": np.inf}
    assert not found.pays(x, by=2.0, share=0.9, **given)  # eighteen seconds of twenty
    for _ in range(1000):
        if found.pays(x, by=2.0, **given):
            return
        time.sleep(0.05)
    pytest.fail("it was not compiled, though a call takes as long")


@pytest.mark.parametrize(("calls", "waits"), [(40, True), (20, False)])
def test_who_has_many_calls_to_make_waits_for_what_takes_less(calls, waits):
    found, x = beside(9 + calls)
    given = {"seconds": lambda: 1.0, "evaluations": 100, "left": np.inf}  # thirty seconds
    assert found.pays(x, by=2.0, calls=calls, **given) is waits


def test_what_is_slower_than_numpy_or_cannot_be_measured_is_not_used():
    found, x = beside(6)
    given = {"evaluations": 1000, "left": np.inf}
    assert not found.pays(x, by=2.0, seconds=lambda: None, **given)
    assert not found.pays(x, by=2.0, seconds=lambda: 1e-12, **given)


def test_a_part_of_a_call_is_compared_with_what_that_part_takes():
    found, x = beside(7)
    given = {"seconds": lambda: 1.0, "evaluations": 3000, "left": np.inf}
    assert found.pays(x, by=2.0, **given)
    assert found.pays(x, by=2.0, share=0.5, **given)
    assert not found.pays(x, by=2.0, share=1e-9, **given)


def test_what_cannot_be_compiled_is_done_without_and_logged(caplog, capfd):
    """Nobody waits for the thread: what it raised would be on the screen, and nowhere else."""

    def refused(x):
        raise ValueError("it has no rule")

    found, x = CompiledBeside(jax.jit(refused)), jnp.ones(9)
    given = {"seconds": lambda: 1e-3, "evaluations": 1000, "left": np.inf}
    assert not any(found.pays(x, **given) for _ in range(3))
    (record,) = (each for each in caplog.records if each.name == "reachjax")
    assert record.levelname == "WARNING"
    assert record.getMessage().endswith("goes on in numpy: ValueError('it has no rule')")
    assert "Traceback" not in capfd.readouterr().err
    with pytest.raises(ValueError, match="it has no rule"):
        found(x)


@pytest.mark.costly
def test_of_the_settings_of_the_suite_the_installed_xla_accepts_all_that_are_used():
    """XLA ends a process that names one which it no longer has."""
    used = accepted({"xla_no_such_setting": "true"} | QUICKER)
    assert used == accepted(QUICKER)
    assert "xla_no_such_setting" not in used
