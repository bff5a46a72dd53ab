"""The competition: plants as their definitions have them, instances that fit, and their table."""

import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from experiments.competition import fields, figures, recheck, study
from experiments.competition.instances import instances, slow, within
from experiments.competition.networks import networks
from experiments.competition.study import Settings

EVERY = instances()


def rotated(axis, angle):
    """A rotation about an axis, as a matrix."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = {0: (1, 2), 1: (2, 0), 2: (0, 1)}[axis]
    found = np.eye(3)
    found[i, i] = found[j, j] = c
    found[i, j], found[j, i] = -s, s
    return found


def drawn(count, seed=0):
    return np.random.default_rng(seed).normal(size=count)


@pytest.mark.parametrize("seed", range(5))
def test_a_double_pendulum_obeys_its_equations_of_motion(seed):
    x, u = drawn(4, seed), drawn(2, seed + 9)
    one, other = np.asarray(fields.double_pendulum(jnp.array(x), jnp.array(u)))[2:]
    back = x[1] - x[0]
    first = 2 * one + other * np.cos(back) - x[3] ** 2 * np.sin(back) - 4 * np.sin(x[0])
    second = one * np.cos(back) + other + x[2] ** 2 * np.sin(back) - 2 * np.sin(x[1])
    assert np.allclose([first, second], 8 * u)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("plant", [fields.airplane, fields.quadrotor])
def test_rigid_bodies_turn_and_move_as_rotations_say(plant, seed):
    x = drawn(12, seed)
    x[6:9] *= 0.4
    u = jnp.zeros(6 if plant is fields.airplane else 3)
    found = np.asarray(plant(jnp.array(x), u))
    roll, pitch, yaw = x[6:9]
    turned = rotated(2, yaw) @ rotated(1, pitch) @ rotated(0, roll)
    moved = turned @ x[3:6]
    if plant is fields.quadrotor:
        moved[2] *= -1
    assert np.allclose(found[:3], moved)
    rates = x[[10, 11, 9]] if plant is fields.airplane else x[9:12]

    def rotation(t):
        at = x[6:9] + t * found[6:9]
        return rotated(2, at[2]) @ rotated(1, at[1]) @ rotated(0, at[0])

    change = (rotation(1e-6) - rotation(-1e-6)) / 2e-6
    spin = turned.T @ change  # of the body
    assert np.allclose([spin[2, 1], spin[0, 2], spin[1, 0]], rates, atol=1e-6)
    gravity = turned.T @ np.array([0, 0, 1.0 if plant is fields.airplane else 9.81])
    if plant is fields.quadrotor:
        gravity -= [0, 0, 9.81]  # the thrust that hovers
    assert np.allclose(found[3:6], gravity - np.cross(rates, x[3:6]))


def test_a_body_that_turns_about_an_axis_turns_its_parameter():
    """About one axis Rodrigues' parameter is `p = tan(angle / 2)`, so `2 p' = (1 + p^2) w`."""
    x = jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.5])
    found = np.asarray(fields.attitude(x, jnp.zeros(3)))
    assert found[5] == pytest.approx(0.5 * (1 + 0.5**2))
    assert np.allclose(found[:3], 0)


@pytest.mark.parametrize("worst", [False, True])
def test_pilots_do_as_they_are_advised(worst):
    step, rng = fields.avoidance(worst), np.random.default_rng(0)
    for _ in range(40):
        last, following, way = rng.integers(9), rng.integers(9), rng.integers(3)
        h, v, left = rng.uniform(-300, 300), rng.uniform(-60, 60), 20.0
        x = jnp.concatenate([jnp.array([h, v, left]), jnp.eye(9)[last]])
        w = (jnp.eye(3)[way],) if worst else ()
        found = np.asarray(step(x, jnp.eye(9)[following], *w))
        options = fields.CHOICES[following]
        a = options[way if worst else 1]
        sign, rate = fields.COMPLIES[following]
        if following == last and sign and np.isfinite(rate) and sign * (v - rate) >= 0:
            a = 0.0
        expected = [h - v - a / 2, v + a, left - 1, *np.eye(9)[following]]
        assert np.allclose(found, expected)


def test_states_within_half_planes_keep_the_limit_of_speed():
    region, rng = slow(0.2, 0.002), np.random.default_rng(0)
    states = np.hstack([rng.uniform(0, 120, (4000, 2)), rng.uniform(-0.5, 0.5, (4000, 2))])
    inside = np.asarray(region.contains(jnp.asarray(states)))
    away, speed = (np.linalg.norm(states[:, part], axis=1) for part in (slice(2), slice(2, 4)))
    assert inside.sum() > 100
    assert np.all(speed[inside] <= 0.2 + 0.002 * away[inside])
    assert inside.sum() > 0.9 * np.sum(speed <= 0.2 + 0.002 * away)


@pytest.mark.parametrize("title", EVERY)
def test_every_instance_fits_its_loop(title, tmp_path):
    instance = EVERY[title]
    for one, other in instance.planes:
        assert 0 <= one <= instance.X0.dimension
        assert 1 <= other <= instance.X0.dimension
    if instance.shape is not None:
        seen, inputs = instance.shape.samples(instance.X0, 20)
        layers, size = [], seen.shape[1]
        for width in (*instance.shape.hidden, inputs.shape[1]):
            layers.append((np.zeros((width, size)), np.zeros(width)))
            size = width
        nets = [rj.MLP.from_layers(layers)]
    else:
        nets = networks(instance, None, 1, tmp_path)
    loop = instance.loop(nets)
    assert loop.states == instance.X0.dimension
    runs = np.asarray(loop.simulate(instance.X0.center, 1))
    assert np.isfinite(runs).all()


def test_limits_of_coordinates_are_facets():
    region = within(3, {2: (-1.0, 2.0)})
    points = jnp.array([[9.0, 0.0, 9.0], [0.0, 2.1, 0.0], [0.0, -1.1, 0.0]])
    assert np.asarray(region.contains(points)).tolist() == [True, False, False]


def test_titles_are_those_of_the_competition():
    assert len(EVERY) == 25
    assert {each.benchmark for each in EVERY.values()} == {
        *("ACC", "Airplane", "Attitude Control", "Balancing", "Docking", "Double Pendulum"),
        *("NAV", "QUAD", "Single Pendulum", "TORA", "Unicycle", "VCAS"),
    }


def test_networks_are_found_by_their_paths_there(tmp_path):
    instance = EVERY["single-pendulum-reach"]
    with pytest.raises(FileNotFoundError, match="has none of"):
        instance.paths(tmp_path)
    folder = tmp_path / "benchmarks" / "Single_Pendulum"
    folder.mkdir(parents=True)
    (folder / "controller_single_pendulum.onnx").write_bytes(b"")
    assert instance.paths(tmp_path) == [folder / "controller_single_pendulum.onnx"]


def test_requirements_are_drawn_when_they_are_meant():
    def spans(title, period):
        return [(name, *span) for name, _, *span in figures.regions_by_time(EVERY[title], period)]

    assert spans("single-pendulum-reach", 0.05) == [("goal", 10, 20)]
    assert spans("nav-standard", 0.2) == [("avoid", 0, 30), ("goal", 30, 30)]
    assert spans("airplane-discrete", 0.1) == [("goal", k, k) for k in range(21)]
    assert spans("vcas-worst-19.5", None) == [("avoid", k, k) for k in range(1, 11)]


def test_a_folder_without_any_network_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="clone of the benchmark repository"):
        study.main(settings(tmp_path / "results", path=tmp_path))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mine.verdict", "FILE must be a verdict that is named as an instance"),
        ("nav-robust.json", "FILE must be a verdict that is named as an instance"),
        ("nav-robust.verdict", "FILE must be there"),
    ],
)
def test_a_file_that_is_no_verdict_of_an_instance_is_an_error(tmp_path, name, said):
    with pytest.raises(ValueError, match=said):
        recheck.Settings(tmp_path / name)


def test_a_verdict_is_rechecked_where_it_was_written(tmp_path):
    (tmp_path / "nav-robust.verdict").touch()
    with pytest.raises(ValueError, match="FILE must stand where it was written"):
        recheck.main(recheck.Settings(tmp_path / "nav-robust.verdict"))


def test_of_facets_along_an_axis_the_tightest_one_is_drawn():
    region = rj.Polytope([[1.0, 0], [1, 0], [-1, 0], [-2, 0], [0, 1], [1, 1]], [5.0, 1, 4, 4, 3, 0])
    found = figures._ends(region, (1, 2))
    np.testing.assert_array_equal(found, [[-2, -np.inf], [1, 3]])


def settings(tmp_path, **more):
    given = {"only": ("single-pendulum",), "output": tmp_path, "limit": 60.0}
    return Settings(**given | {"training_steps": 500, "simulations": 20} | more)


@pytest.mark.parametrize("failed", [True, False])
def test_an_instance_is_tried_again_if_its_process_failed(failed, tmp_path, monkeypatch):
    """What took too long would do so again."""
    calls = []

    def stopped(instance, settings):
        calls.append(instance.title)
        row = {"title": instance.title, "benchmark": instance.benchmark, "name": instance.name}
        return row | {
            "verdict": "UNKNOWN",
            "limit": 60.0,
            "path": None,
            "stopped": "so",
            "failed": failed,
        }

    monkeypatch.setattr(study, "row_of", stopped)
    study.main(settings(tmp_path))
    study.main(settings(tmp_path))
    assert calls == ["single-pendulum-reach"] * (1 + failed)
    (row,) = study.stored(tmp_path / "results.json")
    assert row["stopped"] == "so"


@pytest.mark.costly
def test_an_instance_has_a_row_a_line_and_a_verdict_that_is_proved_anew(
    tmp_path, monkeypatch, capsys
):
    study.main(settings(tmp_path))
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert row["verdict"] in ("PROVED", "REFUTED")
    assert row["first"] > 0
    assert row["recheck"] > 0
    with (tmp_path / "results.csv").open() as file:
        head, line = csv.reader(file)
    assert head == ["benchmark", "instance", "result", "time"]
    assert line[:3] == ["Single Pendulum", "reach", study.WORDS[row["verdict"]]]
    assert (tmp_path / "single-pendulum-reach.png").exists()

    def refuse(*_):
        raise AssertionError("it was decided again")

    monkeypatch.setattr(study, "row_of", refuse)
    study.main(settings(tmp_path))  # nothing is left to do
    (file,) = (tmp_path / "verdicts").glob("*.verdict")
    capsys.readouterr()
    recheck.main(recheck.Settings(file, processes=1))
    assert row["verdict"] in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"limit": 0.0}, "--limit"),
        ({"only": ("nothing",)}, "--only"),
        ({"only": ("nav", "folder")}, "but folder arrived"),
        ({"path": 3}, "PATH"),
    ],
)
def test_options_that_cannot_be_are_named(tmp_path, more, named):
    if named == "PATH":
        more = {"path": tmp_path / "missing"}
    with pytest.raises(ValueError, match=named):
        settings(tmp_path, **more)


@pytest.mark.parametrize("word", ["Single Pendulum", "single-pendulum", "SINGLE-PENDULUM reach"])
def test_an_instance_is_named_as_its_benchmark_or_as_its_title(tmp_path, word):
    (instance,) = settings(tmp_path, only=(word,)).chosen
    assert instance.title == "single-pendulum-reach"


def test_corners_leave_flat_coordinates_alone():
    box = rj.Box([0.0, 1.0, 2.0], [1.0, 1.0, 3.0])
    assert sorted(map(tuple, study.corners(box))) == [
        (0.0, 1.0, 2.0),
        (0.0, 1.0, 3.0),
        (1.0, 1.0, 2.0),
        (1.0, 1.0, 3.0),
    ]


def test_a_cart_pole_moves_as_its_definition_says():
    x, u = drawn(4), drawn(1, 1)
    found = np.asarray(jax.jit(fields.cart_pole)(jnp.array(x), jnp.array(u)))
    expected = (
        0.08 * 0.41 * (9.8 * np.sin(x[2]) - 2 * u[0] * np.cos(x[2])) - 0.0021 * x[3]
    ) / 0.0105
    assert np.allclose(found, [x[1], 2 * u[0], x[3], expected])
