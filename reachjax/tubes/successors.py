"""The smallest set of a template that surely holds the successors of a step, and its proof."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from reachjax.numerics.checks import is_concrete
from reachjax.numerics.host import all_finite
from reachjax.programs.lmi import Program
from reachjax.programs.relaxations import CuttingPlanes
from reachjax.proofs.certificates import AbstractCertificate
from reachjax.proofs.ellipsoids import EllipsoidCertificate
from reachjax.proofs.facets import Certificate
from reachjax.proofs.mixed import MixedCertificate
from reachjax.sets import (
    AbstractSet,
    AbstractTemplate,
    Ellipsoid,
    EllipsoidTemplate,
    Intersection,
    MixedTemplate,
    Polytope,
    Template,
)
from reachjax.solvers import (
    proved_ellipsoid,
    proved_offsets,
    proved_size,
    proved_with_cuts,
    with_cuts_around,
)
from reachjax.tubes.steps import Step


def successors(step: Step, template: AbstractTemplate) -> tuple[AbstractSet, AbstractCertificate]:
    """The smallest set of a template that surely holds a step's successors, and its proof.

    Raises:
        TypeError: the template is of an unknown kind.
        ValueError: the set of states is empty or unbounded, or states overflow.
    """
    if isinstance(template, Template):
        return _polytope(step, template, step.program(template.directions))
    successor = jnp.eye(step.setting.loop.states)
    if isinstance(template, EllipsoidTemplate):
        return _ellipsoid(step, template, step.program(successor))
    if isinstance(template, MixedTemplate):
        directions = jnp.concatenate([template.facets.directions, successor])
        return _intersection(step, template, step.program(directions))
    raise TypeError(f"there is no step for templates of kind {type(template).__name__}")


def _require_finite(step: Step, numbers) -> None:
    fixed = jax.lax.stop_gradient(numbers)
    if is_concrete(fixed) and not all_finite(jax.device_get(fixed)):
        raise ValueError(
            f"the loop's states at t = {step.t + 1} overflow or are not numbers: check the "
            "weights of loop.controller and the entries of loop.plant"
        )


def _polytope(step: Step, template: Template, program: Program) -> tuple[Polytope, Certificate]:
    """Problem (sdp::poly): the smallest offset for each facet."""
    setting = step.setting
    _require_finite(step, program)
    if isinstance(setting.relaxation, CuttingPlanes):
        witness = None if setting.simulations is None else partial(step.attained, template)
        program, offsets, solution = proved_with_cuts(
            program, step.window.layout, setting.solver, setting.relaxation, witness, step.offered
        )
    else:
        offsets, solution = proved_offsets(program, setting.solver)
    _require_finite(step, offsets)
    certificate = Certificate.from_solution(program, offsets, solution)
    return template.polytope(offsets), certificate


def _ellipsoid(
    step: Step, template: EllipsoidTemplate, program: Program
) -> tuple[Ellipsoid, EllipsoidCertificate]:
    """Problem (sdp::ellips): the minimum volume, or the smallest size of a given shape."""
    setting, form = step.setting, None
    if template.shape is not None:
        middle = step.X.center if isinstance(step.X, Ellipsoid) else step.box.center
        form = Ellipsoid(setting.loop.step(middle, step.t), template.shape).normal_form
    _require_finite(step, program)
    if isinstance(setting.relaxation, CuttingPlanes):
        program = with_cuts_around(
            program, step.window.layout, setting.solver, setting.relaxation, form
        )
    if form is None:
        form, level, enclosure = proved_ellipsoid(program, setting.solver)
    else:
        form, level, enclosure = proved_size(program, form, setting.solver)
    region = Ellipsoid.enclosing(form, level)
    _require_finite(step, region.shape)
    return region, EllipsoidCertificate.from_enclosure(program, form, level, enclosure)


def _intersection(
    step: Step, template: MixedTemplate, program: Program
) -> tuple[Intersection, MixedCertificate]:
    """Both problems, over the same facts."""
    m = len(template.facets)
    polytope, first = _polytope(step, template.facets, program.seeking(slice(m)))
    ellipsoid, second = _ellipsoid(step, template.ellipsoid, program.seeking(slice(m, None)))
    return Intersection(polytope, ellipsoid), MixedCertificate.joining(program, first, second)
