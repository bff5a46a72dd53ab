"""The code of the how-tos runs, and the reference holds every public name."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import pytest

import reachjax as rj
from docs.tools import campaign
from docs.tools.rooms import picture
from tests.campaign.outcomes import Failure, Outcome
from tests.campaign.tables import report

DOCS = Path(__file__).parent.parent / "docs"
QUICKSTART = DOCS / "how-to" / "quickstart.md"
OTHERS = sorted(set((DOCS / "how-to").glob("*.md")) - {QUICKSTART})
PACKAGE = Path(rj.__file__).parent
POINTING = re.compile(
    r"(As|It|None|Of|That|They|Those)\b"
    r"|(All of (it|them|these|those)|The same|These|This)"
    r"(?=\W*$|[.,;]| (about|as|at|by|for|from|in|of|on|over|to|up|with|without)\b)"
)


def blocks(path: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE)


def run(path: Path, names: dict) -> dict:
    for code in blocks(path):
        exec(compile(code, path.name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def begun() -> dict:
    matplotlib.use("agg")
    return run(QUICKSTART, {})


def test_the_quickstart_is_that_of_the_readme(begun):
    assert blocks(QUICKSTART)[0] == blocks(DOCS.parent / "README.md")[0]
    assert begun["tube"].horizon == 3


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_a_how_to_runs(path, begun, monkeypatch):
    monkeypatch.setattr("jax.config.update", lambda *_: None)  # the tests have their own cache
    run(path, dict(begun))


def test_a_training_loop_of_ones_own_is_short():
    (code,) = (
        each for each in blocks(DOCS / "how-to" / "training.md") if "PenaltySchedule" in each
    )
    assert len(code.splitlines()) <= 25


def test_a_public_name_stands_on_one_page_of_the_reference():
    pages = "".join(page.read_text() for page in sorted((DOCS / "reference").glob("*.md")))
    assert sorted(re.findall(r"^::: reachjax\.(\w+)$", pages, re.MULTILINE)) == sorted(rj.__all__)


@pytest.mark.parametrize(
    ("word", "page"),
    {
        "nonlinear": "nonlinear",
        "discontinuous": "nonlinear",
        "argmax": "discrete",
        "quantised": "discrete",
        "float32": "elsewhere",
        "gymnasium": "elsewhere",
        "obstacles": "requirements",
        "forward mode": "training",
        "logging": "slow",
    }.items(),
)
def test_a_word_that_is_searched_for_brings_its_page(word, page):
    assert re.search(rf"\b{word}\b", (DOCS / "how-to" / f"{page}.md").read_text(), re.IGNORECASE)


def test_the_first_page_leads_to_every_kind_of_loop():
    told = (DOCS / "index.md").read_text()
    for page in ("nonlinear", "elsewhere", "disturbances", "requirements"):
        assert f"(how-to/{page}.md)" in told


def test_the_picture_of_the_rooms_is_the_one_that_is_drawn():
    assert (DOCS / "reference" / "rooms.svg").read_text() == picture()


def test_the_page_of_the_campaign_takes_the_tables_of_a_report():
    outcome = Outcome(3, {"set": "Box, flat", "fault": "None"})
    outcome.statuses["SOLVED"] += 4
    outcome.failures.append(Failure("a state outside", "at t = 1", ["print(1)"]))
    page = campaign.filled(campaign.PAGE.read_text(), report([outcome], 0))
    assert "1 cases of seed 0 gave 0 tubes" in page
    assert "### Tried: set\n\n| set | cases |" in page
    assert "\n| Box, flat | 1 | 0 | 0 | 1 |\n" in page
    assert "\n| SOLVED | 4 |\n" in page
    assert "\n| a state outside | 1 | 3 |\n" in page  # said, but without its reproduction
    assert "print(1)" not in page
    again = campaign.filled(page, report([Outcome(5, {"set": "Ellipsoid, thin"})], 0))
    assert "Box, flat" not in again
    assert again.startswith(page.split(campaign.BEGIN)[0])


def docstrings(tree: ast.Module) -> Iterator[str]:
    """The docstrings of a module, those of its constants too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield from filter(None, [ast.get_docstring(node)])
            for before, after in zip(node.body, node.body[1:], strict=False):
                named = isinstance(before, ast.Assign | ast.AnnAssign)
                if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    yield str(after.value.value)


@pytest.mark.parametrize(
    "room", sorted({path.parent for path in PACKAGE.rglob("*.py")}), ids=lambda room: room.name
)
def test_a_docstring_names_its_subject(room):
    said = [text for path in room.glob("*.py") for text in docstrings(ast.parse(path.read_text()))]
    assert [text for text in said if POINTING.match(text) or len(text.split()) < 3] == []
