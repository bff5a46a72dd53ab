"""The third claim: derivatives of the reported bounds are their differences."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj

STEP = 1e-4
"""Relative: of each number."""

SHORT = STEP / 100
"""The step that decides where differences are not the derivative; few bounds have its digits."""

CLOSE = 2e-3
"""Of the derivative, or of the sets' width: what solvers leave to digits."""

ROUGH = 1e-2
"""Of the sizes of the derivative's terms, which may cancel: what the default tolerance leaves."""

SOLVERS = "rj.Clarabel()", "rj.Clarabel(tolerance=1e-11)"
"""A derivative is as good as its multipliers: the second decides where the first is not close."""


@cache
def _compiled(template: str, relaxation: str, solver: str, horizon: int):
    """The weighted bounds of a tube with its derivative, and bounds with statuses; jitted."""
    names = {"rj": rj}
    template, relaxation, solver = (eval(e, names) for e in (template, relaxation, solver))

    def bounds(given):
        loop, X0 = given
        tube = rj.reach(loop, X0, horizon, template, relaxation, 1, solver, samples=16)
        codes = jnp.concatenate([tube.proof(t).codes for t in range(1, horizon + 1)])
        return tube.sets[horizon].b, codes

    def weighed(given, weights):
        found, codes = bounds(given)
        return weights @ found, (found, codes)

    return jax.jit(jax.value_and_grad(weighed, has_aux=True))


def compared(case, loop, X0, rng: np.random.Generator) -> tuple[str, str | None]:
    """How a derivative along a random direction compares with differences.

    Returns:
        A word for the count, and a sentence if the derivative is wrong.
    """
    value, exacter = (
        _compiled(case.parts["template"], case.parts["relaxation"], solver, case.shapes.horizon)
        for solver in SOLVERS
    )
    facets = 2 * case.shapes.states
    weights = rng.uniform(0.1, 1.0, facets)
    leaves, structure = jax.tree.flatten((loop, X0))
    along = [np.asarray(leaf) * rng.normal(size=leaf.shape) for leaf in leaves]
    if loop.input_box is not None:
        _kept_flat(along, leaves, loop.input_box)

    def moved(part: float):
        pairs = zip(leaves, along, strict=True)
        return jax.tree.unflatten(structure, [leaf + part * d for leaf, d in pairs])

    (middle, (b, codes)), slopes = value((loop, X0), weights)
    if not np.isfinite(b).all():
        return "no bound", None
    slope, terms = _slope(slopes, along)
    solved = int(rj.SolverStatus.SOLVED)
    if np.isnan(slope):
        names = sorted({rj.SolverStatus(int(code)).name for code in np.asarray(codes)})
        return "NaN", f"the gradient is NaN, but the bounds {b.tolist()} are finite ({names})"
    if np.any(np.asarray(codes) != solved):
        return "not solved", None
    ends = {}
    for part in (-STEP, STEP, -STEP / 2, STEP / 2):
        (ends[part], (_, codes)), _ = value(moved(part), weights)
        if not np.isfinite(ends[part]) or np.any(np.asarray(codes) != solved):
            return "not solved", None
    before = (float(middle) - float(ends[-STEP])) / STEP
    after = (float(ends[STEP]) - float(middle)) / STEP
    near = (float(ends[STEP / 2]) - float(ends[-STEP / 2])) / STEP
    width = float(np.sum(abs(np.asarray(b[: facets // 2] + b[facets // 2 :]))))
    rounding = 1e-15 * float(abs(b).max()) * facets / STEP
    slack = CLOSE * max(abs(before), abs(after), width) + 10 * rounding
    # At a kink each bound has its own generalised derivative: their sum need not lie between
    # the differences before and after.
    if max(abs(before - after), abs(near - (before + after) / 2)) > slack:
        return "kink", None
    if abs(slope - near) <= 2 * slack:
        return "agrees", None
    if abs(slope - near) <= ROUGH * terms:
        again, _ = _slope(exacter((loop, X0), weights)[1], along)
        if abs(again - near) <= 2 * slack:
            return "agrees, solved more exactly", None
    low, high = (float(value(moved(part), weights)[0][0]) for part in (-SHORT, SHORT))
    if abs(slope - (high - low) / (2 * SHORT)) <= 2 * slack:
        return "kink", None  # kinks on both sides of the middle, beyond the short step
    return "wrong", f"the derivative is {slope!r}, but differences are {near!r}"


def _kept_flat(along: list[np.ndarray], leaves: list, box: rj.Box) -> None:
    """Move both ends alike where they are one: its width has a kink there, which is at 0.

    Derivatives in a width below some 1e-8 of the size lose their digits (`solvers.goals`).
    """
    lower, upper = (
        next(k for k, leaf in enumerate(leaves) if leaf is end) for end in (box.lower, box.upper)
    )
    flat = np.asarray(box.upper - box.lower) <= 1e-7 * abs(np.asarray(box.upper))
    along[upper] = np.where(flat, along[lower], along[upper])


def _slope(slopes, along: list[np.ndarray]) -> tuple[float, float]:
    """The derivative along a direction, and the sum of its terms' sizes."""
    pairs = zip(jax.tree.leaves(slopes), along, strict=True)
    terms = np.concatenate([np.ravel(np.asarray(g) * d) for g, d in pairs])
    return float(terms.sum()), float(abs(terms).sum())
