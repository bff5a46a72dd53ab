"""A file of a network is read as exactly the function that it holds, or refused by its name."""

import warnings
import zlib

import flax.nnx as nnx
import jax
import ml_dtypes
import numpy as np
import onnx
import pytest
import scipy.io
from onnx import TensorProto, helper

import reachjax as rj
from tests.loops.malformed import cells
from tests.loops.onnx_models import make_model, node, run, saved, value

ONES = np.ones(3)


def raw(name, kind, dims, data=b""):
    return TensorProto(name=name, data_type=kind, dims=dims, raw_data=data)


def constant(name, **attributes):
    return helper.make_node("Constant", [], [name], **attributes)


KNOWN = {
    "a part of a shape": (
        [
            node("Shape", "x", "n", start=1),
            node("Cast", "n", "f", to=1),
            node("Mul", "x f"),
        ],
        {},
        [3, 3, 3],
    ),
    "whole numbers that are divided": (
        [
            node("Div", "p q", "n"),
            node("Cast", "n", "f", to=1),
            node("Mul", "x f"),
        ],
        {"p": np.array([7, -7, 8]), "q": np.array([2, 2, -3])},
        [3, -3, -2],
    ),
    "whole numbers that overflow": (
        [node("Mul", "p p", "n"), node("Cast", "n", "f", to=1), node("Mul", "x f")],
        {"p": np.array([2**16, 3, 2**31 - 1], np.int32)},
        [0, 9, 1],
    ),
    "a whole number of eight bits": (
        [node("Cast", "p", "s", to=3), node("Cast", "s", "f", to=1), node("Mul", "x f")],
        {"p": np.array([300, -200, 7])},
        [44, 56, 7],
    ),
    "whole numbers without a sign": (
        [node("Cast", "p", "s", to=2), node("Cast", "s", "f", to=1), node("Mul", "x f")],
        {"p": np.array([300, -1, 7])},
        [44, 255, 7],
    ),
    "floats that are cut off": (
        [node("Cast", "p", "n", to=7), node("Cast", "n", "f", to=1), node("Mul", "x f")],
        {"p": np.array([1.9, -1.9, 3], np.float32)},
        [1, -1, 3],
    ),
    "numbers that become true": (
        [node("Cast", "p", "t", to=9), node("Cast", "t", "f", to=1), node("Mul", "x f")],
        {"p": np.array([0.5, 0, -2], np.float32)},
        [1, 0, 1],
    ),
    "numbers of sixteen bits": (
        [node("Cast", "p", "h", to=10), node("Cast", "h", "f", to=1), node("Mul", "x f")],
        {"p": np.array([0.1, 2049, 1], np.float32)},
        [float(np.float16(0.1)), 2048, 1],
    ),
    "brain floats": (
        [node("Cast", "p", "f", to=1), node("Mul", "x f")],
        {"p": np.array([0.1, 3, -1]).astype(ml_dtypes.bfloat16)},
        [0.10009765625, 3, -1],
    ),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_numbers_are_those_of_the_standard(name, tmp_path):
    nodes, held, factors = KNOWN[name]
    path = saved(tmp_path / "net.onnx", nodes, held)
    np.testing.assert_array_equal(rj.Network.from_onnx(path)(ONES), factors)
    np.testing.assert_allclose(run(path, x=np.ones((1, 3), np.float32)), factors, rtol=1e-6)


REFUSED = {
    "a product of vectors": (
        {
            "nodes": [node("Gemm", "w x b")],
            "held": {"w": np.ones((3, 2), np.float32), "b": np.ones((3, 1), np.float32)},
            "shape": (2,),
        },
        "against ONNX's rules.*rank 2",
    ),
    "weights that are not there": (
        {"nodes": [node("Mul", "x weight0")]},
        r"node 'y' \(Mul\) takes \['weight0'\].*export it with its weights",
    ),
    "an attribute of nothing": (
        {"nodes": [node("Relu", "x", mystery=1)]},
        r"node 'y' \(Relu\) has the attribute 'mystery', which is not known",
    ),
    "a wrong length": (
        {"nodes": [node("Mul", "x w")], "held": [raw("w", 1, [3], b"\0" * 8)]},
        "tensor name: w|initialiser 'w'",
    ),
    "a kind that there is none of": (
        {"nodes": [node("Mul", "x w")], "held": [raw("w", 99, [3], b"\0" * 12)]},
        "data type 99|99",
    ),
    "complex weights": (
        {"nodes": [node("Mul", "x w")], "held": {"w": np.ones(3, complex)}},
        "COMPLEX128|complex128",
    ),
    "weights that are none": (
        {"nodes": [node("Mul", "x w")], "held": {"w": np.array([1, np.nan, 1], np.float32)}},
        "'w' holds numbers that are none",
    ),
    "weights without end": (
        {"nodes": [node("Mul", "x w")], "held": {"w": np.array([1, np.inf, 1], np.float32)}},
        "'w' must be finite",
    ),
    "a length of a terabyte": (
        {
            "nodes": [node("Cast", "w", "f", to=1), node("Mul", "x f")],
            "held": [raw("w", 7, [10**12])],
        },
        "initialiser 'w' must hold 1000000000000 numbers",
    ),
    "a shape of a terabyte": (
        {"nodes": [node("Relu", "x")], "shape": (1, 10**12)},
        "entries, but 16777216 is the most",
    ),
    "a constant of a shape without end": (
        {
            "nodes": [
                node("ConstantOfShape", "n", "c"),
                node("ReduceMax", "c", "m"),
                node("Add", "x m"),
            ],
            "held": {"n": np.array([10**10])},
        },
        "entries",
    ),
    "a constant without a value": (
        {"nodes": [constant("c"), node("Add", "x c")]},
        "node 'c'|Constant",
    ),
    "a division by zero": (
        {"nodes": [node("Div", "x w")], "held": {"w": np.zeros(3, np.float32)}},
        "finite at none of the points",
    ),
    "a whole number divided by zero": (
        {
            "nodes": [node("Div", "p q", "n"), node("Cast", "n", "f", to=1), node("Mul", "x f")],
            "held": {"p": np.array([1]), "q": np.array([0])},
        },
        r"node 'n' \(Div\).*divided by zero",
    ),
    "a cast that the standard leaves open": (
        {
            "nodes": [
                node("Cast", "p", "n", to=3),
                node("Cast", "n", "f", to=1),
                node("Mul", "x f"),
            ],
            "held": {"p": np.array([300.0], np.float32)},
        },
        r"node 'n' \(Cast\).*cannot be cast to int8",
    ),
    "inputs that are cast to eight bits": (
        {"nodes": [node("Cast", "x", "n", to=3), node("Cast", "n", to=1)]},
        r"node 'n' \(Cast\).*only floats and whole numbers of 32 and 64 bits",
    ),
    "a network in sixteen bits": (
        {"nodes": [node("Relu", "x")], "inputs": [value("x", (1, 3), TensorProto.FLOAT16)],
             "outputs": [value("y", (1, 3), TensorProto.FLOAT16)]},
        "'x' is of FLOAT16",
    ),
    "an input without a shape": (
        {"nodes": [node("Relu", "x")], "inputs": [value("x", None)]},
        "'x' has the shape None",
    ),
    "an input of an open size": (
        {"nodes": [node("Relu", "x")], "inputs": [value("x", ("batch", "size"))]},
        r"'x' has the shape \['batch', 'size'\].*must be a number",
    ),
    "dropout in training": (
        {"nodes": [node("Dropout", "x r t")],
             "held": {"r": np.float32(0.5), "t": np.array(True)}},
        "training mode",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_graph_that_is_no_network_is_refused_by_its_name(name, tmp_path):
    chosen, said = REFUSED[name]
    path = saved(tmp_path / "net.onnx", **chosen)
    with pytest.raises(ValueError, match=rf"(?s)net\.onnx cannot be read: .*({said})"):
        rj.Network.from_onnx(path)


def test_lengths_of_initialisers_are_checked_whatever_field_holds_them(tmp_path):
    model = make_model([node("Mul", "x w")], {"w": np.ones(3, np.float32)})
    model.graph.initializer[0].ClearField("raw_data")
    model.graph.initializer[0].float_data.extend([1.0, 2.0])
    onnx.save(model, tmp_path / "net.onnx")
    with pytest.raises(ValueError, match=r"net\.onnx cannot be read"):
        rj.Network.from_onnx(tmp_path / "net.onnx")


def test_weights_of_an_external_file_are_read_and_must_be_there(tmp_path):
    model = make_model([node("Mul", "x w")], {"w": np.array([1, 2, 3], np.float32)})
    path = tmp_path / "net.onnx"
    onnx.save(model, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    assert rj.Network.from_onnx(path)(ONES).tolist() == [1, 2, 3]
    (tmp_path / "weights.bin").write_bytes(b"\0" * 5)
    with pytest.raises(ValueError, match=r"net\.onnx cannot be read"):
        rj.Network.from_onnx(path)
    (tmp_path / "weights.bin").unlink()
    with pytest.raises(ValueError, match=r"net\.onnx cannot be read"):
        rj.Network.from_onnx(path)


def test_an_output_and_inputs_are_chosen_by_their_names(tmp_path):
    nodes = [
        node("Concat", "x z", "c", axis=1),
        node("Mul", "c w", "action"),
        node("Hardmax", "x", "mask"),
    ]
    ends = [value(*each) for each in (("x", (1, 2)), ("z", (1, 1)), ("unused", (1, 4)))]
    outputs = [value(name, None) for name in ("mask", "action")]
    held = {"w": np.array([1, 10, 100], np.float32)}
    path = saved(tmp_path / "net.onnx", nodes, held, inputs=ends, outputs=outputs)
    with pytest.raises(ValueError, match=r"\['mask', 'action'\].*output="):
        rj.Network.from_onnx(path)
    with pytest.raises(ValueError, match=r"output must be one of .*'action'.*'other' arrived"):
        rj.Network.from_onnx(path, output="other")
    with pytest.raises(ValueError, match=r"'x' \[1, 2\], 'z' \[1, 1\].*inputs="):
        rj.Network.from_onnx(path, output="action")
    with pytest.raises(ValueError, match="inputs must be names from"):
        rj.Network.from_onnx(path, inputs="x", output="action")
    net = rj.Network.from_onnx(path, inputs=["z", "x"], output="action")
    assert net([3.0, 1.0, 2.0]).tolist() == [1, 20, 300]


def test_inputs_on_which_nothing_depends_are_left_aside(tmp_path):
    ends = [value("x", (1, 3)), value("mask", (1, 7))]
    path = saved(tmp_path / "net.onnx", [node("Tanh", "x")], inputs=ends)
    assert rj.Network.from_onnx(path).inputs == 3


def test_an_operator_without_bounds_is_named_with_its_node(tmp_path):
    made = helper.make_node("Pow", ["two", "x"], ["y"], name="doubling")
    path = saved(tmp_path / "net.onnx", [made], {"two": np.float32(2)})
    with pytest.raises(TypeError, match=r"net\.onnx, the node 'doubling' \(Pow\)"):
        rj.Network.from_onnx(path)


def test_what_onnxruntime_computes_otherwise_is_refused_with_both(tmp_path, monkeypatch):
    from reachjax.loops.readers import operators

    path = saved(tmp_path / "net.onnx", [node("Tanh", "x")])
    wrong = operators.Operator(lambda attributes, x: x)
    monkeypatch.setitem(operators.OPERATORS, "Tanh", wrong)
    with pytest.raises(ValueError, match=r"computes something else: at .* it finds .* was read is"):
        rj.Network.from_onnx(path)
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    assert rj.Network.from_onnx(path).inputs == 3  # nothing is compared where it is missing


def test_files_are_read_without_warnings_in_thirty_two_bits(tmp_path):
    held = {"low": np.float64(-1.7e308), "high": np.float64(1.7e308)}
    double = TensorProto.DOUBLE
    ends = {"inputs": [value("x", (1, 3), double)], "outputs": [value("y", (1, 3), double)]}
    path = saved(tmp_path / "net.onnx", [node("Clip", "x low high")], held, **ends)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rj.Network.from_onnx(path).inputs == 3
        # 1e308, as the largest inverse that is known, is none of 32 bits
        assert rj.Network(lambda x: x / np.array([2.0, 4.0, 8.0], np.float32), 3, 3).outputs == 3


def test_the_error_of_another_activation_says_what_takes_it():
    with pytest.raises(ValueError, match=r"reachjax\.Network\(module, inputs, outputs\)"):
        rj.MLP.from_flax(
            nnx.Sequential(
                nnx.Linear(2, 3, rngs=nnx.Rngs(0)), nnx.swish, nnx.Linear(3, 1, rngs=nnx.Rngs(0))
            ),
            activation=nnx.swish,
        )


# chains ------------------------------------------------------------------------------------------

NNET = {
    "no limits and no scaler": ("1,2,1,2\n2,1\n0\n0\n0\n0\n0\n1,2\n3\n", [6.0]),
    "a size too many": ("1,2,1,2\n2,1,1\n0\n0,0,\n1,1,\n0,0,0,\n1,1,1,\n1,2\n3\n", [6.0]),
}


@pytest.mark.parametrize("name", NNET)
def test_nnet_files_of_the_competition(name, tmp_path):
    text, expected = NNET[name]
    path = tmp_path / "a.nnet"
    path.write_text("// x\n" + text)
    assert rj.Network.from_file(path)([1.0, 1.0]).tolist() == expected


CHAINS = {
    "one mean.nnet": ("1,2,1,2\n2,1\n0\n0,0\n1,1\n0\n1,1,1\n1,2\n3\n", "means and ranges"),
    "limits.nnet": ("1,2,1,2\n2,1\n0\n0,2\n1,1\n0,0,0\n1,1,1\n1,2\n3\n", "below the largest"),
    "ranges.nnet": ("1,2,1,2\n2,1\n0\n0,0\n1,1\n0,0,0\n1,0,1\n1,2\n3\n", "larger than 0"),
    "rows.nnet": ("1,2,1,2\n2,1\n0\n0\n0\n0\n0\n1,2,3\n3\n", "must be 2 numbers, but 3"),
    "head.nnet": ("1,2,1", "ends too early"),
    "after.nnet": ("1,2,1,2\n2,1\n0\n0\n0\n0\n0\n1,2\n3\n4\n", "1 lines are left"),
    "empty.nnet": ("", "ends too early"),
    "empty.txt": ("", "ends too early"),
    "sizes.txt": ("2 1", "ends too early"),
    "layers.txt": ("2 1 3 4", "ends too early"),
    "weights.txt": ("2 1 0 1 2", "ends too early"),
    "large.txt": ("2 1 1 1000000000000 1 2", "ends too early"),
    "word.txt": ("1 1 0 1 nan", "layers need as many activations|stands where a number"),
}


@pytest.mark.parametrize("name", CHAINS)
def test_a_chain_that_does_not_fit_its_sizes_is_refused(name, tmp_path):
    text, said = CHAINS[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{name} cannot be read: .*({said})"):
        rj.Network.from_file(tmp_path / name)


@pytest.mark.filterwarnings("error")
def test_complex_weights_of_a_matlab_file_are_refused(tmp_path):
    path = tmp_path / "net.mat"
    held = {"W": cells([np.ones((1, 2)) + 1j]), "b": cells([np.ones((1, 1))])}
    scipy.io.savemat(path, held | {"act_fcns": ["relu"]})
    with pytest.raises(ValueError, match=r"net\.mat cannot be read: weights 1 .*complex128"):
        rj.Network.from_file(path)


@pytest.mark.parametrize("packed", [False, True])
def test_a_cut_off_matlab_file_is_an_error_of_its_own(packed, tmp_path):
    path = tmp_path / "net.mat"
    held = {"W": cells([np.ones((1, 2))]), "b": cells([np.ones((1, 1))]), "act_fcns": ["relu"]}
    scipy.io.savemat(path, held, do_compression=packed)
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"net\.mat cannot be read"):
            rj.Network.from_file(path)


def test_versions_of_matlab_files_that_are_not_read_say_what_to_do(tmp_path):
    path = tmp_path / "net.mat"
    scipy.io.savemat(path, {"W": np.ones((1, 2))}, format="4")
    with pytest.raises(ValueError, match=r"version 4 .* '-v7'"):
        rj.Network.from_file(path)
    path.write_bytes(b"MATLAB 7.3".ljust(512, b" ") + b"\x89HDF\r\n\x1a\n" + b"\0" * 100)
    with pytest.raises(ValueError, match=r"7\.3 \(HDF5\).*'-v7'"):
        rj.Network.from_file(path)


@pytest.mark.costly
def test_a_matlab_file_that_grows_without_end_is_refused(tmp_path):
    path = tmp_path / "net.mat"
    scipy.io.savemat(path, {"x": 1})
    packing = zlib.compressobj(9)
    zeros = b"\0" * 2**20
    packed = b"".join([packing.compress(zeros) for _ in range(300)]) + packing.flush()
    tag = np.array([15, len(packed)], "<u4").tobytes()
    path.write_bytes(path.read_bytes()[:128] + tag + packed)
    with pytest.raises(ValueError, match="holds more than"):
        rj.Network.from_file(path)
