"""Claims about bounds by all bases: as tight as linear programs', and never less than the truth."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from reachjax.sets import linear_programs
from reachjax.sets.bases import maximisers_by_bases
from reachjax.sets.unusable import UnusableSetError
from tests.campaign.oracle import exact, solved

KINDS = ("random", "repeated", "pyramid", "flat", "point", "needle")


def polytope(kind, n, seed):
    """Facets around a point: of random normals, or of a special kind; bounded ones."""
    rng = np.random.default_rng([n, seed])
    cube = np.vstack([np.eye(n), -np.eye(n)])
    rows, sizes = np.vstack([cube, rng.normal(size=(2, n))]), rng.uniform(0.2, 2.0, 2 * n + 2)
    if kind == "repeated":  # a facet twice, and twice as long
        rows = np.vstack([rows, rows[:1], 2 * rows[-1:]])
        sizes = np.r_[sizes, sizes[0], 2 * sizes[-1]]
    elif kind == "pyramid":  # more facets than coordinates meet at the top
        sides = cube[np.arange(2 * n) % n != n - 1]
        sides = sides + np.eye(n)[-1]
        rows, sizes = np.vstack([sides, np.eye(n)[-1], -np.eye(n)[-1]]), np.ones(2 * n)
    elif kind == "flat":  # in one coordinate nothing is left
        sizes[0] = sizes[n] = 0.0
    elif kind == "point":
        sizes[: 2 * n] = 0.0
    elif kind == "needle":
        sizes[0] = sizes[n] = 1e-7
    middle = np.round(rng.normal(size=n), 3) if kind != "pyramid" else np.zeros(n)
    return rows, sizes + rows @ middle


def by_programs(monkeypatch, function, *given):
    """What linear programs say."""
    with monkeypatch.context() as patched:
        patched.setattr(linear_programs, "maximisers_by_bases", lambda A, b, D: None)
        patched.setattr(linear_programs, "_boxed", linear_programs._boxed.__wrapped__)
        return function(*given)


def outcome(function, *given):
    """The values, or the error's kind and text."""
    try:
        return function(*given)[0]
    except (ValueError, RuntimeError) as error:
        return type(error), str(error)


def largest(A, b, a):
    """The maximum of `a . x` in fractions: the best point where facets meet in the polytope."""
    A, b, a = exact(A), exact(b), exact(a)
    corners = (solved(A[list(rows)], b[list(rows)]) for rows in combinations(range(len(A)), len(a)))
    return max(a @ x for x in corners if x is not None and (A @ x <= b).all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_bases_bound_as_linear_programs_do(monkeypatch, kind, n):
    if kind == "pyramid" and n == 1:
        pytest.skip("it has no sides")
    for seed in range(3):
        A, b = polytope(kind, n, seed)
        D = np.random.default_rng(seed).normal(size=(5, n))
        values, Y, points = linear_programs.support(A, b, D)
        known = by_programs(monkeypatch, linear_programs.support, A, b, D)[0]
        size = 1 + abs(values).max()
        np.testing.assert_allclose(values, known, rtol=1e-9, atol=1e-9 * size)
        assert (Y >= 0).all()
        np.testing.assert_allclose(Y @ A, D, atol=1e-9)
        np.testing.assert_allclose((points * D).sum(axis=1), values, atol=1e-9 * size)
        assert (points @ A.T <= b + 1e-9 * size).all()
        for each, other in zip(
            linear_programs.bounding_box(A, b)[:2],
            by_programs(monkeypatch, linear_programs.bounding_box, A, b)[:2],
            strict=True,
        ):
            np.testing.assert_allclose(each, other, rtol=1e-9, atol=1e-9 * size)


@pytest.mark.parametrize("kind", ["random", "repeated", "pyramid", "needle"])
@pytest.mark.parametrize("n", [2, 3])
def test_no_bound_is_less_than_the_exact_maximum(kind, n):
    for seed in range(3):
        A, b = polytope(kind, n, seed)
        D = np.vstack([np.random.default_rng(seed).normal(size=(3, n)), np.eye(n)[:1], A[:1]])
        values = linear_programs.support(A, b, D)[0]
        for value, a in zip(values, D, strict=True):
            truth = largest(A, b, a)
            assert 0 <= Fraction(value) - truth <= Fraction(1, 10**9) * (1 + abs(truth))


@pytest.mark.parametrize("n", [2, 3, 6])
def test_few_facets_need_no_linear_program(monkeypatch, n):
    monkeypatch.setattr(linear_programs, "linprog", None)
    A, b = polytope("random", n, 7)
    kept = slice(None) if n < 6 else slice(2 * n)  # 924 bases
    linear_programs.support(A[kept], b[kept], np.ones((1, n)))


def test_many_facets_are_left_to_linear_programs():
    A = np.random.default_rng(0).normal(size=(60, 3))
    assert maximisers_by_bases(A, np.ones(60), np.eye(3)) is None


UNUSABLE = {
    "empty": ([[1.0, 0], [-1, 0], [0, 1], [0, -1]], [0.0, -1, 1, 1]),
    "barely empty": ([[1.0, 0], [-1, 0], [0, 1], [0, -1]], [1.0, -1 - 1e-9, 1, 1]),
    "a row of zeros": ([[1.0, 0], [-1, 0], [0, 1], [0, -1], [0, 0]], [1.0, 1, 1, 1, -1]),
    "a cone": ([[1.0, 0], [0, 1]], [0.0, 0]),
    "a wedge": ([[1.0, 1], [-1, 1], [0, -1]], [1.0, 1, 1 - 1e-9]),
    "half of a strip": ([[1.0, 0], [-1, 0], [0, 1]], [1.0, 1, 1]),
    "a strip": ([[1.0, 0], [-1, 0]], [1.0, 1]),
    "one facet": ([[1.0, 2]], [1.0]),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_what_is_said_of_unusable_polytopes_is_what_linear_programs_say(monkeypatch, kind):
    A, b = map(np.array, UNUSABLE[kind])
    for function, *given in (
        (linear_programs.support, A, b, np.array([[1.0, 1], [-1, 0.5]])),
        (linear_programs.bounding_box, A, b),
    ):
        found = outcome(function, *given)
        known = outcome(lambda f=function, g=given: by_programs(monkeypatch, f, *g))
        if isinstance(known, tuple):
            assert found == known
        else:
            np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-9)


def test_unusable_polytopes_are_told():
    with pytest.raises(UnusableSetError, match="empty"):
        linear_programs.boxed(*map(np.array, UNUSABLE["empty"]))
    with pytest.raises(UnusableSetError, match="unbounded"):
        linear_programs.boxed(*map(np.array, UNUSABLE["a cone"]))


def test_the_box_of_a_polytope_is_kept_and_cannot_be_written_to():
    A, b = polytope("random", 2, 11)
    region, box = linear_programs.boxed(A, b)
    again = linear_programs.boxed(A.copy(), np.asfortranarray(b))
    assert again[1].values is box.values
    with pytest.raises(ValueError, match="read-only"):
        box.values[0] = 0.0
    with pytest.raises(ValueError, match="read-only"):
        region.A[0] = 0.0
    A[0] *= 2
    assert linear_programs.boxed(A, b)[1].values is not box.values
