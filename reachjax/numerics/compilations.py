"""Compilations that are kept for the next process."""

from __future__ import annotations

import os
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from reachjax.numerics.checks import described


def keep_compilations(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keep what JAX compiles, for this process and all later ones.

    Turns on JAX's persistent cache for everything that takes time, however little. Best before
    anything is compiled; what is compiled later is kept anyhow. The folder may be deleted at any
    time, and processes may share it.

    Args:
        folder: where. None: where JAX keeps compilations already (its option
            `jax_compilation_cache_dir`, or the environment's `JAX_COMPILATION_CACHE_DIR`), or else
            `reachjax` in the user's folder of caches.

    Returns:
        The folder.

    Raises:
        TypeError: `folder` is no path.
        ValueError: it is no folder that can be written to.

    Example:
        >>> import tempfile
        >>> before = jax.config.values["jax_compilation_cache_dir"]
        >>> folder = keep_compilations(tempfile.mkdtemp())
        >>> folder.is_dir()
        True
        >>> jax.config.update("jax_compilation_cache_dir", before)
    """
    kept = jax.config.values["jax_compilation_cache_dir"]
    if folder is None:
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = kept or Path(caches) / "reachjax"
    if not isinstance(folder, str | os.PathLike):
        raise TypeError(f"folder must be a path, but {described(folder)} arrived")
    found = Path(folder)
    try:
        found.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"folder must be one that can be written to, but {found} arrived: {error}"
        ) from None
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if str(found) != kept:
        jax.config.update("jax_compilation_cache_dir", str(found))
    compilation_cache.reset_cache()  # JAX looks for a cache once, at its first compilation
    return found
