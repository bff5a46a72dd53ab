"""Settings of the whole suite: 64-bit floats, one BLAS thread, quick compilation, one cache of it.

They stand in the environment too, for the kernels and commands that tests start. What is there
already is left alone: `XLA_FLAGS= python -m pytest` compiles as JAX does by itself.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import jax
import pytest

from tests.memory import forget

pytest_plugins = ["tests.campaign.session", "tests.selection"]
"""Their options have to be known before any test is read."""

ROOT = Path(__file__).parent

QUICKER = {
    "xla_backend_optimization_level": "0",
    "xla_cpu_parallel_codegen_split_count": "1",
    "xla_cpu_use_fusion_emitters": "false",
    "xla_llvm_disable_expensive_passes": "true",
}
"""With them a tube's gradient is compiled in a third of the time, and runs as fast as without."""

LARGEST, MOST = 5 * 2**28, 2**32
"""Bytes that a process may take before it forgets what it compiled; and where every case runs."""


def accepted(flags: dict[str, str]) -> str:
    """Those that the installed XLA accepts: it ends a process that names another, so one tries."""

    def said(names: Iterable[str]) -> str:
        return " ".join(f"--{name}={flags[name]}" for name in names)

    def are_accepted(*names: str) -> bool:
        own = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": said(names)}
        command = [sys.executable, "-c", "import jax; jax.devices()"]
        return subprocess.run(command, check=False, env=own, capture_output=True).returncode == 0

    return said(flags if are_accepted(*flags) else filter(are_accepted, flags))


# One folder for all processes: half an entry, which another one is writing, fails its checksum,
# and its program is compiled.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = accepted(QUICKER)

# JAX, imported already, reads only XLA's flags from now on
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_platforms", os.environ["JAX_PLATFORMS"])
jax.config.update("jax_enable_x64", True)


def taken() -> int:
    """Bytes of memory that this process takes; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@pytest.fixture(autouse=True)
def _memory_is_bounded(request):
    """Tests share what they compiled until it fills a gigabyte; the cache on disk keeps it."""
    yield
    every = map(request.config.getoption, ("every_case", "other_cases", "experiments"))
    if taken() > (MOST if any(every) else LARGEST):
        forget()
