"""Whatever a user's solver does, bounds hold: each fault is a failed proposal, with a warning."""

import dataclasses
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.proofs.recheck import interval_offsets
from tests.solvers.test_differentiable import TEMPLATE, planar
from tests.solvers.test_enclosures import case

FAILED = rj.SolverStatus.FAILED


class PanicException(BaseException):
    """What compiled code raises where it panics."""


@dataclasses.dataclass(frozen=True)
class Faulty(rj.AbstractSolver):
    """Clarabel, whose answers are spoilt."""

    spoil: Callable

    def solve(self, program, goal):
        return self.spoil(rj.Clarabel().solve(program, goal))


def raising(error):
    def spoil(found):
        raise error

    return spoil


def changed(**changes):
    """Fields replaced by functions of what they were."""

    def spoil(found):
        for name, change in changes.items():
            found = found._replace(**{name: change(np.asarray(getattr(found, name)))})
        return found

    return spoil


WRONG = {
    "nothing": (lambda found: None, "a Proposal was expected, but None arrived"),
    "a list": (lambda found: [1.0, 2.0], r"but \[1\.0, 2\.0\] arrived"),
    "a plain tuple": (tuple, "a Proposal was expected, but a tuple arrived"),
    "too few multipliers": (
        changed(multipliers=lambda y: y[..., 1:]),
        r"proposal\.multipliers must be numbers of shape \(\d, \d+\), but an array of shape",
    ),
    "ragged multipliers": (changed(multipliers=lambda y: [[1.0], [1.0, 2.0]]), "multipliers must"),
    "no multipliers": (changed(multipliers=lambda y: None), "but None arrived"),
    "text": (changed(multipliers=lambda y: y.astype(str)), "but an array of <U32 arrived"),
    "complex": (changed(multipliers=lambda y: y + 0j), "but an array of complex128 arrived"),
    "moments of another shape": (changed(moments=lambda X: X[..., :-1]), "proposal.moments must"),
    "seconds as text": (changed(seconds=lambda s: "soon"), "proposal.seconds must be numbers"),
    "statuses as text": (changed(statuses=lambda s: "optimal"), "statuses must be whole numbers"),
    "an unknown status": (changed(statuses=lambda s: 0 * s + 17), "is 17, which no solver's"),
    "a negative status": (changed(statuses=lambda s: 0 * s - 1), "is -1, which no solver's"),
    "multipliers that are NaN": (
        changed(multipliers=lambda y: np.nan * y),
        "the status of facet 0 is SOLVED, but its multipliers contain NaN or infinity",
    ),
    "infinite multipliers": (changed(multipliers=lambda y: y + np.inf), "NaN or infinity"),
    "an exception": (raising(ZeroDivisionError("my own")), "ZeroDivisionError was raised: my own"),
    "an IndexError": (raising(IndexError("out of range")), "IndexError was raised: out of range"),
    "a panic": (raising(PanicException("panicked")), "PanicException was raised: panicked"),
}
"""What is wrong, and what the warning says for facets."""


def tube_of(relaxation, solver, template=TEMPLATE):
    loop, X0 = planar(0)
    return rj.reach(loop, X0, 1, template, relaxation, 1, solver, samples=50)


@pytest.mark.parametrize("fault", WRONG)
@pytest.mark.parametrize("relaxation", [rj.LocalBounds(), rj.CuttingPlanes()], ids=str)
@pytest.mark.costly
def test_facets_of_a_faulty_solver_have_the_bound_that_needs_none(fault, relaxation):
    spoil, message = WRONG[fault]
    with pytest.warns(RuntimeWarning, match=rf"(?s)the solver Faulty counts as FAILED.*{message}"):
        tube = tube_of(relaxation, Faulty(spoil))
    proof = tube.proof(1)
    assert set(proof.statuses) == {FAILED}
    np.testing.assert_array_equal(proof.bounds, interval_offsets(jax.device_get(proof.program)))
    np.testing.assert_array_equal(proof.recheck(), proof.bounds)
    assert (proof.gaps >= 0).all()


@pytest.mark.parametrize("fault", WRONG)
@pytest.mark.parametrize("shape", [None, np.eye(2)], ids=["free", "given"])
@pytest.mark.costly
def test_ellipsoids_of_a_faulty_solver_hold(fault, shape):
    loop, X0 = case(2, 0, hidden=(3,))
    solver = Faulty(WRONG[fault][0])
    with pytest.warns(RuntimeWarning, match="the solver Faulty counts as FAILED"):
        region, proof = rj.reach_step(
            loop, X0, rj.EllipsoidTemplate(shape), solver=solver, samples=50
        )
    assert proof.statuses == (FAILED,)
    assert np.isfinite(region.shape).all()
    assert (proof.gaps >= 0).all()
    assert proof.recheck() <= 1


@pytest.mark.parametrize(
    "spoil",
    [
        lambda found: found._replace(unknowns=None),
        lambda found: found._replace(unknowns=[["A", "b"]]),
        lambda found: found._replace(unknowns=found.unknowns[:, 1:]),
    ],
    ids=["none", "text", "shape"],
)
@pytest.mark.costly
def test_a_form_that_is_none_is_a_fault(spoil):
    loop, X0 = case(2, 0, hidden=(3,))
    with pytest.warns(RuntimeWarning, match=r"proposal\.unknowns"):
        _, proof = rj.reach_step(loop, X0, rj.EllipsoidTemplate(), solver=Faulty(spoil), samples=50)
    assert proof.statuses == (FAILED,)


@pytest.mark.parametrize("fault", ["nothing", "too few multipliers", "an exception"])
@pytest.mark.costly
def test_faults_inside_jit_are_failed_proposals_too(fault):
    loop, X0 = planar(0)
    spoil, message = WRONG[fault]

    @jax.jit
    def bounds(net):
        tube = rj.reach(
            loop.replace(controller=net), X0, 1, TEMPLATE, rj.LocalBounds(), 1, Faulty(spoil)
        )
        return tube.sets[1].b, tube.proof(1).codes

    with pytest.warns(RuntimeWarning, match=f"(?s){message}"):
        offsets, codes = jax.block_until_ready(bounds(loop.controller))
    assert (codes == FAILED).all()
    proof = tube_of(rj.LocalBounds(), rj.Clarabel()).proof(1)
    plain = interval_offsets(jax.device_get(proof.program))
    np.testing.assert_allclose(offsets, plain, rtol=1e-12)


@pytest.mark.parametrize(
    "answer",
    [
        lambda found: None,
        lambda found: found._replace(multipliers=found.multipliers[:, 1:]),
        lambda found: found._replace(multipliers=jnp.nan * found.multipliers),
        lambda found: found._replace(statuses=0 * found.statuses + 17),
    ],
    ids=["nothing", "too few multipliers", "NaN", "unknown status"],
)
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.costly
def test_a_solver_may_be_wrong_in_a_compiled_step_too(answer, compiled):
    @dataclasses.dataclass(frozen=True)
    class Wrong(rj.AbstractSolver):
        def solve(self, program, goal):
            return answer(rj.Clarabel().solve(program, goal))

    loop, X0 = planar(0)

    def codes(net):
        closed = loop.replace(controller=net)
        tube = rj.reach(closed, X0, 1, TEMPLATE, rj.LocalBounds(), 1, Wrong(), samples=50)
        return tube.proof(1).codes

    with pytest.warns(RuntimeWarning, match="the solver Wrong counts as FAILED"):
        found = jax.block_until_ready((jax.jit(codes) if compiled else codes)(loop.controller))
    assert (np.asarray(found) == FAILED).all()


@pytest.mark.costly
def test_facets_that_are_no_numbers_leave_the_others_as_they_are():
    def spoil(found):
        found.multipliers[2, 0] = np.nan
        return found

    whole = tube_of(rj.LocalBounds(), rj.Clarabel()).proof(1)
    with pytest.warns(RuntimeWarning, match="the status of facet 2 is SOLVED"):
        proof = tube_of(rj.LocalBounds(), Faulty(spoil)).proof(1)
    others = np.arange(len(TEMPLATE)) != 2
    assert proof.statuses[2] is FAILED
    np.testing.assert_array_equal(proof.bounds[others], whole.bounds[others])
    assert proof.bounds[2] == interval_offsets(jax.device_get(proof.program))[2]


@pytest.mark.costly
def test_numbers_of_other_kinds_are_numbers():
    """Single precision, lists and whole numbers prove what they prove; none of them is a fault."""
    spoil = changed(
        multipliers=lambda y: y.astype(np.float32).tolist(),
        moments=lambda X: X.astype(np.float32),
        seconds=lambda s: np.ones(len(s), dtype=int),
        statuses=lambda s: list(map(rj.SolverStatus, s)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        proof = tube_of(rj.LocalBounds(), Faulty(spoil)).proof(1)
    assert set(proof.statuses) == {rj.SolverStatus.SOLVED}
    assert proof.multipliers.dtype == float


@pytest.mark.costly
def test_a_solver_that_says_that_it_failed_gives_no_warning():
    spoil = changed(multipliers=lambda y: np.nan * y, statuses=lambda s: 0 * s + 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        proof = tube_of(rj.LocalBounds(), Faulty(spoil)).proof(1)
    assert set(proof.statuses) == {rj.SolverStatus.INFEASIBLE}


@pytest.mark.costly
def test_auto_asks_the_other_solver_for_an_ellipsoid_where_one_is_at_fault():
    loop, X0 = case(2, 0, hidden=(3,))
    faulty = Faulty(raising(ValueError("broken")))
    for solver in (rj.Auto(small=faulty), rj.Auto(large=faulty)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            proof = rj.reach_step(loop, X0, rj.EllipsoidTemplate(), solver=solver, samples=50)[1]
        assert proof.statuses == (rj.SolverStatus.SOLVED,)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1)])
@pytest.mark.costly
def test_interrupts_pass(error):
    with pytest.raises(type(error)):
        tube_of(rj.LocalBounds(), Faulty(raising(error)))


@pytest.mark.costly
def test_options_that_a_solver_does_not_know_are_errors():
    with pytest.raises(TypeError, match="nonsense"):
        tube_of(rj.LocalBounds(), rj.CvxpySolver("CLARABEL", {"nonsense": 1}))
