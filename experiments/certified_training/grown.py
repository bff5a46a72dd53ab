"""How large a set is proved of a controller, and of one that is trained for size.

    python -m experiments.certified_training.grown  # up to 40 minutes; interrupted, it continues

A pendulum is balanced by a force that is limited. A plain network imitates a cautious law, which
uses a part of the force; so it balances the pendulum from near the top only. It is trained for
size: from the largest box that is proved on, `rj.train` gets a wider one proved, as often as that
succeeds. Of both controllers is asked from which box of initial states the loop is safe at all
times and comes to the goal, by `rj.largest_set`, and from which states it is safe for ever: a box
is looked for into which all states of it come back, and then cells from which all states come into
it, by `rj.winning_set`. These cells are a certified region of attraction.
"""

import hashlib
import itertools
import os
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is imported

import jax
import jax.numpy as jnp
import numpy as np
import optax
import rich
from jaxtyping import Float
from numpy import ndarray
from rich.table import Table

import reachjax as rj
from experiments import report, stored
from experiments.command import bar, configure_jax, require_options, run_experiment
from experiments.imitation import train_network
from experiments.nonlinear.problems import GRAVITY, Layers
from experiments.sampled.problems import PERIOD
from experiments.sampling import Samples

FORCE = 2.0
"""The largest input, in rad/s^2: it holds the pendulum up to 0.41 rad."""

CAUTION = 0.2
"""The part of the force that the plain law uses."""

GAIN = 1.4
"""Of the plain law over the least one that holds the pendulum anywhere."""

HIDDEN = (16, 16)
HORIZON = 20
"""Periods until the goal must be reached, and until all states of a box are back in it."""

SAFE, GOAL = (0.7, 1.6), (0.05, 0.12)
"""Half the boxes in which states must stay, and into which they must come."""

WIDEST = np.array([0.6, 1.4])
"""Half the box in which initial states are looked for."""

PARTS = (0.9, 0.7, 0.5, 0.4, 0.3, 0.2)
"""Of the goal, boxes that are tried to come back to, the largest one first."""

LONGER = 2
"""So many horizons states have to come into that box."""

WIDER, LEAST = 1.3, 1.05
"""A box whose sides are so many times as long is trained on next, at most. What exceeds one is
halved where that is not proved, and doubled where it is, until it is less than the other one."""

STAGES = (rj.Stage(rj.Simulated(), epochs=2), rj.Stage(rj.Certified(), cells=16))


@dataclass(frozen=True)
class Settings:
    """Train a controller for the size of the set that is proved, and of its region of attraction.

    Everything is kept under `output`; an interrupted run continues with what is there.
    """

    rounds: int = 16
    """Boxes that are trained on, at most."""
    seconds: float = 60.0
    """For each of them."""
    limit: float = 300.0
    """Seconds for the search for the largest set, and for that of the region of attraction."""
    cells: int = 4000
    """Of the region of attraction."""
    samples: int = 5000
    """State-input pairs of the law."""
    training_steps: int = 3000
    """Steps of Adam on imitation."""
    discrete: bool = False
    """Whether a period is one step of the midpoint rule, as if it were exact, and nothing is
    required in between: what is proved takes a tenth of the time."""
    learning_rate: float = 3e-3
    """Of Adam, where the network is trained for size."""
    output: Path = Path("results/certified_training")
    """Where everything is written."""

    def __post_init__(self):
        counts = dict.fromkeys(("rounds", "cells", "training_steps"), 1)
        require_options(self, "seconds", "limit", "learning_rate", samples=10, **counts)

    @property
    def key(self) -> dict[str, Any]:
        """All that results depend on."""
        names = [field.name for field in fields(self) if field.name != "output"]
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class Size:
    """What is proved of a controller.

    Attributes:
        lower: `(2,)`, of the largest box from which the loop is safe and comes to the goal.
        upper: `(2,)`.
        back: `(2,)`, half the box into which all its states come back; NaN where none is found.
        cells: `(c, 2, 2)`, lower and upper corners of the cells of the region of attraction.
        seconds: of both searches.
    """

    lower: Float[ndarray, " 2"]
    upper: Float[ndarray, " 2"]
    back: Float[ndarray, " 2"]
    cells: Float[ndarray, "c 2 2"]
    seconds: Float[ndarray, " 2"]

    @property
    def volume(self) -> float:
        """Of the box."""
        return float(np.prod(self.upper - self.lower))

    @property
    def attracted(self) -> float:
        """The area of the certified region of attraction: of the cells, at least of the box."""
        box = 0.0 if np.isnan(self.back).any() else float(np.prod(2 * self.back))
        return max(float(np.prod(self.cells[:, 1] - self.cells[:, 0], axis=1).sum()), box)

    @classmethod
    def of(cls, loop: rj.ClosedLoop, settings: Settings) -> Self:
        """What is proved of a loop."""
        began = time.perf_counter()
        box = largest(loop, settings)
        middle = time.perf_counter()
        back, cells = attraction(loop, settings)
        seconds = middle - began, time.perf_counter() - middle
        lower, upper = (np.asarray(end) for end in (box.lower, box.upper))
        return cls(lower, upper, back, cells, np.array(seconds))


def law(x: Float[ndarray, "c 2"]) -> Float[ndarray, "c 1"]:
    """A cautious law, of the part of the state that grows: the other one falls by itself."""
    grows = x[:, 0] + x[:, 1] / np.sqrt(GRAVITY)
    most = CAUTION * FORCE
    return -most * np.tanh(GAIN * GRAVITY * grows / most)[:, None]


def closed(layers: Layers, settings: Settings) -> rj.ClosedLoop:
    """The pendulum under a network, whose output is limited."""

    def f(x, u):
        return jnp.array([x[1], GRAVITY * jnp.sin(x[0]) + u[0]])

    def step(x, u):
        return x + PERIOD * f(x + PERIOD / 2 * f(x, u), u)

    net, limits = rj.MLP.from_layers(layers, activation=rj.Tanh()), rj.Box([-FORCE], [FORCE])
    loop = rj.ClosedLoop(rj.SampledPlant(f, 2, 1, PERIOD), net, limits)
    return loop.replace(plant=rj.NonlinearPlant(step, 2, 1)) if settings.discrete else loop


def imitated(settings: Settings) -> Layers:
    """The plain network."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-WIDEST, WIDEST, (settings.samples, 2))
    fit = train_network(
        Samples(states, law(states)),
        HIDDEN,
        penalty=1e-5,
        steps=settings.training_steps,
        learning_rate=3e-3,
        restarts=1,
        standardise=True,
        activation="tanh",
        path=settings.output / "grown_plain_network.npz",
        progress=False,
    )
    return fit.layers


def box_of(half: Float[ndarray, " 2"]) -> rj.Box:
    """The box around the origin."""
    return rj.Box(-half, half)


def safe() -> rj.Box:
    """The box in which states must stay."""
    return box_of(np.array(SAFE))


def goal() -> rj.Box:
    """The box into which states must come by the horizon."""
    return box_of(np.array(GOAL))


def simulated_box(loop: rj.ClosedLoop, count: int = 21) -> rj.Box:
    """A large box around the origin, all of whose simulated states do what is required."""
    sides = np.linspace(-1, 1, count)
    grid = WIDEST * np.stack(np.meshgrid(sides, sides, indexing="ij"), axis=-1)
    runs = np.asarray(loop.simulate(grid.reshape(-1, 2), HORIZON))
    fine = np.asarray(safe().contains(runs.reshape(-1, 2))).reshape(runs.shape[:2]).all(axis=1)
    fine = (fine & np.asarray(goal().contains(runs[:, -1]))).reshape(count, count)
    middle, most = count // 2, (0, 0)
    for i, j in itertools.product(range(middle + 1), repeat=2):
        within = fine[middle - i : middle + i + 1, middle - j : middle + j + 1]
        if within.all() and i * j > most[0] * most[1]:
            most = i, j
    half = np.array([0.5, 0.5]) if not np.prod(most) else np.array(most)
    return box_of(half / middle * WIDEST)


def largest(loop: rj.ClosedLoop, settings: Settings) -> rj.Box:
    """The largest box that is proved, from one on which simulations look well."""
    found = rj.largest_set(
        loop, simulated_box(loop), HORIZON, goal=goal(), safe=safe(), time_limit=settings.limit
    )
    assert isinstance(found.region, rj.Box)
    return found.region


def attraction(
    loop: rj.ClosedLoop, settings: Settings
) -> tuple[Float[ndarray, " 2"], Float[ndarray, "c 2 2"]]:
    """A box that is come back to, and cells from which the loop is safe for ever.

    From each of the cells all states come into the box, safely, and from the box into itself.
    """
    half = np.asarray(GOAL)
    for part in PARTS:
        back = box_of(part * half)
        found = rj.decide(
            loop, back, HORIZON, goal=back, safe=safe(), time_limit=settings.limit / 10
        )
        if found.proved:
            break
    else:
        return np.full(2, np.nan), np.zeros((0, 2, 2))
    asked = {"goal": back, "safe": safe(), "cells": settings.cells, "time_limit": settings.limit}
    won = rj.winning_set(loop, simulated_region(loop), LONGER * HORIZON, **asked)
    proved = [cell for cell in won.cells if cell.status is rj.VerdictStatus.PROVED]
    ends = [(np.asarray(cell.lower), np.asarray(cell.upper)) for cell in proved]
    return np.asarray(back.upper), np.array(ends).reshape(-1, 2, 2)


def simulated_region(loop: rj.ClosedLoop, count: int = 61) -> rj.Box:
    """The box around states that come near the origin, where simulations are asked."""
    sides = np.linspace(-1, 1, count)
    grid = (WIDEST * np.stack(np.meshgrid(sides, sides), axis=-1)).reshape(-1, 2)
    last = np.asarray(loop.simulate(grid, LONGER * HORIZON))[:, -1]
    come = grid[np.asarray(goal().contains(last))]
    return rj.Box(come.min(axis=0), come.max(axis=0))


def nothing(loop: rj.ClosedLoop, states: jax.Array) -> jax.Array:
    """The task's loss: only size counts."""
    return jnp.zeros(())


def next_factor(factor: float, *, proved: bool) -> float:
    """How many times as long sides are tried next, after a box that is proved or is not."""
    return min(WIDER, 1 + 2 * (factor - 1)) if proved else 1 + (factor - 1) / 2


def grown(loop: rj.ClosedLoop, region: rj.Box, settings: Settings) -> tuple[rj.ClosedLoop, rj.Box]:
    """A loop of which a larger box is proved, box by box, and the last one.

    What is not proved in time is trained on, for a box that is not as wide.
    """
    optimizer, factor, latest = optax.adam(settings.learning_rate), WIDER, loop
    with bar() as shown:
        task = shown.add_task("training for size", total=settings.rounds)
        for seed in range(settings.rounds):
            wider = box_of(np.minimum(factor * np.asarray(region.upper), WIDEST))
            found = rj.train(
                latest,
                wider,
                HORIZON,
                nothing,
                goal=goal(),
                safe=safe(),
                optimizer=optimizer,
                stages=STAGES,
                margin=0.005,
                steps=50,
                seed=seed,
                gain=1.0,  # nothing is left to lower once it is proved
                time_limit=settings.seconds,
            )
            shown.advance(task)
            latest = found.loop
            if found.proved:
                loop, region = latest, wider
            factor = next_factor(factor, proved=found.proved)
            whole = bool(np.all(np.asarray(region.upper) >= WIDEST))
            if factor < LEAST or whole:
                break
    return loop, region


def trained(plain: Layers, begun: Size, settings: Settings) -> Layers:
    """The network that is trained for size, from its file where it is there."""
    path = settings.output / "grown_network.npz"
    kept = stored.load(path, settings.key)
    if kept is None:
        half = np.minimum(-begun.lower, begun.upper)
        loop, _ = grown(closed(plain, settings), box_of(half), settings)
        assert isinstance(loop.controller, rj.MLP)
        pairs = loop.controller.layers
        kept = {f"W{k}": np.asarray(W) for k, (W, _) in enumerate(pairs)}
        kept |= {f"b{k}": np.asarray(b) for k, (_, b) in enumerate(pairs)}
        stored.save(path, settings.key, **kept)
    return [(kept[f"W{k}"], kept[f"b{k}"]) for k in range(len(HIDDEN) + 1)]


def size_of(name: str, layers: Layers, settings: Settings) -> Size:
    """What is proved of a network, from its file where it is there."""
    path = settings.output / f"grown_{name}.npz"
    key = settings.key | {"network": fingerprint(layers)}
    kept = stored.load(path, key)
    if kept is None:
        size = Size.of(closed(layers, settings), settings)
        kept = {field.name: getattr(size, field.name) for field in fields(Size)}
        stored.save(path, key, **kept)
    return Size(**kept)


def fingerprint(layers: Layers) -> str:
    """A short word that differs where weights do."""
    found = hashlib.sha256()
    for part in itertools.chain.from_iterable(layers):
        found.update(np.asarray(part).tobytes())
    return found.hexdigest()[:16]


NOTE = (
    "largest box: its area, from which the loop is safe at all times and comes to the goal.\n"
    "attraction: the area of the cells from which the loop is safe for ever, at least that of the "
    "box into which all its states come back. A dash: no such box is proved, so that nothing is "
    "known of a region of attraction. Where that is so before training, there is no ratio."
)
"""What the columns of the table mean, in sentences."""


def dashed(value: float, digits: int) -> str:
    """A number in words, a dash where it is not known."""
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def table(sizes: dict[str, Size]) -> Table:
    """A controller a row, and how many times as large what is proved is after training."""
    rows: list[tuple[Any, ...]] = [
        (
            name,
            f"{size.volume:.4f}",
            dashed(size.attracted or float("nan"), 3),
            len(size.cells),
            *(f"{each:.0f}" for each in size.seconds),
        )
        for name, size in sizes.items()
    ]
    rows.append(("times as large", *(dashed(each, 1) for each in ratios(sizes)), "", "", ""))
    headings = ("largest box", "attraction", "cells", "s, box", "s, attraction")
    title = "areas in rad^2/s that are proved of a pendulum"
    return report.table(title, ("controller",), headings, rows)


def ratios(sizes: dict[str, Size]) -> tuple[float, float]:
    """Largest boxes and regions of attraction, after training over before; NaN over nothing."""
    before, after = sizes.values()
    pairs = (after.volume, before.volume), (after.attracted, before.attracted)
    one, other = (each / base if base > 0 else float("nan") for each, base in pairs)
    return one, other


def draw(sizes: dict[str, Size], loops: dict[str, rj.ClosedLoop], path: Path) -> None:
    """Largest boxes over regions of attraction, with some trajectories."""
    from matplotlib.collections import PolyCollection

    figure, (axes,) = report.panels(1, 2, (9.0, 4.2), sharex=True, sharey=True)
    for ax, (name, size) in zip(axes, sizes.items(), strict=True):
        ends = size.cells
        if not np.isnan(size.back).any():
            ends = np.concatenate([ends, [[-size.back, size.back]]])
        (left, bottom), (right, top) = (ends[:, end].T for end in (0, 1))
        corners = np.stack([[left, bottom], [right, bottom], [right, top], [left, top]])
        cells = PolyCollection(list(corners.transpose(2, 0, 1)), facecolor="tab:green", alpha=0.35)
        cells.set_label("safe for ever")
        ax.add_collection(cells)
        box = rj.Box(size.lower, size.upper)
        for each, colour, label in ((box, "tab:blue", "largest box"), (goal(), "black", "goal")):
            style: dict[str, Any] = {"edgecolor": colour, "facecolor": "none"}
            rj.plot_set(each, ax, label=label, **style)
        parts = 8 if loops[name].plant.continuous else 1
        runs = np.asarray(loops[name].simulate(box.corners(), HORIZON, parts=parts))
        ax.plot(*runs.transpose(2, 1, 0), color="tab:blue", linewidth=0.6)
        ax.set(title=name, xlabel="angle (rad)", xlim=(-WIDEST[0], WIDEST[0]))
        ax.set_ylim(-WIDEST[1], WIDEST[1])
    axes[0].set_ylabel("rate (rad/s)")
    report.legend_below(figure)
    report.save(figure, path)


def main(settings: Settings) -> None:
    """Imitate, measure, train for size, measure again, print, and write figure and results."""
    configure_jax(settings.output)
    plain = imitated(settings)
    before = size_of("before", plain, settings)
    larger = trained(plain, before, settings)
    sizes = {"plain": before, "trained for size": size_of("after", larger, settings)}
    rich.print(table(sizes))
    rich.print(NOTE)
    loops = dict(zip(sizes, (closed(plain, settings), closed(larger, settings)), strict=True))
    draw(sizes, loops, settings.output / "grown.png")
    found = {
        name: {
            "box": [size.lower, size.upper],
            "volume": size.volume,
            "back": size.back,
            "attraction": size.attracted,
            "cells": len(size.cells),
            "seconds": size.seconds,
        }
        for name, size in sizes.items()
    }
    volume, area = ratios(sizes)
    times = {"volume": volume, "attraction": area}
    report.write(settings.output / "grown.json", settings, sizes=found, times_as_large=times)
    rich.print(f"written: grown.png and grown.json under {settings.output}")


if __name__ == "__main__":
    run_experiment(main, Settings)
