"""A tube in a file is proved by what is rechecked, or it is not read: nobody has to be believed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import autonomous, closed_loop, random_loop
from tests.input_polytopes import polygon, polytope_loop

BOX = rj.Template.box(2)
X0 = rj.Box([-0.2, -0.3], [0.3, 0.2])
WIDE = rj.Box([-1.5, -1.0], [1.0, 1.5])


def rectified():
    return closed_loop(random_loop(2, (4, 3), seed=2))


def bending(p, x, u):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + p * jnp.sin(x[0]) + 0.1 * u[0]])


def curved(p=0.5):
    plant = rj.NonlinearPlant(jax.tree_util.Partial(bending, jnp.asarray(p)), states=2, inputs=1)
    net = rj.MLP.from_layers([([[1.0, 0.5]], [0.0]), ([[-3.0]], [0.0])], rj.Tanh())
    return rj.ClosedLoop(plant, net)


KINDS = {
    "branches": lambda: rj.reach(rectified(), X0, 3, rj.Template.octagonal(2)),
    "disturbed": lambda: rj.reach(
        rectified().replace(noise=rj.Box([-0.01, -0.01], [0.01, 0.01])), X0, 3, BOX
    ),
    "saturating": lambda: rj.reach(polytope_loop(polygon(4)), rj.Box([-2, -2], [1, 2]), 3, BOX),
    "smooth": lambda: rj.reach(curved(), X0, 3, BOX, rj.BranchAndCut(cells=1)),
    "cells": lambda: rj.reach(curved(), WIDE, 3, BOX, rj.BranchAndCut(cells=12)),
    "forms": lambda: rj.reach(rectified(), X0, 3, BOX, rj.LinearBounds()),
    "programs": lambda: rj.reach(rectified(), X0, 3, BOX, rj.PaperQC(), 1),
    "windows": lambda: rj.reach(rectified(), X0, 3, BOX, rj.CuttingPlanes(rounds=1), 2),
    "ellipsoids": lambda: rj.reach(rectified(), X0, 3, rj.EllipsoidTemplate(), rj.LocalBounds(), 1),
    "mixed": lambda: rj.reach(rectified(), X0, 3, rj.MixedTemplate(BOX), rj.LocalBounds(), 1),
    "partition": lambda: rj.reach_partitioned(rectified(), X0, 3, BOX, cells=(2, 1)),
}


COSTLY = "windows", "ellipsoids", "mixed"
"""Kinds whose programs take seconds to compile; there are others by programs."""

EVERY = [pytest.param(kind, marks=[pytest.mark.costly] * (kind in COSTLY)) for kind in KINDS]


@functools.cache
def made(kind):
    return KINDS[kind]()


def parts_of(tube):
    return {
        "loop": tube.loop,
        "template": tube.template,
        "sets": tube.sets,
        "certificates": tube.certificates,
        "start": tube.start,
    }


def exchanged(these, *places):
    """A tuple whose entries at two places are exchanged."""
    found, (i, j) = list(these), places
    found[i], found[j] = found[j], found[i]
    return tuple(found)


def smaller(X, by=0.01):
    """A set that is smaller by a part of its width."""
    flat, ball = X.parts
    if flat is not None:
        A, b = flat.facets
        flat = rj.Polytope(A, b - by * (b + flat.support(-A)))
    if ball is not None:
        ball = ball.replace(shape=(1 - by) * ball.shape)
    return rj.Intersection(flat, ball) if flat and ball else flat or ball


def with_less(tube, k, witnesses=None):
    """A smaller set, and a certificate that says the same, perhaps with other witnesses."""
    X, proof = smaller(tube.sets[k]), tube.proof(k)
    flat, ball = X.parts
    bounds = np.array(proof.bounds)
    if flat is not None:
        bounds[: len(flat.facets[1])] = flat.facets[1]
    if ball is not None:
        proof = proof.replace(level=proof.level * np.sqrt(0.99))
        X_ball = rj.Ellipsoid.enclosing(proof.form, proof.level)
        X = rj.Intersection(flat, X_ball) if flat else X_ball
    proof = proof.replace(bounds=jnp.asarray(bounds))
    if witnesses is not None:
        proof = proof.replace(witnesses=jnp.full(len(bounds), witnesses))
    return at(tube, k, X, proof)


def at(tube, k, X=None, proof=None):
    sets, proofs = list(tube.sets), list(tube.certificates)
    sets[k], proofs[k] = X or sets[k], proof or proofs[k]
    return {"sets": tuple(sets), "certificates": tuple(proofs)}


def closer(tube, k):
    proof = tube.proof(k)
    gaps = np.asarray(proof.gaps)
    nearer = proof.witnesses + np.where(gaps > 1e-6, gaps / 2, 1e-3)
    return at(tube, k, proof=proof.replace(witnesses=nearer))


def moved(X, by):
    return X.replace(lower=X.lower + by, upper=X.upper + by)


def wider(X):
    return X.replace(lower=X.lower - X.widths / 4, upper=X.upper + X.widths / 4)


def another(loop):
    if isinstance(loop.plant, rj.AffinePlant):
        return loop.replace(plant=loop.plant.replace(A=1.7 * loop.plant.A))
    return curved(p=0.85)


CHANGES = {
    "a set made smaller": lambda tube: at(tube, 2, smaller(tube.sets[2])),
    "an initial set elsewhere": lambda tube: at(tube, 0, moved(tube.sets[0], 100.0)),
    "a larger initial set": lambda tube: at(tube, 0, wider(tube.sets[0])),
    "another loop": lambda tube: {"loop": another(tube.loop)},
    "certificates exchanged": lambda tube: {"certificates": exchanged(tube.certificates, 1, 2)},
    "steps exchanged": lambda tube: {
        "sets": exchanged(tube.sets, 1, 2),
        "certificates": exchanged(tube.certificates, 1, 2),
    },
    "a set left out": lambda tube: {"sets": tube.sets[:-1]},
    "another start": lambda tube: {"start": tube.start + 3},
    "lower bounds": lambda tube: with_less(tube, 3),
    "lower bounds and no witnesses": lambda tube: with_less(tube, 3, -1e300),
    "closer witnesses": lambda tube: closer(tube, 2),
}


def changed(tube, change):
    """A tube with one change, sealed again."""
    if isinstance(tube, rj.PartitionedTube):
        return rj.PartitionedTube.sealed(tube.X0, (changed(tube[0], change), *tube[1:]))
    return rj.ReachTube.sealed(**(parts_of(tube) | CHANGES[change](tube)))


def read(path, tube):
    tube.save(path)
    loop = tube[0].loop if isinstance(tube, rj.PartitionedTube) else tube.loop
    return rj.load(path, loop, recheck=True)


@pytest.mark.parametrize("kind", EVERY)
def test_a_tube_is_proved_anew(kind, tmp_path):
    tube = made(kind)
    again = read(tmp_path / "tube.reach", tube)
    assert jax.tree.structure(again) == jax.tree.structure(tube)
    pairs = zip(jax.tree.leaves(tube), jax.tree.leaves(again), strict=True)
    assert all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", EVERY)
def test_a_tube_that_was_changed_is_not(kind, change, tmp_path):
    with pytest.raises((rj.DisagreementError, rj.UnreadableError)):
        read(tmp_path / "tube.reach", changed(made(kind), change))


@pytest.mark.costly
def test_cells_that_leave_something_out(tmp_path):
    tube = made("partition")
    fewer = rj.PartitionedTube.sealed(tube.X0, tube.tubes[:1])
    with pytest.raises(rj.DisagreementError, match="are not shown to cover the initial set"):
        read(tmp_path / "tube.reach", fewer)
    larger = rj.PartitionedTube.sealed(wider(tube.X0), tube.tubes)
    with pytest.raises(rj.DisagreementError, match="are not shown to cover the initial set"):
        read(tmp_path / "tube.reach", larger)


@pytest.mark.costly
def test_a_disagreement_says_what_was_said_and_what_is_proved(tmp_path):
    """Of the unit ball in eight dimensions the sum of all entries is bounded by the root of 8."""
    A = np.zeros((8, 8))
    A[0] = 1.0
    ball = rj.Ellipsoid(np.zeros(8), np.eye(8))
    tube = rj.reach(autonomous(A), ball, 1, rj.Template.box(8))
    proof, X = tube.proof(1), tube.sets[1]
    facet = int(np.argmax(X.A[:, 0]))
    lower = X.b.at[facet].set(2.7)
    proof = proof.replace(bounds=lower, witnesses=jnp.full(len(lower), -1e300))
    parts = parts_of(tube) | at(tube, 1, X.replace(b=lower), proof)
    with pytest.raises(rj.DisagreementError, match=r"recheck of step 1 proves 2\.828") as caught:
        read(tmp_path / "tube.reach", rj.ReachTube.sealed(**parts))
    error = caught.value
    assert (error.step, error.facet, error.said) == (1, facet, 2.7)
    assert error.proved == pytest.approx(np.sqrt(8))
