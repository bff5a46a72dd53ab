"""Specifications in VNN-LIB are the sets that they describe, or are refused by what is wrong."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj

DECLARED = "(declare-const X_0 Real)(declare-const X_1 Real)(declare-const Y_0 Real)"
DECLARED += "(declare-const Y_1 Real)\n"
BOX = "(assert (>= X_0 -1))(assert (<= X_0 1))(assert (>= X_1 0))(assert (<= X_1 0.25))\n"


def read(tmp_path, text, declared=DECLARED):
    path = tmp_path / "a.vnnlib"
    path.write_text(declared + text)
    return rj.read_vnnlib(path)


def test_boxes_and_half_spaces(tmp_path):
    found = read(tmp_path, BOX + "(assert (<= Y_0 (+ (* 2 Y_1) 3.5))) ; above a line\n")
    assert isinstance(found.X0, rj.Box)
    assert found.X0.lower.tolist() == [-1, 0]
    assert found.X0.upper.tolist() == [1, 0.25]
    (region,) = found.avoid
    assert np.asarray(region.A).tolist() == [[1, -2]]
    assert np.asarray(region.b).tolist() == [3.5]


@pytest.mark.parametrize("seed", range(4))
def test_any_of_the_conditions_is_a_violation(tmp_path, seed):
    """On random points, membership is what the text says, evaluated anew."""
    rng = np.random.default_rng(seed)
    a = np.round(rng.normal(size=(2, 3)), 3)
    text = (
        f"(assert (or (and (>= (+ (* {a[0, 0]} Y_0) (* Y_1 {a[0, 1]})) {a[0, 2]}) (< Y_0 0.5))"
        f"(and (<= (- Y_1 Y_0) {a[1, 2]}) (>= Y_1 (- 1)) (= Y_0 Y_0 )))) "
    ).replace("(= Y_0 Y_0 )", f"(<= Y_1 {abs(a[1, 0])})")
    found, y = read(tmp_path, BOX + text), rng.normal(size=(500, 2))
    one = (a[0, 0] * y[:, 0] + a[0, 1] * y[:, 1] >= a[0, 2]) & (y[:, 0] < 0.5)
    other = (y[:, 1] - y[:, 0] <= a[1, 2]) & (y[:, 1] >= -1) & (y[:, 1] <= abs(a[1, 0]))
    inside = [np.asarray(region.contains(jnp.asarray(y))) for region in found.avoid]
    assert len(inside) == 2
    assert np.array_equal(np.any(inside, axis=0), one | other)


def test_initial_sets_that_are_no_boxes_are_polytopes(tmp_path):
    found = read(tmp_path, BOX + "(assert (<= (+ X_0 X_1) 1))(assert (>= Y_0 0))")
    assert isinstance(found.X0, rj.Polytope)
    assert np.asarray(found.X0.contains(jnp.array([[0.5, 0.2], [1.0, 0.2]]))).tolist() == [
        True,
        False,
    ]


def test_decimals_are_rounded_outwards(tmp_path):
    text = "(assert (>= X_0 0.1))(assert (<= X_0 0.3))(assert (>= X_1 0))(assert (<= X_1 0))"
    found = read(tmp_path, text + "(assert (<= Y_0 0.7))")
    assert Fraction(float(found.X0.lower[0])) <= Fraction("0.1")
    assert Fraction(float(found.X0.upper[0])) >= Fraction("0.3")
    assert Fraction(float(found.avoid[0].b[0])) >= Fraction("0.7")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("(assert (<= Y_0 1)", "ends within brackets"),
        ("(assert (<= Y_0 1)))", "closed that was not opened"),
        ("(assert (<= (* Y_0 Y_1) 1))", "is not linear"),
        ("(assert (<= X_0 Y_1))", "not of initial states or of others alone"),
        ("(assert (<= Y_7 1))", "Y_7 is not declared"),
        ("(assert (<= Y_0 nan))", "'nan' is no number"),
        ("(assert (<= Y_0 1e999999))", "no number that is known"),
        ("(assert (=> Y_0 1))", "no condition that is known"),
        ("(assert (<= Y_0 Y_0))", "is of no number"),
        ("(declare-const Y_5 Real)", "not declared in order"),
        ("(launch)", "is not known"),
        ("", "nothing of what to avoid"),
        ("(assert (or))(assert (<= Y_0 1))", "disjunction of nothing"),
        ("(assert (or (<= X_0 0.5) (<= Y_0 1)))", "several initial sets"),
    ],
)
def test_what_is_something_else_is_refused(tmp_path, text, said):
    with pytest.raises(ValueError, match=said):
        read(tmp_path, BOX + text)


@pytest.mark.parametrize("digits", [1, 4, 12])
def test_factors_are_the_decimals_that_are_written(digits, tmp_path):
    """Half-planes hold each violation exactly, and no more than their offsets are rounded by."""
    rng = np.random.default_rng(digits)
    for _ in range(20):
        one, other, least = (f"{each:.{digits}f}" for each in rng.uniform(0.1, 9, size=3))
        text = f"(assert (<= (- (* {one} Y_0) (* {other} Y_1)) {least}))"
        (region,) = read(tmp_path, BOX + text).avoid
        row = [Fraction(float(each)) for each in region.A[0]]
        times = row[0] / Fraction(one)
        assert row == [times * Fraction(one), -times * Fraction(other)]
        offset = times * Fraction(least)
        assert offset <= Fraction(float(region.b[0])) <= offset * (1 + Fraction(1, 2**52))


def test_a_loop_is_decided_from_a_file(tmp_path):
    declared = "(declare-const X_0 Real)(declare-const Y_0 Real)"
    found = read(tmp_path, "(assert (>= X_0 1))(assert (<= X_0 2))(assert (<= Y_0 0))", declared)
    net = rj.MLP.from_layers([([[1.0]], [0.0]), ([[-0.5]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), net)
    assert rj.decide(loop, found.X0, 3, avoid=found.avoid).proved
