"""Generators laid out for the interior-point method: multipliers with the most pairs first.

The layout is built from gathers alone, so that it serves numpy arrays on the host, where what is
unused is cut away and shapes are padded to a few sizes, and traced arrays inside `jax.jit`, where
the program keeps its shape and what is unused is masked.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from reachjax.programs.relaxations import Products
from reachjax.programs.trimming import Trimmed, namespace
from reachjax.solvers.generators import Generators

SLOTS = 2
"""Pairs that a multiplier may have without becoming a general generator."""


class Arrangement(NamedTuple):
    """Generators, and where each of their multipliers comes from.

    Attributes:
        generators: of unit size.
        objective: `(f, n)`, in their columns.
        order: `(K,)`, the program's multipliers in the order of the generators.
        scale: `(K,)`, the program's multiplier is this times the generator's; zero where dead.
        columns: `(n,)`, the program's columns in the order of the generators.
    """

    generators: Generators
    objective: Float[Any, "f n"]
    order: Int[Any, " K"]
    scale: Float[Any, " K"]
    columns: Int[Any, " n"]


def arranged(
    trimmed: Trimmed, products: Products, slots: int | None = None, general: int | None = None
) -> Arrangement:
    """Lay out a trimmed program.

    Args:
        trimmed: its numbers.
        products: its pairs.
        slots: how many pairs a multiplier may have before it needs a matrix, 1 or 2; counted if
            None.
        general: how many multipliers may have more; counted if None. What is beyond is left out,
            which is sound.
    """
    xp, facts, count = namespace(trimmed.facts), trimmed.facts, len(products.free)
    m, n = facts.shape
    used = trimmed.kept[products.multiplier]
    key = xp.where(used, products.multiplier, count)
    by_owner = xp.argsort(key, stable=True)
    start = xp.searchsorted(key[by_owner], xp.arange(count + 1))
    pairs = start[1:] - start[:-1]
    order = xp.argsort(-pairs, stable=True)
    pairs = pairs[order]
    slots = int(1 + ((pairs > 1) & (pairs <= SLOTS)).any()) if slots is None else slots
    general = int((pairs > SLOTS).sum()) if general is None else general
    several = pairs > SLOTS
    dead = (pairs == 0) | (several & (xp.arange(count) >= general))
    scale = xp.where(dead, 0.0, 1 / xp.where(dead, 1.0, trimmed.sizes[order]))

    def slot(number: int):
        there = (pairs > number) & ~several
        which = by_owner[xp.clip(start[:-1][order] + number, 0, len(by_owner) - 1)]
        left, right = (xp.where(there, part[which], m) for part in (products.left, products.right))
        weight = xp.where(there, scale * products.sign[which], 0.0)
        ends = xp.full(1, m), xp.full(1, m), xp.full(1, -1.0 * (number == 0))
        return [xp.concatenate(each) for each in zip((left, right, weight), ends, strict=True)]

    def dense(number: int):
        mine = used & (products.multiplier == order[number]) & several[number]
        weights = xp.where(mine, scale[number] * products.sign, 0.0)
        half = (weights[:, None] * facts[products.left]).T @ facts[products.right]
        return (half + half.T) / 2

    last = xp.arange(n) == n - 1
    parts = zip(*(slot(number) for number in range(slots)), strict=True)
    left, right, weight = (xp.stack(part) for part in parts)
    matrices = [dense(number) for number in range(general)]
    generators = Generators(
        rows=xp.concatenate([facts, 1.0 * last[None]]),
        left=left,
        right=right,
        weight=weight,
        general=xp.stack(matrices) if matrices else xp.zeros((0, n, n)),
        free=xp.concatenate([products.free[order] & ~dead, xp.full(1, True)]),
        target=-xp.concatenate([1.0 * dead, xp.ones(1)]),
        idle=1.0 * ~(trimmed.columns | last),
    )
    return Arrangement(generators, trimmed.objective, order, scale, xp.arange(n))


def cut(whole: Arrangement) -> Arrangement:
    """Without unused multipliers, rows and columns, padded to one of a few shapes; numpy only."""
    old, count = whole.generators, int((whole.scale > 0).sum())
    columns, slots = np.flatnonzero(old.idle == 0), len(old.weight)
    there = old.weight[:, :count] != 0
    used = np.union1d(old.left[:, :count][there], old.right[:, :count][there]).astype(int)
    m, K = bucket(len(used) + 1, 64), bucket(count + 1, 64)
    n = bucket(len(columns), 16 if len(columns) <= 64 else 8)
    here = slice(n - len(columns), n)
    rows, number = np.zeros((m, n)), np.full(len(old.rows), m - 1)
    rows[: len(used), here] = old.rows[np.ix_(used, columns)]
    rows[-1, -1] = 1.0
    number[used] = np.arange(len(used))
    left, right = np.full((2, slots, K), m - 1)
    weight, general = np.zeros((slots, K)), np.zeros((len(old.general), n, n))
    left[:, :count], right[:, :count] = number[old.left[:, :count]], number[old.right[:, :count]]
    weight[:, :count], weight[0, -1] = old.weight[:, :count], -1.0
    general[:, here, here] = old.general[:, columns[:, None], columns]
    free, target = np.zeros(K, dtype=bool), np.full(K, -1.0)
    free[:count], target[:count], free[-1] = old.free[:count], old.target[:count], True
    objective = np.zeros((len(whole.objective), n))
    objective[:, here] = whole.objective[:, columns]
    idle = 1.0 * (np.arange(n) < n - len(columns))
    generators = Generators(rows, left, right, weight, general, free, target, idle)
    return Arrangement(generators, objective, whole.order[:count], whole.scale[:count], columns)


def bucket(size: int, least: int) -> int:
    """The smallest padded size that holds `size`: multiples of `least`, at most 4 a doubling.

    Example:
        >>> [bucket(size, 8) for size in (5, 45, 69, 205, 405)]
        [8, 48, 80, 224, 448]
    """
    step = max(least, 2 ** (max(size, 1).bit_length() - 1) // 4)
    return -(-size // step) * step
