"""Networks that imitate a law: trained once, and kept in the folder `data` beside this file.

A lesson that is changed is learned anew when its network is next asked for, and replaces the file.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments import stored
from experiments.imitation import evaluate, train_network
from experiments.layers import Layers
from experiments.sampling import Samples

DATA = Path(__file__).parent / "data"


@dataclass(frozen=True)
class Lesson:
    """A law, where a network sees it, and how it learns.

    Attributes:
        name: of the file.
        law: inputs `(c, n_u)` at many states `(c, n)`.
        lower: `(n,)`, states are drawn uniformly from here
        upper: `(n,)`, to here.
        hidden: neurons of each hidden layer.
        error: what the root mean square error at new states stays below.
        samples: how many states are seen.
        steps: of Adam.
        penalty: weight of the squared weights, as in `experiments.imitation`.
        restarts: networks of which the best is kept.
        seed: of samples and weights.
    """

    name: str
    law: Callable[[Float[ndarray, "c n"]], Float[ndarray, "c n_u"]]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    hidden: tuple[int, ...]
    error: float
    samples: int = 8000
    steps: int = 5000
    penalty: float = 1e-5
    restarts: int = 1
    seed: int = 0

    def settings(self) -> dict[str, Any]:
        """What a stored network has to agree with: all but the law itself."""
        fields = dataclasses.asdict(self)
        del fields["law"], fields["error"]
        return {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}

    def shown(self, count: int, seed: int) -> Samples:
        """What the law does at `count` states."""
        rng = np.random.default_rng(seed)
        states = rng.uniform(self.lower, self.upper, (count, len(self.lower)))
        return Samples(states, self.law(states))

    def learned(self) -> Layers:
        """A network trained now: it takes minutes."""
        return train_network(
            self.shown(self.samples, self.seed),
            self.hidden,
            self.seed,
            penalty=self.penalty,
            steps=self.steps,
            restarts=self.restarts,
            standardise=True,
        ).layers

    def layers(self, folder: Path = DATA) -> Layers:
        """The stored network."""
        path = folder / f"{self.name}.npz"
        kept = stored.load(path, self.settings())
        if kept is None:
            learned = self.learned()
            kept = {f"W{i}": W for i, (W, _) in enumerate(learned)}
            kept |= {f"b{i}": b for i, (_, b) in enumerate(learned)}
            stored.save(path, self.settings(), **kept)
        return [(kept[f"W{i}"], kept[f"b{i}"]) for i in range(len(self.hidden) + 1)]

    def errors(self, layers: Layers, count: int = 20_000) -> tuple[float, float]:
        """Root mean square and largest error at states that were not seen."""
        new = self.shown(count, self.seed + 1)
        errors = np.linalg.norm(evaluate(layers, new.states) - new.inputs, axis=1)
        return float(np.sqrt(np.mean(errors**2))), float(errors.max())
