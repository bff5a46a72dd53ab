"""Random loops, sets, templates, relaxations, windows and solvers: nothing that is said is false.

    python -m pytest tests/campaign                          # a few hundred cases
    python -m pytest tests/campaign -n 2 --cases 10000       # with a bar; --resume goes on
    python -m pytest tests/campaign --seed 7 --case 123      # one case alone

A test is a block of cases whose shapes agree; what failed is printed as Python that shows it.
"""

import itertools
import json

import pytest

from tests.campaign import cases, claims, kinds, of_kinds
from tests.campaign.architectures import BLOCK, EVERY, architecture
from tests.campaign.outcomes import Outcome
from tests.campaign.session import PROPERTY, Journal, numbers
from tests.memory import forget

MOST_PRINTED = 3
"""So many failing cases of a block are printed; the report has the others."""

LOOPS = [shapes.loop for shapes in EVERY]


def pytest_generate_tests(metafunc):
    if "block" not in metafunc.fixturenames:
        return
    blocks = [list(part) for _, part in itertools.groupby(numbers(metafunc.config), _block)]
    blocks.sort(key=lambda block: _shapes(block[0]))  # what is compiled alike, one after the other
    names = [f"{architecture(block[0]).name}: {block[0]}-{block[-1]}" for block in blocks]
    metafunc.parametrize("block", blocks, ids=names)


def _block(number: int) -> int:
    return number // BLOCK


def _shapes(number: int) -> tuple[int, int]:
    shapes = architecture(number)
    return LOOPS.index(shapes.loop), EVERY.index(shapes)


@pytest.fixture(scope="module")
def journal(request):
    return Journal(request.config)


@pytest.fixture(scope="module")
def finished(journal):
    return journal.finished()


@pytest.fixture(scope="module")
def compiled():
    """The shapes of the loop for which there is compiled code in this process."""
    return []


@pytest.mark.costly
def test_nothing_that_is_said_is_false(block, journal, finished, compiled, request):
    kind = architecture(block[0])
    shapes, anew = kind.loop, isinstance(kind, kinds.Kind) and kind.facets > 0
    if anew or compiled != [shapes]:  # normals are compiled in: programs would pile up
        forget()
        compiled[:] = [shapes]
    outcomes = []
    for number in block:
        outcome = finished.get(number)
        if outcome is None:
            outcome = _tried(number, journal.seed)
            journal.add(outcome)
        outcomes.append(outcome)
        request.node.user_properties.append((PROPERTY, json.dumps(outcome.record())))
    failing = [outcome for outcome in outcomes if outcome.failures]
    if failing:
        pytest.fail(_said(failing, len(block)), pytrace=False)


def _tried(number: int, seed: int) -> Outcome:
    shapes = architecture(number)
    if isinstance(shapes, kinds.Kind):
        return of_kinds.tried(kinds.drawn(shapes, number, seed))
    return claims.tried(cases.drawn(number, seed))


def _said(failing: list[Outcome], count: int) -> str:
    parts = [f"{len(failing)} of {count} cases fail"]
    for outcome in failing[:MOST_PRINTED]:
        first = outcome.failures[0]
        parts.append("\n".join([f"{first.family}:", *first.script]))
    parts += [f"case {o.number}: {o.failures[0].family}" for o in failing[MOST_PRINTED:]]
    return "\n\n".join(parts)
