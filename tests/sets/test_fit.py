"""Adapted templates: directions that bound a set and fit what is simulated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import reachjax as rj
from reachjax.sets import fit
from tests.closed_loops import autonomous, closed_loop, random_loop
from tests.networks import box_region, simulate

HORIZON = 3


def case(n_x, seed=0, steps=None):
    """Arrays of a loop, the loop, and its initial box."""
    data, corners = random_loop(n_x, seed=seed, steps=steps), box_region(n_x, seed).corners
    return data, closed_loop(data), rj.Box(corners.min(axis=0), corners.max(axis=0))


def polygon_area(A, points):
    """The area of the polygon whose edges have these normals and touch the points."""
    return rj.Polytope(A, (points @ np.asarray(A).T).max(axis=0)).volume()


@pytest.mark.parametrize(
    ("n_x", "facets"), [(1, 2), (2, 3), (2, 12), (2, 31), (3, 6), (3, 12), (6, 12), (6, 72)]
)
def test_each_step_has_as_many_unit_directions_as_asked_for(n_x, facets):
    _, loop, X0 = case(n_x)
    template = rj.Template.adapted(loop, X0, HORIZON, facets=facets)
    assert template.directions.shape == (HORIZON, facets, n_x)
    assert template.steps == HORIZON
    assert template.dimension == n_x
    assert len(template) == facets
    np.testing.assert_allclose(np.linalg.norm(template.directions, axis=-1), 1.0, atol=1e-12)
    for k in range(1, HORIZON + 1):
        np.testing.assert_array_equal(template.at(k).directions, template.directions[k - 1])
        # bounded, or there would be no box around it
        box = template.at(k).polytope(jnp.ones(facets)).bounding_box()
        assert np.isfinite(box.widths).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.costly
def test_in_the_plane_they_fit_better_than_regular_directions(seed):
    data, loop, X0 = case(2, seed)
    template = rj.Template.adapted(loop, X0, HORIZON)
    many = rj.Template.adapted(loop, X0, HORIZON, samples=20_000)
    regular = rj.Template.regular(12).directions
    ends = simulate(data, np.asarray(X0.sample(jax.random.key(7), 20_000)), HORIZON)
    for k in range(1, HORIZON + 1):
        hull = ConvexHull(ends[k]).volume  # the area
        excess = polygon_area(regular, ends[k]) / hull - 1
        assert polygon_area(template.at(k).directions, ends[k]) / hull - 1 <= 0.2 * excess
        # what is left is that these samples are others than those that it was fitted to
        assert polygon_area(many.at(k).directions, ends[k]) / hull - 1 <= 0.025


@pytest.mark.parametrize("n_x", [3, 6])
def test_in_more_dimensions_they_fit_better_than_fixed_axes(n_x):
    data, loop, X0 = case(n_x, seed=1)
    template, box = rj.Template.adapted(loop, X0, HORIZON, facets=2 * n_x), rj.Template.box(n_x)
    ends = simulate(data, np.asarray(X0.sample(jax.random.key(7), 20_000)), HORIZON)

    def volume(rows):
        # that of a parallelepiped: its widths over the determinant of its normals
        rows = np.asarray(rows)[::2]
        return np.prod(np.ptp(ends[HORIZON] @ rows.T, axis=0)) / abs(np.linalg.det(rows))

    assert volume(template.at(HORIZON).directions) < volume(box.directions)


def test_edges_of_a_polygon_are_found():
    normals = fit.plane(7)
    corners = rj.Polytope(normals, np.ones(7)).vertices()
    weights = np.random.default_rng(0).dirichlet(np.ones(7), size=500)
    found = fit.edges(np.vstack([corners, weights @ np.asarray(corners)]), 7)
    order = np.argsort((np.arctan2(found[:, 1], found[:, 0]) + 1e-9) % (2 * np.pi))
    np.testing.assert_allclose(found[order], normals, atol=1e-9)


def test_points_on_a_line_far_from_zero_have_directions_that_bound_a_set():
    # rounding makes a hull of them, whose edges nearly are the line
    rng = np.random.default_rng(5)
    for facets in (3, 4, 6, 12):
        for _ in range(25):
            at, along = rng.normal(size=2), rng.normal(size=2) * 10 ** rng.uniform(-9, -3)
            points = at + rng.uniform(-1, 1, size=(50, 1)) * along
            box = rj.Template(fit.edges(points, facets)).polytope(np.ones(facets)).bounding_box()
            assert np.isfinite(box.widths).all()


def test_the_edges_left_out_are_those_that_cost_least():
    # a square with one corner cut off a little
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.9], [0.9, 1.0], [0.0, 1.0]])
    found = fit.edges(points, 4)
    assert {tuple(row) for row in np.round(found, 9) + 0.0} == {(1, 0), (-1, 0), (0, 1), (0, -1)}


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_do_not_matter(scale):
    points = np.random.default_rng(0).normal(size=(200, 2)) @ [[1.0, 0.3], [0.0, 0.2]]
    plain, scaled = fit.edges(points, 8), fit.edges(points * [1.0, scale], 8)
    areas = [polygon_area(rows, points) for rows in (plain, scaled * [1.0, scale])]
    assert areas[1] == pytest.approx(areas[0], rel=1e-6)


@pytest.mark.parametrize("n_x", [1, 2, 3])
@pytest.mark.parametrize("kind", ["point", "segment"])
def test_flat_sets_have_directions_all_the_same(n_x, kind):
    _, loop, X0 = case(n_x)
    upper = X0.lower if kind == "point" else X0.lower.at[0].set(X0.upper[0])
    template = rj.Template.adapted(
        loop, X0.replace(upper=upper), HORIZON, facets=2 * n_x + 2 * (n_x > 1)
    )
    assert np.isfinite(template.directions).all()
    np.testing.assert_allclose(np.linalg.norm(template.directions, axis=-1), 1.0, atol=1e-12)


def test_the_same_seed_has_the_same_directions():
    _, loop, X0 = case(2)
    first, again, other = (
        rj.Template.adapted(loop, X0, HORIZON, seed=seed).directions for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_a_time_varying_loop_is_simulated_from_its_start():
    _, loop, X0 = case(2, steps=5)
    early, late = (rj.Template.adapted(loop, X0, 2, start=start) for start in (0, 3))
    assert np.any(early.directions != late.directions)
    with pytest.raises(ValueError, match="5 time steps"):
        rj.Template.adapted(loop, X0, 2, start=4)


@pytest.mark.parametrize(
    ("n_x", "options", "error", "words"),
    [
        (1, {"facets": 1}, ValueError, "facets must be at least 2"),
        (1, {"facets": 3}, ValueError, "facets must be an even number of 2 to 2"),
        (2, {"facets": 2}, ValueError, "facets must be at least 3"),
        (3, {"facets": 4}, ValueError, "facets must be at least 6"),
        (3, {"facets": 7}, ValueError, "facets must be an even number of 6 to 18"),
        (3, {"facets": 20}, ValueError, "facets must be an even number of 6 to 18"),
        (2, {"facets": 8.0}, TypeError, "facets"),
        (2, {"samples": 2}, ValueError, "samples must be at least 3"),
        (2, {"horizon": 0}, ValueError, "horizon must be at least 1"),
        (2, {"X0": rj.Box([0.0], [1.0])}, ValueError, "the dimension of X0 is 1"),
    ],
)
def test_bad_arguments_are_named(n_x, options, error, words):
    _, loop, X0 = case(n_x)
    with pytest.raises(error, match=words):
        rj.Template.adapted(**{"loop": loop, "X0": X0, "horizon": 2, **options})


def test_a_template_of_fewer_steps_than_the_horizon_is_an_error():
    _, loop, X0 = case(2)
    template = rj.Template.adapted(loop, X0, 2)
    with pytest.raises(ValueError, match="template is given for 2 steps, but horizon is 3"):
        rj.reach(loop, X0, 3, template)


@pytest.mark.costly
def test_a_tube_in_one_shot_has_about_the_area_of_the_states():
    data, (_, _, X0) = random_loop(2, hidden=(4,), seed=1), case(2)
    loop = closed_loop(data)
    template = rj.Template.adapted(loop, X0, 2, facets=8)
    tube = rj.reach(loop, X0, 2, template)  # exact: what is left over is the template's
    ends = simulate(data, np.asarray(X0.sample(jax.random.key(7), 50_000)), 2)
    for k in (1, 2):
        # eight edges, chosen with 1000 samples, against a hull that 50,000 fill but for 1 %
        assert tube.sets[k].volume() <= 1.06 * ConvexHull(ends[k]).volume
        assert np.asarray(tube.sets[k].contains(ends[k], 1e-12)).all()


@pytest.mark.parametrize(("n_x", "facets"), [(1, 2), (2, 12), (3, 12), (7, 14)])
def test_the_default_number_of_facets_is_twelve_or_the_nearest_that_bounds(n_x, facets):
    loop, X0 = autonomous(0.5 * np.eye(n_x)), rj.Box(-np.ones(n_x), np.ones(n_x))
    assert rj.Template.adapted(loop, X0, 1).directions.shape == (1, facets, n_x)


def test_three_facets_of_a_parallelogram_bound_it():
    loop = autonomous([[1.0, 1.0], [0.0, 1.0]])
    template = rj.Template.adapted(loop, rj.Box([-1.0, -1.0], [1.0, 1.0]), 1, facets=3)
    assert np.isfinite(template.at(1).polytope(np.ones(3)).volume())
