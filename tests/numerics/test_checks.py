"""Claims about what users pass in: it is copied, not rounded, and on one device."""

from decimal import Decimal
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics.checks import Numbers, as_floats, owned, real_number


def aligned(values):
    """A numpy array that JAX would keep without a copy: it begins at a multiple of 64 bytes."""
    values = np.asarray(values, dtype=float)
    buffer = np.zeros(values.nbytes + 64, np.uint8)
    begin = -buffer.ctypes.data % 64
    array = buffer[begin : begin + values.nbytes].view(float).reshape(values.shape)
    array[...] = values
    return array


def kept(values):
    """The same as an array of JAX that shares its memory with one of numpy."""
    array = aligned(values)
    return array, jnp.asarray(array)


EYE = np.eye(2)
BUILT = {
    "Box": lambda a: rj.Box(a(np.zeros(2)), a(np.ones(2))),
    "Polytope": lambda a: rj.Polytope(a(EYE), a(np.ones(2))),
    "Ellipsoid": lambda a: rj.Ellipsoid(a(np.zeros(2)), a(EYE)),
    "Intersection": lambda a: rj.Intersection(
        rj.Box(a(np.zeros(2)), a(np.ones(2))), rj.Ellipsoid(a(np.zeros(2)), a(EYE))
    ),
    "Template": lambda a: rj.Template(a(np.vstack([EYE, -EYE]))),
    "EllipsoidTemplate": lambda a: rj.EllipsoidTemplate(a(EYE)),
    "AffinePlant": lambda a: rj.AffinePlant(a(EYE), a(EYE), a(np.ones(2))),
    "MLP": lambda a: rj.MLP.from_layers([(a(EYE), a(np.ones(2)))]),
}


@pytest.mark.parametrize("through_jax", [False, True], ids=["numpy", "jax"])
@pytest.mark.parametrize("name", BUILT)
def test_what_is_written_into_an_array_later_changes_nothing_built_from_it(name, through_jax):
    given = []

    def argument(values):
        array, same = kept(values)
        given.append(array)
        return same if through_jax else array

    built = BUILT[name](argument)
    before = jax.tree.map(np.array, built)
    for array in given:
        array[...] = 7.0
    jax.tree.map(np.testing.assert_array_equal, built, before)


def test_the_numpy_views_of_an_object_cannot_be_written():
    lower = np.asarray(rj.Box(aligned([0.0, 0.0]), [1.0, 1.0]).lower)
    with pytest.raises(ValueError, match="read-only"):
        lower[0] = 5.0
    with pytest.raises(ValueError, match="cannot set WRITEABLE"):
        lower.setflags(write=True)


def test_owned_trees_share_no_memory_and_leave_tracers_alone():
    array = aligned([1.0, 2.0])
    box = jax.tree.map(lambda _: array, rj.Box([0.0, 0.0], [1.0, 1.0]))
    own = owned(box)
    array[...] = 7.0
    np.testing.assert_array_equal(own.lower, [1.0, 2.0])
    np.testing.assert_array_equal(jax.jit(lambda tree: owned(tree).upper)(own), [1.0, 2.0])


def test_a_constant_stays_one_inside_jit():
    weights = jnp.ones((1, 2))

    @jax.jit
    def output(x):
        net = rj.MLP.from_layers([(weights, jnp.zeros(1) + x)])
        assert not isinstance(net.layers[0][0], jax.core.Tracer)
        assert not isinstance(owned(weights), jax.core.Tracer)
        return net.layers[0][1]

    assert output(2.0) == 2.0


CHANGED = {
    "2**53 + 1": ([2**53 + 1, 0.5], "9007199254740993 is none: the nearest one is 90071992547409"),
    "an int beyond all floats": ([10**400], r"10+\.\.\. is none: the nearest one is inf"),
    "int64": (np.array([0, -(2**53) - 1]), "-9007199254740993 is none"),
    "uint64": (np.array([2**64 - 1], np.uint64), "18446744073709551615 is none"),
    "a JAX array of int64": (jnp.array([2**53 + 1]), "9007199254740993 is none"),
    "longdouble": (np.ones(1, np.longdouble) / 3, r"longdouble\('0.33333333333333333"),
    "an infinite longdouble": (np.array(["1e4000"], np.longdouble), r"1e\+4000.* is none"),
    "a longdouble among floats": ([0.5, np.longdouble(1) / 3], "longdouble"),
    "Fraction": ([Fraction(1, 3)], r"Fraction\(1, 3\) is none: the nearest one is 0.3333"),
    "Decimal": ([Decimal("0.1")], r"Decimal\('0.1'\) is none: the nearest one is 0.1"),
    "objects": (np.array([1, Fraction(1, 3)]), r"Fraction\(1, 3\) is none"),
}


@pytest.mark.parametrize(("value", "message"), CHANGED.values(), ids=CHANGED)
def test_a_number_that_float64_does_not_hold_is_refused_and_named(value, message):
    if np.finfo(np.longdouble).eps == np.finfo(float).eps and "longdouble" in message:
        pytest.skip("a longdouble is a float64 here")
    with pytest.raises(ValueError, match=rf"Box\.lower must hold numbers of float64.*{message}"):
        rj.Box(value, value)
    with pytest.raises(ValueError, match=rf"upper must hold numbers of float64.*{message}"):
        rj.Polytope.between([-np.inf] * np.size(value), value)


HELD = {
    "whole numbers": ([2**53, -3, True], [2.0**53, -3.0, 1.0]),
    "2**70": ([2**70], [2.0**70]),
    "int64": (np.array([2**53, 2**62]), [2.0**53, 2.0**62]),
    "longdouble": (np.array([0.5, 0.1], np.longdouble), [0.5, 0.1]),
    "Fraction and Decimal": ([Fraction(1, 4), Decimal("0.5")], [0.25, 0.5]),
    "objects": (np.array([Fraction(1, 4), 2]), [0.25, 2.0]),
    "bfloat16": (jnp.array([1.5], jnp.bfloat16), [1.5]),
    "float32": (np.array([0.1], np.float32), [float(np.float32(0.1))]),
    "a mixed list": ([np.float64(0.1), jnp.ones(()), 2], [0.1, 1.0, 2.0]),
}


@pytest.mark.parametrize(("value", "expected"), HELD.values(), ids=HELD)
def test_a_number_that_float64_holds_is_taken_as_it_is(value, expected):
    array = as_floats(value, "value")
    assert array.dtype == jnp.float64
    assert array.tolist() == expected


@pytest.mark.parametrize(
    "value", ["1.5", ["1.5"], np.array(["1.5"]), [np.str_("1")], [b"1"], np.array([b"1"])], ids=repr
)
def test_text_is_no_number(value):
    with pytest.raises(TypeError, match=r"Box\.lower must be an array .* arrived: .*(text|<U|S1)"):
        rj.Box(value, [1.0])


def test_sides_of_a_polytope_are_real_numbers():
    for value, said in ((["1.5"], "it is text"), (np.array([1j]), "complex")):
        with pytest.raises(TypeError, match=f"lower must be real numbers, but .*{said}"):
            rj.Polytope.between(value, [np.inf])


def test_dates_and_ragged_lists_are_no_numbers():
    for value in (np.array(["2020-01-01"], "M8[D]"), [[1.0], [1.0, 2.0]]):
        with pytest.raises(TypeError, match=r"Box\.lower must be an array"):
            rj.Box(value, value)


def test_a_margin_that_float64_does_not_hold_is_refused():
    assert real_number("margin", Fraction(1, 2).numerator, 0.0) == 1.0
    with pytest.raises(ValueError, match="margin must hold numbers of float64"):
        real_number("margin", 2**53 + 1, 0.0)


def test_an_array_that_is_sharded_inside_jit_is_refused_with_a_way_out():
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Explicit,))
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("x", None))
    A = jax.device_put(np.eye(2), split)
    with pytest.raises(ValueError, match=r"value must not be sharded, .*\['x'\]: gather it before"):
        jax.jit(Numbers("(n, n)"))(A)


def test_an_array_that_is_sharded_comes_to_one_device():
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Explicit,))
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("x", None))
    A = jax.device_put(np.eye(2), split)
    for array in (Numbers("(n, n)")(A), owned({"A": A})["A"]):
        assert isinstance(array.sharding, jax.sharding.SingleDeviceSharding)
        np.testing.assert_array_equal(array, EYE)


def test_masked_numbers_are_none():
    with pytest.raises(TypeError, match="some of its entries are masked"):
        rj.Box(np.ma.array([1.0, 2.0], mask=[True, False]), [1.0, 2.0])
    assert rj.Box(np.ma.array([1.0, 2.0]), [1.0, 2.0]).dimension == 2


def test_tensors_of_other_libraries_are_arrays():
    class Tensor:
        dtype = "float32 of another library"

        def __array__(self, dtype=None, copy=None):
            return np.array([1.0, 2.0], dtype)

    np.testing.assert_array_equal(rj.Box(Tensor(), [1.0, 2.0]).lower, [1.0, 2.0])
