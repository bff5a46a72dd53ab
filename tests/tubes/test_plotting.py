"""Pictures: the outline is the set's, the Axes come back, nothing global changes."""

import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest

import reachjax as rj
from tests.closed_loops import recursion

mpl.use("Agg")


def test_the_outline_of_a_polytope_is_its_corners_in_order():

    ax = rj.plot_set(rj.Polytope([[1, 1], [1, -1], [-1, 1], [-1, -1]], [1, 1, 1, 1]))
    outline = ax.patches[0].get_xy()[:-1]
    assert {tuple(np.round(corner, 9) + 0.0) for corner in outline} == {
        (1, 0),
        (0, 1),
        (-1, 0),
        (0, -1),
    }
    (x, y), (following_x, following_y) = outline.T, np.roll(outline, -1, axis=0).T
    assert np.all(x * following_y - y * following_x > 0)  # counter-clockwise around the origin


@pytest.mark.costly
def test_a_tube_is_drawn_on_the_axes_given():
    import matplotlib.pyplot as plt

    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    tube = recursion(loop, rj.Box([0.5, 0.5], [1, 1]), 2, rj.Template.box(2))
    _, ax = plt.subplots()
    assert rj.plot_tube(tube, ax, samples=50) is ax
    assert len(ax.patches) == 3
    assert len(ax.collections) == 3
    plt.close("all")


def outline(region, *coordinates):
    """The points drawn, and the Axes closed."""
    import matplotlib.pyplot as plt

    ax = rj.plot_set(region, coordinates=coordinates or None)
    plt.close("all")
    return np.asarray(ax.patches[0].get_xy()[:-1])


def test_the_shadow_of_an_ellipsoid_reaches_its_support_in_every_direction_of_the_plane():
    root = np.random.default_rng(0).normal(size=(6, 6))
    ellipsoid = rj.Ellipsoid(np.arange(6.0), root @ root.T)
    points = outline(ellipsoid, 4, 1)
    for angle in np.linspace(0, 2 * np.pi, 11):
        direction = np.array([np.cos(angle), np.sin(angle)])
        lifted = np.zeros((1, 6))
        lifted[0, [4, 1]] = direction
        reached = (points @ direction).max() - direction @ [4, 1]
        support = float(ellipsoid.support(lifted)[0]) - direction @ [4, 1]
        assert 0.999 * support <= reached <= support


def test_the_shadow_of_a_polytope_is_the_hull_of_its_shadowed_corners():
    octahedron = rj.Polytope(
        [[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], [1, 1, 1, 1, 1, 1, 1, 1]
    )
    points = outline(octahedron, 2, 0)
    assert {tuple(np.round(p, 9) + 0.0) for p in points} == {(1, 0), (0, 1), (-1, 0), (0, -1)}


def test_the_shadow_of_a_box_of_any_dimension_is_a_rectangle():
    lower = np.arange(40.0)
    points = outline(rj.Box(lower, lower + 0.5), 30, 2)
    assert {tuple(p) for p in points} == {(30, 2), (30.5, 2), (30, 2.5), (30.5, 2.5)}


def test_a_flat_set_is_drawn_as_a_line():
    prism = rj.Box([0, 0, 1], [1, 2, 1])
    assert {tuple(p) for p in outline(prism, 2, 1)} == {(1, 0), (1, 2)}
    assert {tuple(p) for p in outline(rj.Polytope(*prism.facets), 2, 1)} == {(1, 0), (1, 2)}


def test_the_coordinates_of_a_planar_set_may_be_swapped():
    assert {tuple(p) for p in outline(rj.Box([0, 1], [0, 3]), 1, 0)} == {(1, 0), (3, 0)}


def test_the_outline_of_an_intersection_is_what_the_outlines_of_its_parts_have_in_common():
    ball, box = rj.Ellipsoid([0, 0, 0], np.eye(3)), rj.Box([-2, -0.5, -2], [0.25, 2, 2])
    points = outline(rj.Intersection(box, ball), 0, 1)
    assert points[:, 0].max() == pytest.approx(0.25)
    assert points[:, 1].min() == pytest.approx(-0.5)
    np.testing.assert_allclose([points[:, 0].min(), points[:, 1].max()], [-1, 1], atol=1e-3)
    assert np.linalg.norm(points, axis=1).max() < 1.001
    (x, y), (following_x, following_y) = points.T, np.roll(points, -1, axis=0).T
    area = abs(np.sum(x * following_y - y * following_x)) / 2
    inside = np.random.default_rng(0).uniform([-1, -0.5], [0.25, 1], size=(100_000, 2))
    expected = 1.25 * 1.5 * np.mean(np.linalg.norm(inside, axis=1) <= 1)
    assert area == pytest.approx(expected, rel=0.01)
    line = outline(rj.Intersection(rj.Box([0.6, -2, 0], [0.6, 2, 0]), ball), 0, 1)
    np.testing.assert_allclose(line[:, 0], 0.6)
    np.testing.assert_allclose([line[:, 1].min(), line[:, 1].max()], [-0.8, 0.8], atol=1e-3)


def loop_of(states):
    net = rj.MLP.from_layers([(np.zeros((1, states)), [0.0])])
    return rj.ClosedLoop(rj.AffinePlant(np.eye(states) / 2, np.zeros((states, 1))), net)


@pytest.mark.parametrize(
    "template",
    [rj.Template.box(3), rj.EllipsoidTemplate(), rj.MixedTemplate(rj.Template.box(3))],
)
@pytest.mark.costly
def test_a_tube_of_three_states_is_drawn_on_the_coordinates_given(template):
    import matplotlib.pyplot as plt

    X0 = rj.Ellipsoid([1.0, 2.0, 3.0], np.diag([0.25, 1.0, 4.0]))
    ax = rj.plot_tube(recursion(loop_of(3), X0, 1, template), samples=50, coordinates=(2, 0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x_{3}$", "$x_{1}$")
    lower, upper = ax.patches[1].get_xy().min(axis=0), ax.patches[1].get_xy().max(axis=0)
    np.testing.assert_allclose([lower, upper], [[0.5, 0.25], [2.5, 0.75]], atol=1e-3)
    assert ax.collections[1].get_offsets().shape == (50, 2)
    plt.close("all")


@pytest.mark.costly
def test_what_cannot_be_drawn_is_refused():

    cube = rj.Box([0, 0, 0], [1, 1, 1])
    with pytest.raises(ValueError, match="dimension 3 arrived: choose the two coordinates"):
        rj.plot_set(cube)
    for wrong in [(0, 3), (1, 1), (0,), (0, 1, 2), (-1, 0), (0.5, 1), 1, "01"]:
        with pytest.raises(ValueError, match=r"two different ones of 0 \.\. 2, but .* arrived"):
            rj.plot_set(cube, coordinates=wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="two or more dimensions can be drawn, but 1 arrived"):
        rj.plot_set(rj.Box([0], [1]))
    tube = recursion(loop_of(1), rj.Box([0], [1]), 1, rj.Template.box(1))
    with pytest.raises(ValueError, match="two or more dimensions can be drawn, but 1 arrived"):
        rj.plot_tube(tube)
    with pytest.raises(ValueError, match="unbounded"):
        rj.plot_set(rj.Polytope([[1, 0]], [1]))


@pytest.mark.costly
def test_importing_the_package_changes_no_flag_and_loads_neither_cvxpy_nor_matplotlib():
    code = (
        "import sys, jax; before = dict(jax.config.values); import reachjax; "
        "assert dict(jax.config.values) == before; "
        "loaded = {'cvxpy', 'clarabel', 'matplotlib'} & set(sys.modules); assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
