"""Operators of ONNX that jump, against onnxruntime: at any points, and at ties."""

import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.loops.onnx_models import node, run, saved, value
from tests.loops.traced import interval

HELD = {
    "w": np.array([[1, 2, -1], [0, 1, 1], [2, -1, 0], [1, 1, 1]], np.float32),
    "table": np.array([[1.0, -1.0], [0.5, 2.0], [-3.0, 0.25], [4.0, 1.0]], np.float32),
    "row": np.array([3, -1, 2, 5], np.int64),
    "k": np.float32(0.5),
    "one": np.float32(1.0),
    "two": np.int64(2),
    "minus": np.int64(-3),
    "depth": np.int64(4),
    "values": np.array([-1.0, 2.0], np.float32),
    "low": np.float32(-2.0),
    "high": np.float32(2.0),
}
SCORES = [node("Transpose", "w", "t"), node("MatMul", "x t", "s")]
WINNER = [*SCORES, node("ArgMax", "s", "a", axis=1, keepdims=0)]
CLIPPED = node("Clip", "x low high", "c")
GRAPHS = {
    "the winner": [*SCORES, node("ArgMax", "s", axis=1, keepdims=0)],
    "the last winner": [
        *SCORES,
        node("ArgMax", "s", axis=-1, keepdims=1, select_last_index=1),
    ],
    "the loser": [*SCORES, node("ArgMin", "s", "a", axis=1), node("Cast", "a", to=1)],
    "a row of a table": [*WINNER, node("Gather", "table a", axis=0)],
    "a whole number of a table": [*WINNER, node("Gather", "row a", "i"), node("Cast", "i", to=1)],
    "a score": [*WINNER, node("Gather", "s a", axis=1)],
    "one hot": [*WINNER, node("OneHot", "a depth values", axis=-1)],
    "one hot times scores": [
        *WINNER, node("OneHot", "a depth values", "h"), node("Mul", "h s"),
    ],
    "hardmax": [*SCORES, node("Hardmax", "s", axis=1)],
    "hardmax against one hot": [
        *WINNER, node("OneHot", "a depth values", "o"), node("Hardmax", "s", "h"),
        node("Sub", "o h"),
    ],
    "a quotient of whole numbers": [
        *WINNER, node("Gather", "row a", "i"), node("Div", "i two", "q"), node("Cast", "q", to=1),
    ],
    "a quotient of negative whole numbers": [
        *WINNER, node("Gather", "row a", "i"), node("Div", "i minus", "q"),
        node("Add", "q a", "r"), node("Cast", "r", to=1),
    ],
    "half of rectified whole numbers": [
        CLIPPED, node("Cast", "c", "i", to=6), node("Relu", "i", "r"), node("Cast", "r", "s", to=7),
        node("Div", "s two", "h"), node("Cast", "h", to=1),
    ],
    "a comparison as a number": [node("Greater", "x k", "g"), node("Cast", "g", to=1)],
    "one of two": [node("Less", "x k", "g"), node("Neg", "x", "n"), node("Where", "g x n")],
    "one of two numbers": [node("Greater", "x k", "g"), node("Where", "g k high")],
    "neither": [
        node("Greater", "x k", "g"), node("Less", "x low", "l"), node("Or", "g l", "o"),
        node("Not", "o", "n"), node("Where", "n x high"),
    ],
    "one alone": [
        node("Greater", "x k", "g"), node("GreaterOrEqual", "x one", "l"), node("Xor", "g l", "o"),
        node("Where", "o x high"),
    ],
    "equal": [node("Equal", "x k", "g"), node("Where", "g high x")],
    "signs": [node("Sign", "x", "g"), node("Mul", "g high")],
    "floor": [CLIPPED, node("Floor", "c")],
    "ceil": [CLIPPED, node("Ceil", "c")],
    "round": [CLIPPED, node("Round", "c")],
    "floor of anything": [node("Floor", "x", "f"), node("Mul", "f k")],
    "round of anything": [node("Round", "x")],
    "cut": [CLIPPED, node("Cast", "c", "i", to=7), node("Cast", "i", to=1)],
}  # fmt: skip
TIES = [
    [0, 0, 0],
    [0.5, 0.5, 0.5],
    [1, 0, 0],
    [0, 1, 0],
    [-0.5, 1.5, -1.5],
    [2.5, -2.5, 1],
    [1, 1, 0],
]
WHOLE = ("the winner", "the last winner")


@pytest.mark.parametrize("name", GRAPHS)
def test_what_jumps_is_what_onnxruntime_computes_also_at_ties(name, tmp_path):
    used = {each for one in GRAPHS[name] for each in one.input}
    held = {key: each for key, each in HELD.items() if key in used}
    ends = {"outputs": [value("y", None, 7)]} if name in WHOLE else {}
    path = saved(tmp_path / "net.onnx", GRAPHS[name], held, opset=18, **ends)
    net = rj.Network.from_onnx(path)
    drawn = np.random.default_rng(0).normal(size=(20, 3)) * 1.5
    for x in np.concatenate([np.array(TIES, float), drawn]).astype(np.float32):
        expected = run(path, x=x[None])
        np.testing.assert_allclose(net(jnp.asarray(x, float)), expected, rtol=1e-6, atol=1e-6)
        low, high = interval(net, x.astype(float), x.astype(float))
        assert np.all((low <= expected + 1e-6) & (expected - 1e-6 <= high))


OF_OTHER_KINDS = {
    "a mean of whole numbers": ("ReduceMean", [node("ReduceMean", "i", "p", axes=[1])]),
    "a root of whole numbers": ("Pow", [node("Pow", "i k", "p")]),
}


@pytest.mark.parametrize("name", OF_OTHER_KINDS)
def test_results_of_another_kind_than_the_standard_tells_are_refused(name, tmp_path):
    """The standard cuts these off to whole numbers."""
    culprit, nodes = OF_OTHER_KINDS[name]
    nodes = [CLIPPED, node("Cast", "c", "i", to=7), *nodes, node("Cast", "p", to=1)]
    used = {each for one in nodes for each in one.input}
    held = {key: each for key, each in HELD.items() if key in used}
    path = saved(tmp_path / "net.onnx", nodes, held, opset=17)
    with pytest.raises(ValueError, match=rf"\({culprit}\) is of INT64 by ONNX's rules"):
        rj.Network.from_onnx(path)
