"""Claims about templates: their directions, and that they bound a polytope."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

PAPER = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, -1], [-1, 1], [1, 1], [-1, -1]]


def test_the_octagonal_template_in_the_plane_is_the_papers_in_its_order():
    np.testing.assert_array_equal(rj.Template.octagonal(2).directions, PAPER)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_octagonal_template_holds_every_axis_and_every_pair_once(n):
    directions = np.asarray(rj.Template.octagonal(n).directions)
    rows = set(map(tuple, directions + 0.0))  # no negative zeros
    assert len(rows) == len(directions) == 2 * n**2
    assert np.isin(directions, [-1, 0, 1]).all()
    assert set(np.abs(directions).sum(axis=1)) <= {1.0, 2.0}


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_box_template_has_the_facets_of_a_box(n):
    template = rj.Template.box(n)
    assert (len(template), template.dimension) == (2 * n, n)
    box = template.polytope(jnp.ones(2 * n)).bounding_box()
    np.testing.assert_allclose(box.lower, -1.0)
    np.testing.assert_allclose(box.upper, 1.0)
    assert template.polytope(jnp.ones(2 * n)).volume() == pytest.approx(2.0**n)


@pytest.mark.parametrize("facets", [3, 4, 5, 8, 12])
def test_a_regular_template_bounds_a_regular_polygon(facets):
    template = rj.Template.regular(facets)
    np.testing.assert_allclose(template.directions[0], [1.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(template.directions, axis=1), 1.0)
    area = facets * np.tan(np.pi / facets)  # around the unit circle
    assert template.polytope(jnp.ones(facets)).volume() == pytest.approx(area)


def test_a_polytope_of_a_template_has_its_directions_and_the_offsets_given():
    offsets = jnp.arange(1.0, 9.0)
    polytope = rj.Template.octagonal(2).polytope(offsets)
    np.testing.assert_array_equal(polytope.A, PAPER)
    np.testing.assert_array_equal(polytope.b, offsets)


UNBOUNDED = {
    "a half-plane": [[1.0, 0.0]],
    "a strip": [[1.0, 0.0], [-1.0, 0.0]],
    "a quadrant": [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
    "open below": [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]],
    "open along a diagonal": [[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]],
}


@pytest.mark.parametrize("directions", UNBOUNDED.values(), ids=UNBOUNDED.keys())
def test_directions_that_bound_no_set_are_refused(directions):
    with pytest.raises(ValueError, match=r"Template.directions do not bound a set: .*unbounded"):
        rj.Template(directions)


def test_directions_may_be_traced():
    norms = jax.jit(lambda d: jnp.linalg.norm(rj.Template(d).directions, axis=1))
    np.testing.assert_allclose(norms(jnp.array(PAPER, float))[-1], np.sqrt(2))
