"""Law: whatever a proof is given, multipliers, slopes or cells, it proves only what holds."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.cases import HORIZON, ROUNDING, each

KINDS = {
    "own": lambda own, rng: own,
    "normal": lambda own, rng: rng.normal(size=own.shape),
    "positive": lambda own, rng: rng.exponential(size=own.shape),
    "wrong signs": lambda own, rng: -own,
    "three times": lambda own, rng: 3 * own,
    "permuted": lambda own, rng: rng.permuted(own, axis=-1),
    "of others": lambda own, rng: own[::-1],
    "huge": lambda own, rng: 1e200 * rng.normal(size=own.shape),
    "beyond all numbers": lambda own, rng: 1e308 * rng.choice([-1.0, 1.0], size=own.shape),
    "tiny": lambda own, rng: 1e-300 * rng.normal(size=own.shape),
    "nothing": lambda own, rng: 0 * own,
    "ones": lambda own, rng: 1 + 0 * own,
}
NO_NUMBERS = np.nan, np.inf, -np.inf


def own(proof):
    """What a proof takes for its recheck, and its name."""
    (name,) = inspect.signature(type(proof).recheck).parameters.keys() - {"self"}
    found = proof.axes if name == "axes" else getattr(proof, name)
    return name, np.asarray(found)


def attained(case, k):
    """The largest values of what a set bounds, on trajectories, less their rounding."""
    values = np.asarray(case.tube.sets[k].bounded_values(case.runs[:, k])).max(axis=0)
    return values - ROUNDING * np.maximum(1.0, abs(values))


@each(lambda case: not case.searches_cells)
def test_bounds_by_garbage_hold(case):
    rng = np.random.default_rng(0)
    for k in range(1, HORIZON + 1):
        proof, least = case.tube.proof(k), attained(case, k)
        _, given = own(proof)
        for kind, change in KINDS.items():
            found = proof.recheck(change(given, rng))
            assert np.all(found >= least), (k, kind)
            assert not np.isnan(found).any()
            if kind == "own":
                np.testing.assert_array_equal(found, proof.recheck())


@each(lambda case: case.method in ("forms", "programs", "paper") and not case.round, every=2)
def test_bounds_are_those_of_what_a_proof_is_given(case):
    """Of garbage they are looser, and of a proof that has it as its own the same."""
    proof, rng = case.tube.proof(HORIZON), np.random.default_rng(0)
    name, given = own(proof)
    garbage = KINDS["normal"](given, rng)
    loose = proof.recheck(garbage)
    np.testing.assert_array_equal(proof.replace(**{name: garbage}).recheck(), loose)
    assert np.all(loose >= proof.witnesses - ROUNDING * np.maximum(1.0, abs(proof.witnesses)))
    if case.of.plain is not None and case.initial not in ("point", "flat", "thin"):
        # other units may leave slopes no choice
        assert np.any(loose > proof.bounds + 1e-9), "other slopes or multipliers change nothing"


def by_cells(proof, axes):
    """What cells prove; infinite where the set reaches one half only, so that they are no tree."""
    try:
        return proof.recheck(axes)
    except ValueError:
        return np.full(np.shape(proof.bounds), np.inf)


def allowed(case):
    """How many cells a row's method may make."""
    method = case.options.get("relaxation", rj.BranchAndCut())
    return method.most if isinstance(method, rj.Cells) else method.cells


@each(lambda case: case.searches_cells)
def test_bounds_by_any_cells_hold(case):
    rng, n = np.random.default_rng(0), case.closed_loop.states
    trees = [[-1], [0, -1, -1], [*rng.integers(n, size=2).tolist(), -1, -1, -1]]
    proofs = [case.tube.proof(k) for k in range(1, HORIZON + 1)]
    for k, proof in enumerate(proofs, start=1):
        if not isinstance(proof, rj.CellCertificate):
            continue  # nothing was left for cells to close
        found = [by_cells(proof, axes) for axes in trees]
        assert np.all(found >= attained(case, k))
        assert np.isfinite(found[0]).all()
        assert np.all(found[0] >= proof.bounds - ROUNDING * np.maximum(1.0, abs(proof.bounds)))
        own = np.count_nonzero(np.asarray(proof.axes) == -1)  # others are left aside, at no cost
        assert 1 <= own <= min(proof.cells, allowed(case))


@each()
def test_what_is_no_number_is_refused(case):
    for k in range(1, HORIZON + 1):
        proof = case.tube.proof(k)
        name, given = own(proof)
        if name == "axes" or not given.size:
            continue
        for bad in NO_NUMBERS:
            garbage = np.array(given, float)
            garbage.flat[garbage.size // 2] = bad
            with pytest.raises(ValueError, match=rf"{name}.*(finite|NaN)"):
                proof.recheck(garbage)
            if not isinstance(proof, rj.BranchCertificate):  # forms bound its facets as well
                with pytest.raises(ValueError, match=rf"{name}.*(finite|NaN)"):
                    proof.replace(**{name: garbage}).recheck()


@each()
def test_another_shape_is_refused(case):
    proof = case.tube.proof(HORIZON)
    name, given = own(proof)
    if name == "axes":
        bad = [], [0], [0, -1], [0, -1, -1, -1], [7, -1, -1], [-2], [-1, -1], [0, 0, -1, -1]
    else:
        bad = given[:, :-1], given[0], given[None], np.zeros((len(given) + 1, given.shape[1]))
    for each_bad in bad:
        if name == "axes" or np.shape(each_bad) != given.shape:
            with pytest.raises(ValueError, match=rf"{name} must"):
                proof.recheck(each_bad)


def test_cells_over_which_a_unit_has_no_bounds_prove_nothing():
    def f(x, u):
        apart = x[0] * x[0] - 2 * x[0] * x[1] + x[1] * x[1]  # a square, which bounds do not know
        return jnp.array([0.1 / (0.05 + apart), 0.5 * x[1]]) + 0 * u

    loop = rj.ClosedLoop(rj.NonlinearPlant(f, 2, 1), rj.Network(lambda x: x[:1], 2, 1))
    X0, few = rj.Box([0.0, 0.0], [1.0, 1.0]), rj.BranchAndCut(cells=32)
    proof = rj.reach(loop, X0, 1, rj.Template.box(2), few).proof(1)
    assert isinstance(proof, rj.CellCertificate)
    assert np.isfinite(proof.recheck()).all()
    assert np.isposinf(proof.recheck([-1])).all()
