"""Law: compiled, batched and plain code say the same, and other numbers compile nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.cases import ROUNDING, Case, each

PLAIN = {"forms": 1e-9, "programs": 1e-6, "paper": 1e-6, "paper, plain": 1e-6}
"""How far compiled bounds are from those of the host: by rounding, and by what solvers leave."""

ROWS = (
    *(Case(loop, "forms") for loop in ("relu", "hard", "disturbed", "inputs in a pentagon")),
    *(Case(loop, "forms") for loop in ("sine", "sine, tanh", "oscillator", "tank")),
    *(Case("relu", "forms", initial) for initial in ("ellipsoid", "intersection")),
    Case("relu", "programs"),
    Case("relu", "paper", "own", "octagonal"),
    Case("one state", "programs", "own", "ellipsoids"),
    Case("one state", "programs", "own", "mixed"),
)


def limits(case, loop, X0):
    """All that the tube's sets bound, of two steps."""
    tube = case.reach(loop, X0, 2)
    found = [X.facets[1] for X in tube.sets[1:]] if not case.round else []
    balls = [X.parts[1] for X in tube.sets[1:]]
    found += [jnp.append(ball.shape.ravel(), ball.center) for ball in balls if ball is not None]
    return jnp.concatenate(found)


def scaled(tree, by):
    """A tree with larger numbers."""
    return jax.tree.map(lambda leaf: by * leaf, tree)


@each(rows=ROWS)
@pytest.mark.costly
def test_compiled_batched_and_plain_bounds_agree_and_one_compilation_serves_all(case):
    traced, loop, X0 = [], case.closed_loop, case.X0

    def of(net):
        traced.append(net)
        return limits(case, loop.replace(controller=net), X0)

    compiled, accuracy = jax.jit(of), PLAIN[case.method]
    nets = [scaled(loop.controller, by) for by in (1.0, 0.5, 2.0)]
    found = np.stack([compiled(net) for net in nets])
    assert len(traced) == 1
    plain = np.stack([of(net) for net in nets])
    size = accuracy * np.maximum(1.0, abs(plain))
    assert np.all(abs(found - plain) <= size)
    batch = jax.vmap(of)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *nets))
    assert np.all(abs(batch - plain) <= size)


SMOOTH = (
    *(Case(loop, "forms") for loop in ("car", "bell", "sigmoid", "traced")),
    *(Case("sine, tanh", "forms", initial) for initial in ("point", "wide", "ellipsoid")),
    Case("oscillator", "forms", "polytope"),
)


@each(rows=SMOOTH)
@pytest.mark.costly
def test_forms_are_those_of_the_host_whatever_loop_and_set_are_compiled(case):
    """From a polytope they are no less: in compiled code the box around it is all that is known."""
    of = functools.partial(limits, case)
    found, plain = (np.asarray(each(case.closed_loop, case.X0)) for each in (jax.jit(of), of))
    flat, _ = case.X0.parts
    if flat is not None and flat.needs_programs:
        assert np.all(found >= plain - 1e-12)
    else:
        np.testing.assert_allclose(found, plain, rtol=1e-9, atol=1e-12)


@each(rows=[row for row in ROWS if row.method == "forms"][:6])
@pytest.mark.costly
def test_forms_call_nothing_from_compiled_code(case):
    of = jax.value_and_grad(lambda loop: limits(case, loop, case.X0).sum())
    assert "callback" not in jax.jit(of).lower(case.closed_loop).as_text()


@each(lambda case: case.continuous and case.method == "forms")
@pytest.mark.costly
def test_compiled_flows_hold_every_state(case):
    """Their steps are not halved where remainders are large: they may be looser, and no more."""
    loop = case.closed_loop
    found = np.asarray(jax.jit(lambda X0: limits(case, loop, X0))(case.X0))
    sets = case.tube.sets[1:3]
    attained = [
        np.asarray(X.bounded_values(case.runs[:, k])).max(axis=0) for k, X in enumerate(sets, 1)
    ]
    assert np.all(found >= np.concatenate(attained) - ROUNDING)
