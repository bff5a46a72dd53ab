"""Compilations: beside what goes on without them, and kept for the next process."""

from __future__ import annotations

import functools
import os
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from reachjax.numerics.checks import described
from reachjax.numerics.flags import lenient
from reachjax.numerics.logs import LOGGER, LONG

QUICKLY = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
"""For processors: XLA's newer emitters of fused code take twice as long to compile steps of
training as its older ones, and these steps then take as long. At the first level of optimisation
large ones are compiled a tenth sooner than at the last."""

ONCE = {"xla_backend_optimization_level": 0}
"""For what is compiled in longer than it ever runs."""

EVALUATIONS = 3000
"""What compiling a step of a loop takes, in evaluations of it in numpy: both grow with the number
of operations (measured: 2100 to 3300 for five loops of 15 to 73 units, from 2 s to 57 s)."""

CHEAP = 5.0
"""What takes fewer seconds to compile is begun at once and waited for, as long as there is time."""

BEHIND = 15
"""The niceness of a thread that compiles."""

FOUND = 16
"""So many compiled functions are held of each that is compiled beside its callers."""


class CompiledBeside:
    """A function that is compiled beside its callers, who go on in numpy until it is there.

    How long XLA takes for a large function nobody knows, and nothing can interrupt it. So it has a
    thread of its own, for which neither a limit nor Ctrl-C waits, but the end of Python does: JAX
    must not be taken down under it. It begins once callers have spent as much in numpy as
    compiling takes; at once if one call takes as much, or if it is cheap; and only if what is left
    of their time is longer. Who has many calls to make waits for it. What it finds is of use only
    where it is faster. Where it finds nothing, since compiling failed, its callers go on in numpy,
    and a warning is logged.

    Args:
        function: made by `jax.jit`, with keywords for what is static. What it is called with is
            what is compiled for: of loops all that depends on parameters alone is computed before.
    """

    def __init__(self, function: Any):
        self._function, self._lock = function, threading.Lock()
        self._known: OrderedDict[Any, _Compiled] = OrderedDict()

    def __call__(self, *given: Any, **static: Any) -> Any:
        """The value, by what is compiled; else it is compiled now."""
        found = self._of(given, static).call
        return self._function(*given, **static) if found is None else found(*given)

    def pays(
        self,
        *given: Any,
        seconds: Callable[[], float | None],
        evaluations: int,
        left: float,
        share: float = 1.0,
        calls: float | None = None,
        **static: Any,
    ) -> bool:
        """Whether the compiled function is there for such arguments, and faster than numpy.

        Whoever asks does without it if it is not, and that is counted.

        Args:
            given: arguments, of which shapes and what is static count.
            seconds: what the call takes in numpy, measured if it is not known yet; None: it cannot
                be said.
            evaluations: how many evaluations of what is compiled that is.
            left: the seconds until somebody stops waiting.
            share: the part of the call that is of use.
            calls: how many of them are to be made, by a caller who waits for the compilation if
                that takes less than all of them in numpy.
            static: keywords of the function.
        """
        known = self._of(given, static)
        if known.seconds is None:
            known.seconds = seconds()
        if known.seconds is None or known.began:
            return known.faster(share)
        asked = (share if calls is None else calls) * known.seconds
        price = EVALUATIONS * known.seconds / evaluations
        with self._lock:
            early = price > CHEAP and max(known.spent, asked) < price
            known.spent += asked
            if early or left < price or known.began:
                return False
            known.began = True
        if price > LONG:
            LOGGER.info("JAX compiles beside what goes on, for about %.0f s", price)
        thread = threading.Thread(target=self._compiled, args=(known, given, static))
        thread.start()
        if price <= CHEAP or calls is not None:  # beside others each would take twice as long
            thread.join(min(left, threading.TIMEOUT_MAX))
        return known.faster(share)

    def _of(self, given: Any, static: Any) -> _Compiled:
        """What is known of arguments like these."""
        leaves, structure = jax.tree.flatten(given)
        kinds = tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)
        key = structure, kinds, tuple(sorted(static.items()))
        with self._lock:
            known = self._known.setdefault(key, _Compiled())
            self._known.move_to_end(key)
            while len(self._known) > FOUND:
                self._known.popitem(last=False)
        return known

    @lenient
    def _compiled(self, known: _Compiled, given: Any, static: Any) -> None:
        """Compile, and measure a call; where that fails callers do without it."""
        try:
            self._measured(known, given, static)
        except Exception as error:  # nobody waits for this thread
            LOGGER.warning(
                "JAX could not compile beside what goes on, which goes on in numpy: %r", error
            )

    def _measured(self, known: _Compiled, given: Any, static: Any) -> None:
        """Compile, and measure a call; where no core is idle callers go first."""
        if sys.platform == "linux":  # where threads have priorities of their own
            own = os.PRIO_PROCESS, threading.get_native_id()
            os.setpriority(*own, max(os.getpriority(*own), BEHIND))
        with jax.enable_x64(True):
            call = self._function.lower(*given, **static).compile()
            jax.block_until_ready(call(*given))
            began = time.perf_counter()
            jax.block_until_ready(call(*given))
            known.takes = time.perf_counter() - began
        known.call = call


class _Compiled:
    """A function for arguments of some shapes.

    Attributes:
        call: it, once it is compiled.
        takes: the seconds of a call.
        began: whether it is being compiled, or was.
        seconds: what the same takes in numpy; None as long as it was not measured.
        spent: what callers have spent so.
    """

    def __init__(self):
        self.call: Callable | None = None
        self.takes, self.spent, self.began = np.inf, 0.0, False
        self.seconds: float | None = None

    def faster(self, share: float) -> bool:
        """Whether it is there, and takes less than a part of it takes in numpy."""
        if self.call is None or self.seconds is None:
            return False
        return self.takes < share * self.seconds


def compiler_options() -> dict[str, Any]:
    """Options of `jax.jit` by which code of this library is compiled soonest.

    It runs as fast as without them, and steps of training are compiled in half the time, where
    they are compiled for processors; for other devices there are none, nor where the installed XLA
    knows them no more. `rj.train` uses them, and so do calls on known numbers that are not within
    transformations of JAX, and derivatives of bounds by forms outside of compiled code.

    Returns:
        What `jax.jit` takes as its `compiler_options`, outermost: within other code they are an
        error of JAX's.

    Example:
        >>> double = jax.jit(lambda x: 2 * x, compiler_options=compiler_options())
        >>> float(double(1.5))
        3.0
    """
    return dict(QUICKLY) if _are_known(jax.default_backend()) else {}


@functools.cache
def _are_known(backend: str) -> bool:
    """Whether a backend is a processor's, and its compiler knows the options that are for these."""
    if backend != "cpu":
        return False
    try:
        jax.jit(lambda x: -x).lower(jax.ShapeDtypeStruct((), np.float32)).compile(QUICKLY)
    except jax.errors.JaxRuntimeError:
        return False
    return True


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
