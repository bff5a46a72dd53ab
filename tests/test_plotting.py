"""Pictures: the outline is the set's, the Axes come back, nothing global changes."""

import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest

import reachjax as rj

mpl.use("Agg")


def test_the_outline_of_a_polytope_is_its_corners_in_order():
    from reachjax.plotting import plot_set

    ax = plot_set(rj.Polytope([[1, 1], [1, -1], [-1, 1], [-1, -1]], [1, 1, 1, 1]))
    outline = ax.patches[0].get_xy()[:-1]
    assert {tuple(np.round(corner, 9) + 0.0) for corner in outline} == {
        (1, 0),
        (0, 1),
        (-1, 0),
        (0, -1),
    }
    (x, y), (following_x, following_y) = outline.T, np.roll(outline, -1, axis=0).T
    assert np.all(x * following_y - y * following_x > 0)  # counter-clockwise around the origin


def test_a_tube_is_drawn_on_the_axes_given():
    import matplotlib.pyplot as plt

    from reachjax.plotting import plot_tube

    net = rj.MLP.from_layers([(np.zeros((1, 2)), [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant(np.eye(2) / 2, np.zeros((2, 1))), net)
    tube = rj.reach(loop, rj.Box([0.5, 0.5], [1, 1]), 2, rj.Template.box(2))
    _, ax = plt.subplots()
    assert plot_tube(tube, ax, samples=50) is ax
    assert len(ax.patches) == 3
    assert len(ax.collections) == 3
    plt.close("all")


def test_sets_of_other_dimensions_are_refused():
    from reachjax.plotting import plot_set

    with pytest.raises(ValueError, match="dimension 2 can be drawn, but 3 arrived"):
        plot_set(rj.Box([0, 0, 0], [1, 1, 1]))


def test_importing_the_package_changes_no_flag_and_loads_neither_cvxpy_nor_matplotlib():
    code = (
        "import sys, jax; before = dict(jax.config.values); import reachjax; "
        "assert dict(jax.config.values) == before; "
        "loaded = {'cvxpy', 'clarabel', 'matplotlib'} & set(sys.modules); assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
