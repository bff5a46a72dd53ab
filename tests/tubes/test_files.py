"""Tubes from files are those that were written, and other files are refused."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics import archives, storage
from reachjax.programs.affine import AffineForms
from tests.closed_loops import closed_loop, own_plant, random_loop
from tests.laws.changes import unclaimed

BOX = rj.Template.box(2)


@pytest.fixture(scope="module")
def loop():
    return closed_loop(random_loop(2, (4, 3), seed=2))


@pytest.fixture(scope="module")
def X0():
    return rj.Box([-0.2, -0.2], [0.2, 0.2])


@pytest.fixture(scope="module")
def tube(loop, X0):
    return rj.reach(loop, X0, 2, BOX)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tube.reach"


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def equal(one, other):
    one, other = map(unclaimed, (one, other))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert all(map(np.array_equal, arrays(one), arrays(other), [True] * len(arrays(one))))


@pytest.mark.parametrize("name", ["default", "mixed", "cells"])
def test_files_that_name_classes_by_the_modules_of_an_earlier_layout_are_read(name):
    path = Path(__file__).parents[1] / "data" / "tubes" / f"{name}.npz"
    tube = rj.load(path, recheck=True)
    assert isinstance(tube, rj.PartitionedTube if name == "cells" else rj.ReachTube)


def test_a_field_that_is_made_anew_by_default_may_be_missing():
    named, parts = (AffineForms, "rows", "radii"), (np.zeros((1, 3)), np.zeros((1, 2)))
    assert storage._rebuilt(named, *parts).inner == {}
    with pytest.raises(ValueError, match="other fields than this version's"):
        storage._rebuilt(named[:2], *parts[:1])


def sine(p, x, u):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + p * jnp.sin(x[0]) + 0.1 * u[0]])


def nearly_sine(p, x, u):
    return sine(p, x, u) + jnp.array([0.0, 1e-3]) * jnp.maximum(x[1] - 5.0, 0.0)


def cosine(p, x, u):
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + p * jnp.cos(x[0]) + 0.1 * u[0]])


def curved(f=sine, p=0.5):
    plant = rj.NonlinearPlant(jax.tree_util.Partial(f, jnp.asarray(p)), states=2, inputs=1)
    net = rj.MLP.from_layers([([[1.0, 0.5]], [0.0]), ([[-3.0]], [0.0])], rj.Tanh())
    return rj.ClosedLoop(plant, net)


@pytest.mark.costly
def test_another_process_reads_the_same(tube, path):
    tube.save(path)
    script = (
        "import jax; jax.config.update('jax_enable_x64', True); import reachjax as rj;"
        f"tube = rj.load({str(path)!r}, recheck=True); print(tube.sets[2].b.tolist())"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == tube.sets[2].b.tolist()


@pytest.mark.costly
def test_a_function_is_given_again(path):
    loop, X0 = curved(), rj.Box([0.1, -0.1], [0.2, 0.1])
    tube = rj.reach(loop, X0, 2, BOX)
    tube.save(path)
    with pytest.raises(ValueError, match=r"written without its loop.*load\(path, loop=\.\.\.\)"):
        rj.load(path)
    seen = []
    again = rj.load(
        path, curved(), recheck=True, progress=lambda s: [seen.append(1) or x for x in s]
    )
    assert len(seen) == 2
    equal(tube.sets, again.sets)
    others = curved(p=0.5000001), curved(cosine), curved(nearly_sine), closed_loop(random_loop(2))
    for other in others:
        with pytest.raises(ValueError, match="loop must be that of the tube"):
            rj.load(path, other)


def test_a_seal_is_of_what_functions_compute():
    def made(c):
        law = rj.Network(lambda x: -0.4 * jax.nn.relu(x) + c, inputs=1, outputs=1)
        return rj.ClosedLoop(rj.AffinePlant([[1.0]], [[1.0]]), law)

    tube = rj.reach(made(0.0), rj.Box([1.0], [2.0]), 1, rj.Template.box(1))
    tube.replace(loop=made(0.0))  # the same function, written again
    with pytest.raises(ValueError, match="not those that were computed together"):
        tube.replace(loop=made(5e-10))


def test_a_bar_must_pass_on_all_steps(tube, path):
    tube.save(path)
    with pytest.raises(ValueError, match="progress must pass on each step, but 1 of 2 did not"):
        rj.load(path, recheck=True, progress=lambda steps: list(steps)[1:])


def test_a_loop_with_a_plant_of_its_own_is_asked_for_again(X0, path):
    plant = own_plant()(jnp.array([[0.5, 0.1], [0.2, 0.7]]), jnp.array([[1.0], [0.5]]))
    loop = rj.ClosedLoop(plant, curved().controller)
    tube = rj.reach(loop, X0, 2, BOX)
    tube.save(path)
    with pytest.raises(ValueError, match="loop"):
        rj.load(path)
    equal(rj.load(path, loop, recheck=True), tube)


# files that are something else -------------------------------------------------------------------


def loaded(path):
    try:
        return rj.load(path)
    except ValueError as error:
        return error


def changed(path, **changes):
    """The file with another document."""
    with np.load(path) as found:
        held = dict(found)
    head = json.loads(held[archives.DOCUMENT].tobytes()) | changes
    held[archives.DOCUMENT] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    with path.open("wb") as file:
        np.savez(file, **held)


def test_a_file_of_another_version(tube, path):
    tube.save(path)
    changed(path, version=7, release="9.9")
    with pytest.raises(
        ValueError, match=r"of version 7 .*written by reachjax 9\.9.*reads version 1"
    ):
        rj.load(path)


def test_a_file_that_was_changed(tube, path):
    tube.save(path)
    with np.load(path) as found:
        held = dict(found)
    held["a0"] = held["a0"] + 1e-9
    with path.open("wb") as file:
        np.savez(file, **held)
    with pytest.raises(ValueError, match="changed after it was written"):
        rj.load(path)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.6, 0.999])
def test_a_file_that_is_cut_off(part, tube, path):
    tube.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ValueError, match=r"tube\.reach is no file that reachjax wrote, or"):
        rj.load(path)


@pytest.mark.costly
def test_a_file_with_a_flipped_bit(tube, path):
    tube.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    flips = [(place, rng.integers(8)) for place in rng.integers(len(whole), size=60)]
    names = whole.rfind(b"PK\x01\x02")  # in the list of contents: how its last entry is packed
    flips += [(names + place, bit) for place in range(6, 12) for bit in range(8)]
    for place, bit in flips:
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << int(bit)
        path.write_bytes(bytes(spoilt))
        found = loaded(path)
        if isinstance(found, ValueError):
            assert "tube.reach" in str(found)
        else:  # of what nobody reads
            equal(found, tube)


def test_foreign_files(tube, path):
    with path.open("wb") as file:
        np.savez(file, a0=np.ones(2))
    with pytest.raises(ValueError, match="is no file that reachjax wrote"):
        rj.load(path)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("note.txt", "hello")
    with pytest.raises(ValueError, match="is no file that reachjax wrote"):
        rj.load(path)
    with pytest.raises(FileNotFoundError, match="there is none at"):
        rj.load(path.with_name("none"))
    with pytest.raises(FileNotFoundError, match="path must lie in a folder"):
        tube.save(path.parent / "none" / "tube.reach")
    with pytest.raises(TypeError, match="loop must be a ClosedLoop"):
        rj.load(path, tube)


@pytest.mark.parametrize(
    "value",
    [
        {"object": "os:system", "fields": {}},
        {"object": "reachjax.numerics.storage:importlib", "fields": {}},
        {"object": "reachjax.loops:ClosedLoop", "fields": {}},
        {"named": "subprocess:Popen", "parts": ["true"]},
        {"named": "reachjax.loops:ReLU", "parts": []},
        {"enum": "reachjax.loops:ReLU", "member": "x"},
        {"stored": "reachjax.loops:ReLU", "as": None},
        {"stored": "reachjax.none:Nothing", "as": None},
        {"array": 999, "on": ""},
        {"what": 1},
        3,
    ],
)
def test_a_document_names_classes_of_the_package_only(value, path):
    head = {"format": storage.PACKAGE, "version": storage.VERSION, "release": "", "value": value}
    head |= {"left_out": False, "digest": archives.digest(value, [])}
    archives.write_archive(path, head, [])
    said = r"tube\.reach (cannot be read|must hold a tube|is no file .* other arrays)"
    with pytest.raises(rj.UnreadableError, match=said):
        rj.load(path)


@pytest.mark.parametrize("kind", ["named", "enum", "stored", "object"])
def test_a_crafted_file_runs_nothing(kind, tmp_path):
    """Classes of others can be reached through what modules of the package import."""
    made = tmp_path / "made"
    name = "reachjax.numerics.pytrees:jax.version.subprocess.Popen"
    command = {"list": ["touch", str(made)]}
    value = {kind: name, "parts": [command], "member": "x", "as": command, "fields": {}}
    path = tmp_path / "crafted.reach"
    head = {"format": storage.PACKAGE, "version": storage.VERSION, "release": "x", "value": value}
    head |= {"left_out": False, "digest": archives.digest(value, [])}
    archives.write_archive(path, head, [])
    with pytest.raises(ValueError, match="which is not of reachjax"):
        rj.load(path)
    assert not made.exists()
