"""What is kept of a case: numbers as they are, words, and seconds."""

import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reachjax as rj
from tests.golden.cases import Golden, required

Record = dict[str, Any]
"""By what it is: numbers `sets`, `bounds`, `gradient`; words `statuses`, `verdict`, `decision`."""

NUMBERS = ("sets", "bounds", "gradient")
SECONDS = "seconds"


def numbers(tree: Any) -> list[float]:
    """All entries of all arrays of a pytree."""
    leaves = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([*leaves, np.zeros(0)]).tolist()


def size(region: Any) -> Any:
    """A number that grows with a set: the sum of its offsets, or the logarithm of its volume."""
    _, ball = region.parts
    return region.facets[1].sum() + (0.0 if ball is None else rj.log_volume(ball))


def recorded(case: Golden) -> Record:
    """What the library says of a case; of what raises, the kind and the words of the error."""
    found: Record = {}
    began = time.process_time()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for name, value in _said(case):
            found[name] = value
    found[SECONDS] = round(time.process_time() - began, 3)
    return found


def _said(case: Golden) -> Iterator[tuple[str, Any]]:
    X0, times = case.parts["X0"], range(1, case.horizon + 1)
    try:
        tube = case.reach(X0)
    except (TypeError, ValueError, RuntimeError) as error:
        yield "error", f"{type(error).__name__}: {error}"
        return
    proofs = [tube.proof(t) for t in times]
    yield "sets", numbers(tube.sets[1:])
    yield "bounds", numbers([getattr(proof, "bounds", ()) for proof in proofs])
    yield "proofs", [type(proof).__name__ for proof in proofs]
    yield "statuses", [status.name for proof in proofs for status in proof.statuses]
    try:
        safe = required(tube)
        verdict = rj.verify(tube, safe=safe, samples=50)
        yield "verdict", verdict.status.name
        options = {"start": case.start, "samples": 50}
        decision = rj.decide(case.parts["loop"], X0, case.horizon, safe=safe, **options)
        yield "decision", decision.status.name
    except (TypeError, ValueError, RuntimeError) as error:
        yield "refused", f"{type(error).__name__}: {error}"
    if case.differentiated:
        try:
            yield "gradient", numbers(jax.grad(lambda X0: size(case.reach(X0).sets[-1]))(X0))
        except (TypeError, ValueError, RuntimeError) as error:
            yield "no gradient", f"{type(error).__name__}: {error}"


def written(path: Path, records: dict[str, Record]) -> None:
    """Keep records, one line a case."""
    lines = [f"{json.dumps(name)}: {json.dumps(record)}" for name, record in records.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def read(path: Path) -> dict[str, Record]:
    """Records that were kept."""
    return json.loads(path.read_text())


def differences(before: Record, after: Record) -> dict[str, str]:
    """What is not the same, by name, with the largest relative difference of numbers."""
    found = {}
    for name in sorted((before.keys() | after.keys()) - {SECONDS}):
        old, new = before.get(name), after.get(name)
        if json.dumps(old) == json.dumps(new):
            continue
        comparable = name in NUMBERS and None not in (old, new) and len(old) == len(new)
        found[name] = f"by {apart(old, new):.1e}" if comparable else f"{old} is {new}"
    return found


def apart(old: list[float], new: list[float]) -> float:
    """The largest difference, as a part of the largest number or of one; infinite where one of two
    is no number.
    """
    a, b = np.array(old), np.array(new)
    fine = np.isfinite(a) & np.isfinite(b)
    if not np.array_equal(a[~fine], b[~fine], equal_nan=True):
        return np.inf
    scale = max(1.0, abs(a[fine]).max(initial=0.0))
    return float(abs(a - b)[fine].max(initial=0.0) / scale)
