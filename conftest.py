"""Settings of the whole suite: 64-bit floats, one BLAS thread, a compilation cache."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

from pathlib import Path

import jax
import pytest

# One cache a worker: JAX writes entries in place, so another process could read half of one.
CACHE = Path(__file__).parent / ".jax_cache" / os.environ.get("PYTEST_XDIST_WORKER", "main")

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.fixture(autouse=True, scope="module")
def _compiled_code_is_dropped():
    """Forget a file's compiled functions after it: all together they fill gigabytes."""
    yield
    jax.clear_caches()
