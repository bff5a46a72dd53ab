"""Bad input, each with its own error: it names the argument, what was expected and what arrived."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from tests.networks import he_network

NAN, INF = float("nan"), float("inf")
NET = rj.MLP.from_layers(he_network((2, 3, 1), seed=0))
PLANT = rj.AffinePlant(0.5 * np.eye(2), np.ones((2, 1)))
LOOP = rj.ClosedLoop(PLANT, NET, rj.Box([-1.0], [1.0]))
LTV = LOOP.replace(plant=rj.AffinePlant(np.stack([np.eye(2)] * 3), np.ones((2, 1))))
X0, TEMPLATE, LINE = rj.Box([0.0, 0.0], [0.1, 0.1]), rj.Template.box(2), rj.Box([0.0], [1.0])
STRIP = rj.Polytope([[1, 0], [-1, 0]], [1, 1])
EMPTY = rj.Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [0, -1, 1, 1])
FOUR_TIMES = rj.Box(-np.ones((4, 1)), np.ones((4, 1)))
EYE, ONES = np.eye(2), np.ones((2, 1))


def layers(*shapes):
    return rj.MLP.from_layers([(np.ones(shape), np.zeros(shape[0])) for shape in shapes])


def layer(W, b):
    return rj.MLP.from_layers([(W, b)])


def reach(**changes):
    arguments = {"loop": LOOP, "X0": X0, "horizon": 1, "template": TEMPLATE, "window": 1}
    return rj.reach(**(arguments | changes))


# What the message must say, and the call that must say it.
BAD_VALUES = {
    r"Box\.lower must be finite, but entry \(1,\) is nan": lambda: rj.Box([0, NAN], [1, 1]),
    r"Box\.upper must be finite, but entry \(1,\) is inf": lambda: rj.Box([0, 0], [1, INF]),
    r"at \(1,\) lower is 2.0 and upper 1.0: the box is empty": lambda: rj.Box([0, 2], [1, 1]),
    r"lower must not exceed .*at \(1, 0\) lower is 2": lambda: rj.Box([[0], [2]], [[1], [1]]),
    r"one shape, but \(2,\) and \(3,\) arrived": lambda: rj.Box([0, 0], [1, 1, 1]),
    r"Box\.lower must .*\(n,\) or \(time, n\), but one of shape \(\)": lambda: rj.Box(0.0, 1.0),
    r"Polytope\.A must be finite, .*\(0, 0\)": lambda: rj.Polytope([[NAN, 0]], [1]),
    r"Polytope\.b has length 3, but .* rows of 2": lambda: rj.Polytope(EYE, [1, 1, 1]),
    r"row 1 of Polytope\.A is zero": lambda: rj.Polytope([[1, 0], [0, 0]], [1, 1]),
    r"Polytope\.A must .*\(m, n\), but one of shape \(2,\)": lambda: rj.Polytope([1, 0], [1]),
    r"Template\.directions must be finite": lambda: rj.Template([[INF, 0], [0, 1]]),
    r"directions do not bound a set: row 0 .* zero": lambda: rj.Template([[0, 0], [0, 1]]),
    r"layers\[1\] takes 3 .*layers\[0\] has 4 outputs": lambda: layers((4, 2), (1, 3)),
    r"W of MLP\.layers\[0\] has 2 rows.* length 4": lambda: layer(np.ones((2, 4)), np.ones(4)),
    r"b of MLP\.layers\[0\] must .*\(outputs,\).*\(2, 1\)": lambda: layer(EYE, ONES),
    r"W of MLP\.layers\[0\] must be finite": lambda: layer(np.full((1, 2), NAN), np.ones(1)),
    r"MLP\.layers must hold at least one pair": lambda: rj.MLP.from_layers([]),
    r"AffinePlant\.A must have 3 rows.*\(2, 3\)": lambda: rj.AffinePlant(np.ones((2, 3)), ONES),
    r"AffinePlant\.B must have 2 rows.*\(3, 1\)": lambda: rj.AffinePlant(EYE, np.ones((3, 1))),
    r"AffinePlant\.B must .*\(n_x, n_u\).*\(2,\)": lambda: rj.AffinePlant(EYE, [1, 1]),
    r"AffinePlant\.c must have 2 rows.*\(1,\)": lambda: rj.AffinePlant(EYE, ONES, [1]),
    r"time axes .*'A': 3, 'B': 4": lambda: rj.AffinePlant(np.ones((3, 2, 2)), np.ones((4, 2, 1))),
    "inputs is 3, but the plant's number of states is 2": lambda: rj.ClosedLoop(
        PLANT, layers((1, 3))
    ),
    "outputs is 2, but the plant's number of inputs is 1": lambda: rj.ClosedLoop(
        PLANT, layers((2, 2))
    ),
    "input_box is 2, but the plant's number of inputs is 1": lambda: LOOP.replace(input_box=X0),
    "input_box is 4, but .* time steps is 3": lambda: LTV.replace(input_box=FOUR_TIMES),
    "x0 is 3, but .* states is 2": lambda: LOOP.simulate(jnp.ones((5, 3)), 1),
    r"x0 must be finite, but entry \(1,\) is nan": lambda: LOOP.simulate([0.0, NAN], 1),
    r"X0 cannot be used: a time-varying box .* \(1, 2\)": lambda: reach(
        X0=rj.Box([[0, 0]], [[1, 1]])
    ),
    "X0 is 1, but the loop's number of states is 2": lambda: reach(X0=LINE),
    "X0 cannot be used: .* unbounded in direction": lambda: reach(X0=STRIP),
    "X0 cannot be used: .* empty: no point satisfies": lambda: reach(X0=EMPTY),
    "template is 3, but .* states is 2": lambda: reach(template=rj.Template.box(3)),
    "'MOSCOW' is not among .*CLARABEL": lambda: reach(solver=rj.CvxpySolver("MOSCOW")),
    "dimension of x is 3, but the network's number of inputs is": lambda: NET([1, 2, 3]),
    "window must be at least 1, but 0 arrived": lambda: reach(window=0),
    "horizon must be at least 1, but 0 arrived": lambda: reach(horizon=0),
    "horizon must be at least 1, but -1 arrived": lambda: LOOP.simulate(jnp.zeros(2), -1),
    "start must be at least 0, but -1 arrived": lambda: reach(start=-1),
    "samples must be at least 1, but -5 arrived": lambda: reach(samples=-5),
    "seed must be at least 0, but -1 arrived": lambda: reach(seed=-1),
    "dimension of directions is 1, but the set's": lambda: X0.support([[1.0]]),
    "dimension of points is 3, but the set's": lambda: X0.contains(np.zeros((4, 3))),
    "dimension of points is 3, but": lambda: rj.Polytope([[1, 0]], [1]).contains(np.zeros(3)),
    r"sequence of sets: take one by at\(t\)": lambda: FOUR_TIMES.support([[1.0]]),
    "AffinePlant is given for times 0 .. 2, but 7": lambda: LTV.plant.at(7),
    "Box is given for times 0 .. 3, but -1": lambda: FOUR_TIMES.at(-1),
    r"Box\.lower must .*shape \(0,\) arrived": lambda: rj.Box([], []),
    "dimension must be at least 1, but 0": lambda: rj.Template.box(0),
    "facets must be at least 3, but 2": lambda: rj.Template.regular(2),
    r"Clarabel\.tolerance must be positive": lambda: rj.Clarabel(tolerance=-1.0),
    r"SCS\.max_iterations must be positive": lambda: rj.SCS(max_iterations=0),
    "'OSQP' cannot solve semidefinite programs": lambda: reach(solver=rj.CvxpySolver("OSQP")),
    "3 time steps .*, but start 0 and horizon 4": lambda: reach(loop=LTV, horizon=4),
    "3 time steps .*, but start 2 and horizon 2": lambda: reach(loop=LTV, horizon=2, start=2),
    "3 time steps .*, but start 3 and horizon 1": lambda: rj.change_of_basis(LTV, t=3),
    "progress must pass on each of the": lambda: reach(progress=lambda steps: []),
}

BAD_TYPES = {
    r"Box\.lower must be an array .* a str arrived": lambda: rj.Box("low", "high"),
    r"MLP\.layers\[0\] must be a pair .* ndarray": lambda: rj.MLP.from_layers([np.ones((3, 1))]),
    r"MLP\.layers must be pairs .*ArrayImpl": lambda: rj.MLP.from_layers(jnp.ones((2, 2))),
    r"MLP\.activation must .*class.*ReLU'": lambda: NET.replace(activation=rj.ReLU),
    r"MLP\.activation must be an activation obj": lambda: NET.replace(activation=jax.nn.relu),
    r"ClosedLoop\.plant must be a plant such as .*, but an MLP": lambda: rj.ClosedLoop(NET, PLANT),
    r"ClosedLoop\.input_box must .* a tuple": lambda: rj.ClosedLoop(PLANT, NET, (-1, 1)),
    r"X0 must be .*\[\[0, 0\], \[1, 1\]\]": lambda: reach(X0=[[0, 0], [1, 1]]),
    "loop must be a ClosedLoop": lambda: reach(loop=NET),
    "loop must be a ClosedLoop, but an MLP": lambda: reach(loop=NET, template=None),
    "loop must be a ClosedLoop, but a Box": lambda: rj.volume_penalty(X0, X0, 1),
    "template must be .*, or None, but a Box arrived": lambda: reach(template=X0),
    "template must be a template": lambda: reach(template=TEMPLATE.directions),
    "relaxation must be a relaxation object.*class.*LocalBounds": lambda: reach(
        relaxation=rj.LocalBounds
    ),
    "solver must be a solver object.*class.*Clarabel": lambda: reach(solver=rj.Clarabel),
    "solver must .*'SCS' arrived": lambda: reach(solver="SCS"),
    "horizon must be a whole number, but True": lambda: reach(horizon=True),
    r"horizon must be a whole number, but 2\.0": lambda: reach(horizon=2.0),
    "horizon must be a whole number, but '2'": lambda: reach(horizon="2"),
    "horizon must be a whole number, but None": lambda: LOOP.simulate(jnp.zeros(2), None),
    r"start must be a whole number, but 1\.5": lambda: reach(start=1.5),
    "start must be a whole number, but None": lambda: reach(start=None),
    r"samples must be a whole number, but 1\.5": lambda: reach(samples=1.5),
    "window must be a whole number, but True": lambda: reach(window=True),
    r"Box\.lower must .* a NoneType arrived": lambda: rj.Box(None, None),
    r"AffinePlant\.A must .* a NoneType arrived": lambda: rj.AffinePlant(None, None),
    r"MLP\.layers must be pairs .*NoneType": lambda: rj.MLP.from_layers(None),
    r"Clarabel\.tolerance must be a number": lambda: rj.Clarabel(tolerance="a"),
    "progress must wrap an iterable": lambda: reach(progress=True),
    "progress must return an iterable .* None arrived": lambda: reach(progress=lambda steps: None),
    "progress must return .* wraps, .* None": lambda: rj.reach_partitioned(
        LOOP, X0, 1, TEMPLATE, window=1, cells=(1, 1), samples=10, progress=lambda tubes: None
    ),
    r"controller must be a network such as .*from_layers .* an MLP of equinox\.nn arrived": (
        lambda: LOOP.replace(controller=type("MLP", (), {"__module__": "equinox.nn"})())
    ),
    "loop must be a ClosedLoop, but an AffinePlant": lambda: reach(loop=PLANT),
    "tube must be a ReachTube": lambda: rj.verify(LOOP, goal=X0),
    # misspelt options
    "tolerence": lambda: rj.Clarabel(tolerence=1e-8),
    "max_iter'": lambda: rj.SCS(max_iter=9),
    "repeat'": lambda: rj.PaperQC(repeat=True),
    "PaperQC.repeated must be True or False, but 'no'": lambda: rj.PaperQC(repeated="no"),
    "stable'": lambda: rj.LocalBounds(stable=True),
    "relaxtion": lambda: reach(relaxtion=rj.PaperQC()),
    "inputbox": lambda: LOOP.replace(inputbox=X0),
}


@pytest.mark.parametrize(("message", "call"), BAD_VALUES.items(), ids=BAD_VALUES)
def test_bad_values_are_named_and_counted(message, call):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("message", "call"), BAD_TYPES.items(), ids=BAD_TYPES)
def test_wrong_kinds_and_misspelt_options_are_named(message, call):
    with pytest.raises(TypeError, match=message):
        call()


@pytest.mark.parametrize("call", [reach, lambda: rj.change_of_basis(LOOP)], ids=["reach", "basis"])
def test_without_64_bit_floats_the_error_says_how_to_turn_them_on(call):
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="jax_enable_x64"):
        call()


@pytest.mark.parametrize("name", ["loop", "X0", "template"])
def test_what_was_built_from_32_bit_floats_is_named(name):
    built = {"loop": LOOP, "X0": X0, "template": TEMPLATE}[name]
    leftover = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), built)
    with pytest.raises(RuntimeError, match=f"{name} holds float32, but float64 is needed"):
        reach(**{name: leftover})


@pytest.mark.parametrize("name", ["goal", "safe", r"avoid\[0\]"])
def test_what_is_required_must_not_be_built_from_32_bit_floats(name):
    kind, inside = re.match(r"[a-z]+", name)[0], rj.Box([-9.0, -9.0], [9.0, 9.0])
    built = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), inside)
    required = {kind: {1: [built]} if kind == "avoid" else built}
    with pytest.raises(RuntimeError, match=f"{name} holds float32, but float64 is needed"):
        rj.decide(LOOP, X0, 1, **required)


FLAT = {
    "box": X0,
    "polytope": rj.Polytope(*X0.facets),
    "ellipsoid": rj.Ellipsoid(np.zeros(2), np.eye(2)),
    "intersection": rj.Intersection(X0, rj.Ellipsoid(np.zeros(2), np.eye(2))),
}
CERTIFIED = {
    "support": lambda X: X.support([[0.1, 0.2]]),
    "surely_contains": lambda X: X.surely_contains([0.1, 0.1]),
}


@pytest.mark.parametrize("question", CERTIFIED.values(), ids=CERTIFIED)
@pytest.mark.parametrize("X", FLAT.values(), ids=FLAT)
def test_sets_certify_nothing_in_32_bits(X, question):
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="needs 64-bit floats"):
        question(X)
    rounded = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), X)
    with pytest.raises(RuntimeError, match="set holds float32, but float64 is needed"):
        question(rounded)


@pytest.fixture(scope="module")
def tube():
    return reach(horizon=2, samples=10)


@pytest.mark.parametrize(
    ("required", "error", "message"),
    [
        ({}, ValueError, "nothing to verify: give a goal, avoid sets or a safe set"),
        ({"avoid": []}, ValueError, "nothing to verify"),
        ({"avoid": STRIP}, TypeError, r"avoid must be a sequence of sets.* a Polytope arrived"),
        (
            {"goal": [0, 1]},
            TypeError,
            r"goal must be a Box, a Polytope or an Ellipsoid, but \[0, 1\] arrived",
        ),
        ({"goal": LINE}, ValueError, "goal has dimension 1, but the loop has 2 states"),
        ({"safe": LINE}, ValueError, "safe has dimension 1, but the loop has 2 states"),
        ({"avoid": [X0, LINE]}, ValueError, r"avoid\[1\] has dimension 1, but the loop has 2"),
        ({"avoid": {1: X0}}, TypeError, r"avoid=\{t: \[A, ...\]\}, but a Box arrived"),
        ({"safe": rj.Box([[0, 0]], [[1, 1]])}, ValueError, "safe must be one box"),
        ({"avoid": {3: [X0]}}, ValueError, "avoid names time 3, but the horizon is 2"),
        ({"gaol": STRIP}, TypeError, "gaol"),
    ],
)
def test_bad_specifications_are_named(tube, required, error, message):
    with pytest.raises(error, match=message):
        rj.verify(tube, **required)


def test_a_verdict_is_not_a_truth_value(tube):
    with pytest.raises(TypeError, match=r"three values: use verdict\.proved"):
        bool(rj.verify(tube, goal=STRIP, samples=10))


@pytest.mark.parametrize("t", [0, -1, 3])
def test_certificates_are_for_the_steps_after_the_first_set(tube, t):
    with pytest.raises(ValueError, match=rf"t = 1 .. 2, but {t} was asked for"):
        tube.proof(t)


def test_a_verdict_is_decided_on_known_numbers(tube):
    with pytest.raises(ValueError, match=r"tube holds traced numbers.*outside of jax\.jit"):
        jax.jit(lambda tube: rj.verify(tube, goal=rj.Box([-9.0] * 2, [9.0] * 2)).margins)(tube)


@pytest.mark.parametrize(
    ("name", "draw"), [("tube", rj.plot_tube), ("region", rj.plot_set)], ids=["tube", "set"]
)
def test_what_cannot_be_drawn_is_named(name, draw):
    with pytest.raises(TypeError, match=f"{name} must be a .*, but .* arrived"):
        draw([1, 2])
