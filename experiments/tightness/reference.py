"""What certified sets are compared with: the tightest ones of their template, as far as known.

The largest value of every facet that any trajectory is known to attain: by exact maximisation where
that is affordable, else by simulation, by ascents from the best samples, and by the witnesses of
all methods. No sound bound is smaller.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj
from experiments import stored
from experiments.tightness.cases import Group, Settings
from experiments.tightness.exact import exact_tube
from experiments.tightness.methods import Measurement, fingerprint

TOLERANCE = 1e-9
"""What a bound may lack of the largest value known, for rounding, as a part of it."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The largest values known, and whether they are the exact maxima."""

    values: Float[ndarray, "loops horizon m"]
    exact: bool

    def excess(self, measured: Measurement, group: Group) -> Float[ndarray, "loops horizon"]:
        """By which part a certified set is larger: in area, or the worst of a box's widths."""
        sizes = [
            [[_sizes(group.template, offsets) for offsets in loop] for loop in each]
            for each in (measured.bounds, self.values)
        ]
        certified, tightest = np.array(sizes)
        return (certified / tightest).max(axis=-1) - 1

    def slack(self, measured: Measurement) -> float:
        """The smallest bound less the largest value known, as a part of the facets' largest."""
        scale = abs(self.values).max(axis=-1, keepdims=True)
        return float(((measured.bounds - self.values) / scale).min())


@dataclass(frozen=True, eq=False)
class Result:
    """A group, what each method certifies of it, and what that is compared with."""

    group: Group
    measured: dict[str, Measurement]
    reference: Reference

    def excess(self, name: str) -> Float[ndarray, "loops horizon"]:
        """By which part a method's sets are larger than the tightest."""
        return self.reference.excess(self.measured[name], self.group)

    def slacks(self) -> dict[str, float]:
        """Each method's smallest bound less the largest value known."""
        return {name: self.reference.slack(each) for name, each in self.measured.items()}

    @property
    def sound(self) -> bool:
        """Whether no bound is below a value that is attained, up to rounding."""
        return all(slack >= -TOLERANCE for slack in self.slacks().values())


def _sizes(template: rj.Template, offsets: Float[ndarray, " m"]) -> list[float]:
    """The area in the plane, otherwise the widths between opposite facets."""
    if template.dimension == 2:
        return [template.polytope(jnp.asarray(offsets)).volume()]
    normals = np.asarray(template.directions)
    opposite = np.argmin(np.linalg.norm(normals[:, None] + normals, axis=-1), axis=1)
    return (offsets + offsets[opposite]).tolist()


def reference(group: Group, measured: dict[str, Measurement], settings: Settings) -> Reference:
    """The largest values known; those that no method found are kept in a file."""
    exact = group.units <= settings.exact_units and isinstance(group.X0, rj.Box)
    path = settings.output / "measured" / f"{group.name.replace(' ', '_')}_reference.npz"
    made_with = fingerprint(group) | {"samples": settings.samples, "exact": exact}
    kept = stored.load(path, made_with)
    if kept is None:
        values = np.array([_attained(loop, group, settings) for loop in group.loops])
        if exact:
            values = np.maximum(values, [_maxima(loop, group) for loop in group.loops])
        kept = {"values": values}
        stored.save(path, made_with, **kept)
    values = np.max([kept["values"], *(each.witnesses for each in measured.values())], axis=0)
    return Reference(values, exact)


def _attained(loop: rj.ClosedLoop, group: Group, settings: Settings) -> Float[ndarray, "horizon m"]:
    """By simulation, and by ascents from the best samples: the witnesses of a tube of many."""
    light, samples = rj.CuttingPlanes(rounds=0), settings.samples
    task = loop, group.X0, group.horizon, group.template, light, None
    tube = rj.reach(*task, samples=samples)
    return np.array([tube.proof(t).witnesses for t in range(1, group.horizon + 1)])


def _maxima(loop: rj.ClosedLoop, group: Group) -> Float[ndarray, "horizon m"]:
    """By mixed-integer programming."""
    assert isinstance(group.X0, rj.Box)
    found = exact_tube(loop, group.X0, group.horizon, group.template.directions)
    found.require_sharp()
    return found.values
