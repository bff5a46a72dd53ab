"""Files of tubes that somebody wrote to deceive what reads them, or to break it."""

import copy
import json
import zipfile
from collections import Counter

import numpy as np
import pytest

import reachjax as rj
from reachjax.numerics import archives
from tests.cases import Case
from tests.laws.changes import same
from tests.laws.test_saves import given, made

ATTACKED = (
    *("branches", "cells", "cells of branches", "forms", "jumps", "programs", "ellipsoids"),
    *("mixed", "partition"),
)
ODD = [np.nan, np.inf, -np.inf, -1e300, 1e300, 0.0, -1.0, 5e-324]
NOTHING = [None, "x", 3, -1, 2**70, 1e400, True, [], {}, {"tuple": []}, {"list": [1, 2]}]
REFUSED = rj.UnreadableError, rj.DisagreementError
SEVERAL = 60


def opened(path):
    head, arrays = archives.read_archive(path)
    return head, [array.copy() for array in arrays]


def written(path, head, arrays):
    """A file with this document and these arrays, those that the document names in their order."""
    names = [n for n in archives._numbers(head["value"]) if isinstance(n, int)]
    known = [n for n in dict.fromkeys(names) if 0 <= n < len(arrays)]
    places = {n: k for k, n in enumerate(known)}

    def renamed(node):
        if isinstance(node, list):
            return [*map(renamed, node)]
        if not isinstance(node, dict):
            return node
        found = {key: renamed(each) for key, each in node.items()}
        number = found.get("array")
        if isinstance(number, int) and number in places:
            found["array"] = places[number]
        return found

    head = head | {"value": renamed(head["value"])}
    kept = [arrays[n] for n in known]
    archives.write_archive(path, head | {"digest": archives.digest(head["value"], kept)}, kept)


def places_of(node, found=None):
    """All containers of a document with the keys of what they hold."""
    found = [] if found is None else found
    if isinstance(node, dict | list):
        for key, each in node.items() if isinstance(node, dict) else enumerate(node):
            found.append((node, key))
            places_of(each, found)
    return found


def with_other_bytes(rng, head, arrays):
    array = arrays[rng.integers(len(arrays))]
    flat = array.reshape(-1).view(np.uint8)
    if len(flat):
        flat[rng.integers(len(flat), size=rng.integers(1, 5))] = rng.integers(256)


def with_odd_number(rng, head, arrays):
    array = arrays[rng.integers(len(arrays))].reshape(-1)
    if array.dtype.kind == "f" and len(array):
        array[rng.integers(len(array))] = rng.choice(ODD)
    elif len(array):
        array[rng.integers(len(array))] = rng.integers(0, 100)


def with_other_array(rng, head, arrays):
    k = int(rng.integers(len(arrays)))
    array = arrays[k]
    changes = [
        lambda: array[:-1] if array.ndim else array[None],
        lambda: array.T,
        lambda: array.reshape(-1),
        lambda: array[None],
        lambda: array.astype(np.float32),
        lambda: array.astype(complex),
        lambda: array.astype(bool),
        lambda: array.astype(np.int8),
        lambda: np.zeros(0),
        lambda: -array if array.dtype.kind == "f" else array + 1,
        lambda: array[::-1].copy() if array.ndim else array,
    ]
    with np.errstate(all="ignore"):
        arrays[k] = np.ascontiguousarray(changes[rng.integers(len(changes))]())


def with_exchanged_arrays(rng, head, arrays):
    i, j = rng.integers(len(arrays), size=2)
    arrays[i], arrays[j] = arrays[j], arrays[i]


def with_another_node(rng, head, arrays):
    every = places_of(head["value"])
    node, key = every[rng.integers(len(every))]
    node[key] = NOTHING[rng.integers(len(NOTHING))]


def with_exchanged_nodes(rng, head, arrays):
    every = places_of(head["value"])
    (node, key), (other, name) = (every[k] for k in rng.integers(len(every), size=2))
    node[key], other[name] = copy.deepcopy(other[name]), copy.deepcopy(node[key])


def without_a_node(rng, head, arrays):
    every = places_of(head["value"])
    node, key = every[rng.integers(len(every))]
    del node[key]


def with_a_node_again(rng, head, arrays):
    every = [(node, key) for node, key in places_of(head["value"]) if isinstance(node, list)]
    node, key = every[rng.integers(len(every))]
    node.insert(key, copy.deepcopy(node[key]))


def with_another_name(rng, head, arrays):
    every = [(n, k) for n, k in places_of(head["value"]) if isinstance(n[k], str)]
    node, key = every[rng.integers(len(every))]
    other, name = every[rng.integers(len(every))]
    node[key] = other[name]


CHANGES = [
    with_other_bytes,
    with_odd_number,
    with_other_array,
    with_exchanged_arrays,
    with_another_node,
    with_exchanged_nodes,
    without_a_node,
    with_a_node_again,
    with_another_name,
]


def spoilt(rng, path, whole):
    """A file that is cut off, or in which some bits are others, digest or not."""
    broken = bytearray(whole[: rng.integers(len(whole))] if rng.integers(2) else whole)
    for place in rng.integers(max(len(broken), 1), size=rng.integers(0, 4)):
        if len(broken):
            broken[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(broken))


def attack(rng, path, kind):
    """What comes of one file: refused, the same claims, weaker ones, or claims of another loop."""
    tube = made(kind)
    tube.save(path)
    if rng.integers(10) == 0:
        spoilt(rng, path, path.read_bytes())
    else:
        head, arrays = opened(path)
        head["left_out"] = False
        CHANGES[rng.integers(len(CHANGES))](rng, head, arrays)
        written(path, head, arrays)
    try:
        again = rj.load(path, given(kind), recheck=True)
    except REFUSED as error:
        return type(error).__name__
    except ValueError as error:
        if "loop must be that of the tube" in str(error):  # which was given
            return "another loop"
        raise
    return judged(tube, again)


def tubes_of(tube):
    return tube.tubes if isinstance(tube, rj.PartitionedTube) else (tube,)


def judged(tube, again):
    """Whether claims that were read are true; those of another loop are tried on trajectories."""
    whole = [getattr(each, "X0", None) for each in (tube, again)]
    if whole[0] is not None and not same(*whole):
        return judged_by_trajectories(again)
    if len(tubes_of(tube)) != len(tubes_of(again)):  # a cell twice
        return judged_by_trajectories(again)
    kinds = []
    for one, other in zip(tubes_of(tube), tubes_of(again), strict=True):
        about = [(t.loop, t.template, t.sets[0], t.start) for t in (one, other)]
        if not same(*about) or one.horizon < other.horizon:
            return judged_by_trajectories(again)
        for k in range(1, other.horizon + 1):  # the tube may be shorter
            proofs = one.proof(k), other.proof(k)
            if same(one.sets[k], other.sets[k]) and same(proofs[0].bounds, proofs[1].bounds):
                kinds.append("the same claims")
            elif one.sets[k].parts[1] is not None or other.sets[k].parts[1] is not None:
                return judged_by_trajectories(again)
            else:
                assert np.all(other.sets[k].b >= one.sets[k].b), "a bound is lower"
                kinds.append("weaker claims")
            near = np.isclose(*(p.witnesses for p in proofs), rtol=1e-8, atol=1e-9)
            assert np.all(near | np.isnan(proofs[1].witnesses)), "a witness is another"
    return max(kinds)


def judged_by_trajectories(again):
    for tube in tubes_of(again):
        runs = np.asarray(tube.simulate(200))
        for k, X in enumerate(tube.sets):
            assert np.asarray(X.contains(runs[:, k], 1e-9)).all(), (
                f"a state is outside of sets[{k}]"
            )
    return "true claims of another tube"


@pytest.mark.costly
@pytest.mark.parametrize("count", [SEVERAL, pytest.param(1000, marks=pytest.mark.long)])
def test_files_that_were_changed_in_any_way(count, tmp_path, record_property):
    rng, found = np.random.default_rng(7), Counter()
    for k in range(count):
        kind = ATTACKED[rng.integers(len(ATTACKED))]
        state = rng.bit_generator.state["state"]["state"]
        try:
            found[attack(rng, tmp_path / "tube.reach", kind)] += 1
        except BaseException as error:
            error.add_note(f"file {k} of kind {kind}, state {state}")
            raise
    record_property("outcomes", dict(found))
    refused = found["UnreadableError"] + found["DisagreementError"]
    assert refused >= 0.6 * count  # else hardly anything was changed


# one of each kind ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    return Case("relu", "forms").reach(steps=1)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tube.reach"


@pytest.mark.parametrize("levels", [300, 900, 100_000])
def test_a_document_of_many_levels(levels, path):
    text = '{"value": ' + levels * '{"tuple": [' + "3" + levels * "]}" + "}"
    with path.open("wb") as file:
        np.savez(file, **{archives.DOCUMENT: np.frombuffer(text.encode(), np.uint8)})
    with pytest.raises(rj.UnreadableError):
        rj.load(path)


@pytest.mark.parametrize("held", ["unused", "named"])
def test_a_file_that_holds_more_than_it_may(held, small, path, monkeypatch):
    """A megabyte of zeros is a kilobyte in a file."""
    monkeypatch.setattr(archives, "LEAST", 2**20)
    small.save(path)
    rj.load(path)
    head, arrays = opened(path)
    arrays.append(np.zeros(2**22))
    if held == "named":
        fields = head["value"]["parts"][0]["fields"]
        fields["certificates"]["tuple"][1]["fields"]["bounds"]["array"] = len(arrays) - 1
    head["digest"] = archives.digest(head["value"], arrays)
    held = {f"a{k}": array for k, array in enumerate(arrays)}
    held[archives.DOCUMENT] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    with path.open("wb") as file:
        np.savez_compressed(file, **held)
    with pytest.raises(rj.UnreadableError, match=r"it holds .* more than the .* that it may"):
        rj.load(path)


def test_what_shrinks_too_well_is_not_compressed(path, monkeypatch):
    monkeypatch.setattr(archives, "LEAST", 2**20)
    held = [np.zeros(2**18)]
    head = {"value": {"array": 0}}
    archives.write_archive(path, head, held)
    assert np.array_equal(archives.read_archive(path)[1], held)


def test_arrays_that_the_document_does_not_name(small, path):
    small.save(path)
    head, arrays = opened(path)
    archives.write_archive(path, head, [*arrays, np.zeros(3)])
    with pytest.raises(rj.UnreadableError, match="other arrays than its document names"):
        rj.load(path)


def test_an_array_that_says_it_is_larger_than_it_is(small, path):
    small.save(path)
    with zipfile.ZipFile(path) as file:
        entries = {name: file.read(name) for name in file.namelist()}
    entries["a0.npy"] = entries["a0.npy"].replace(b"(", b"(10**", 1)
    with zipfile.ZipFile(path, "w") as file:
        for name, content in entries.items():
            file.writestr(name, content)
    with pytest.raises(rj.UnreadableError):
        rj.load(path)


def test_a_folder_is_no_file(small, tmp_path):
    with pytest.raises(IsADirectoryError, match=r"is a folder: .* such as .*tube\.reach"):
        small.save(tmp_path)


def test_garbage_is_refused_without_a_recheck(small, path):
    small.save(path)
    head, arrays = opened(path)
    fields = head["value"]["parts"][0]["fields"]
    fields["certificates"]["tuple"][1] = "proof"
    written(path, head, arrays)
    with pytest.raises(rj.UnreadableError, match=r"ReachTube\.certificates must be of"):
        rj.load(path)


# files of earlier versions ------------------------------------------------------------------------


def without(node, *names):
    """A document without fields that were added later."""
    if isinstance(node, list):
        return [without(each, *names) for each in node]
    if not isinstance(node, dict):
        return node
    return {key: without(each, *names) for key, each in node.items() if key not in names}


@pytest.mark.parametrize("kind", ["branches", "programs"])
@pytest.mark.costly
def test_a_file_of_an_earlier_version_is_read(kind, path):
    tube = made(kind)
    tube.save(path)
    head, arrays = opened(path)
    head["value"] = without(head["value"], "ranges", "time", "origin")
    written(path, head, arrays)
    assert same(rj.load(path).sets, tube.sets)
    if kind == "branches":  # what is not said is found again
        assert same(rj.load(path, recheck=True).sets, tube.sets)
    else:
        with pytest.raises(rj.DisagreementError, match=r"an earlier version wrote .* reach again"):
            rj.load(path, recheck=True)


@pytest.mark.parametrize("by", [1e-13, 0.1])
def test_a_shape_that_is_not_symmetric_is_refused(by, tmp_path):
    """An ellipsoid makes its shape symmetric, so that no file of one has another."""
    path, net = tmp_path / "a.tube", rj.MLP.from_layers([([[0.0, 0.0]], [0.0])])
    loop = rj.ClosedLoop(rj.AffinePlant([[0.5, 0.1], [0.0, 0.5]], [[1.0], [0.0]]), net)
    X0 = rj.Ellipsoid([0.0, 0.0], [[2.0, 0.25], [0.25, 1.0]])
    rj.reach(loop, X0, 1, rj.Template.box(2)).save(path)
    head, arrays = opened(path)
    (shape,) = (a for a in arrays if a.shape == (2, 2) and a[0, 1] == 0.25)
    shape[0, 1] += by
    written(path, head, arrays)
    for recheck in (False, True):
        with pytest.raises(rj.UnreadableError, match="shape"):
            rj.load(path, recheck=recheck)
