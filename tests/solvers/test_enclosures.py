"""Ellipsoids around successors: sound whatever is proposed, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.proposal import Proposal
from reachjax.proofs.recheck import sound_level
from reachjax.proofs.reported import judged_least
from reachjax.sets import NormalForm
from reachjax.solvers import LeastVolume
from reachjax.solvers.ellipsoids import form_of
from tests.closed_loops import closed_loop, random_loop, recursion, step_program
from tests.differences import error_in_all_parts


def ellipsoid(n, seed, size=0.3):
    rng = np.random.default_rng(seed)
    L = np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.5, 1.0, n) * size
    return rj.Ellipsoid(0.3 * rng.normal(size=n), L @ L.T)


def case(n, seed=0, hidden=(4, 3)):
    return closed_loop(random_loop(n, hidden=hidden, seed=seed)), ellipsoid(n, seed)


def program(loop, X, relaxation=rj.LocalBounds()):  # noqa: B008
    rows = jnp.eye(loop.states)
    return jax.device_get(step_program(loop, X, X.bounding_box(), rows, 0, relaxation))


@pytest.fixture(scope="module", params=[1, 2, 3, 6])
def solved(request):
    """(loop, set, its program, what Clarabel proposes)."""
    loop, X = case(request.param, seed=request.param)
    held = program(loop, X)
    return loop, X, held, rj.Clarabel().solve(held, LeastVolume())


def successors(loop, X, count=4000):
    key = jax.random.key(1)
    states = jnp.concatenate([X.sample_boundary(key, count), X.sample(key, count)])
    return jax.vmap(lambda x: loop.step(x, 0))(states)


def test_any_multipliers_prove_a_level_that_no_trajectory_exceeds(solved):
    loop, X, held, enclosure = solved
    reached, rng = np.asarray(successors(loop, X)), np.random.default_rng(0)
    K, q = enclosure.multipliers.shape, loop.states
    forms = [
        form_of(enclosure.unknowns[0]),
        NormalForm(rng.normal(size=(q, q)), rng.normal(size=q)),
    ]
    garbage = [
        np.zeros(K),
        enclosure.multipliers,
        -enclosure.multipliers,
        1e3 * enclosure.multipliers,
        rng.normal(size=K),
        1e200 * rng.normal(size=K),
    ]
    for A, b in forms:
        largest = np.linalg.norm(reached @ A.T + b, axis=1).max()
        for multipliers in garbage:
            assert sound_level(held, multipliers, NormalForm(A, b)) >= largest


def test_what_clarabel_proposes_is_proved_nearly_as_it_stands(solved):
    _, _, held, enclosure = solved
    form = form_of(enclosure.unknowns[0])
    value, optimal = judged_least(held, enclosure, form)
    assert optimal
    assert 1.0 <= value.level <= 1 + 1e-6
    np.testing.assert_array_equal(value.form.A, form.A)


@pytest.mark.parametrize("broken", ["nothing", "nan", "singular", "tiny", "huge"])
@pytest.mark.costly
def test_whatever_form_is_proposed_the_ellipsoid_holds_the_successors(solved, broken):
    loop, X, held, enclosure = solved
    A, b = form_of(enclosure.unknowns[0])
    nothing = Proposal.blank(held, LeastVolume())
    proposed = {
        "nothing": (nothing, form_of(nothing.unknowns[0])),
        "nan": (enclosure, NormalForm(np.nan * A, b)),
        "singular": (enclosure, NormalForm(0.0 * A, b)),
        "tiny": (enclosure, NormalForm(1e-9 * A, 1e-9 * b)),
        "huge": (enclosure, NormalForm(1e9 * A, 1e9 * b)),
    }[broken]
    value, optimal = judged_least(held, *proposed)
    assert not optimal
    region = rj.Ellipsoid.enclosing(NormalForm(*map(jnp.asarray, value.scaled)), value.level)
    assert region.contains(successors(loop, X)).all()


def test_a_wrong_shape_of_multipliers_is_named(solved):
    _, _, held, enclosure = solved
    form = form_of(enclosure.unknowns[0])
    with pytest.raises(ValueError, match=r"multipliers must have shape \(1, \d+\)"):
        sound_level(held, enclosure.multipliers[0], form)
    with pytest.raises(ValueError, match="multipliers of program 0 contain NaN or infinity"):
        sound_level(held, np.nan * enclosure.multipliers, form)


def final(template, horizon, solver=rj.Auto(), relaxation=rj.LocalBounds()):  # noqa: B008
    """A number that depends on centre and shape of the last set, and on all volumes."""

    def f(loop, X0):
        tube = recursion(loop, X0, horizon, template, relaxation, solver=solver)
        n, last = loop.states, tube.sets[-1]
        weights = jnp.asarray(np.random.default_rng(n).normal(size=(n, n)))
        linear = last.center @ jnp.arange(1.0, n + 1) + jnp.sum(weights * last.shape)
        return rj.log_volume(tube) + linear

    return f


# A reported ellipsoid is the point on the central path to rounding, one of a given shape the
# solver's to 1e-8 or so: differences over 1e-5 are good to 1e-3. Kinks nearer than ten times that
# would show as errors of order one; loops are chosen whose sets stay small, for the digits of their
# values.
STEP, PROMISED = 1e-5, 1e-3
TEMPLATES = ("minimum volume", "given shape")
SHORT = [(3, 1, 0, "given shape"), (2, 3, 0, "minimum volume")]
LONG = [
    (3, 1, 0, "minimum volume"),
    *((n, 1, 0, template) for n in (1, 2) for template in TEMPLATES),
    (2, 3, 0, "given shape"),
    *((2, 10, 1, template) for template in TEMPLATES),
]


@pytest.mark.parametrize(
    ("n", "horizon", "seed", "template"),
    [*SHORT, *(pytest.param(*args, marks=pytest.mark.long) for args in LONG)],
)
@pytest.mark.costly
def test_the_gradient_is_the_central_difference(n, horizon, seed, template):
    f = final(rj.EllipsoidTemplate(np.eye(n) if template == "given shape" else None), horizon)
    args = case(n, seed)
    gradient = jax.grad(f, argnums=(0, 1))(*args)
    assert error_in_all_parts(f, args, gradient, STEP) <= PROMISED
