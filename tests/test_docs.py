"""The code of the how-tos runs, and the reference holds every public name."""

import re
from pathlib import Path

import matplotlib
import pytest

import reachjax as rj
from docs.tools.rooms import picture

DOCS = Path(__file__).parent.parent / "docs"
QUICKSTART = DOCS / "how-to" / "quickstart.md"
OTHERS = sorted(set((DOCS / "how-to").glob("*.md")) - {QUICKSTART})


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


def test_a_public_name_stands_on_one_page_of_the_reference():
    pages = "".join(page.read_text() for page in sorted((DOCS / "reference").glob("*.md")))
    assert sorted(re.findall(r"^::: reachjax\.(\w+)$", pages, re.MULTILINE)) == sorted(rj.__all__)


def test_the_picture_of_the_rooms_is_the_one_that_is_drawn():
    assert (DOCS / "reference" / "rooms.svg").read_text() == picture()
