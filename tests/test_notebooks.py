"""Every notebook runs from top to bottom."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
LONG = {"training"}  # what it shows, `experiments` do and test


def marks(path):
    return [pytest.mark.long] if path.stem in LONG else []


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=marks(path)) for path in NOTEBOOKS]
)
def test_a_notebook_runs(path):
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": path.parent}}).execute()
    printed = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    assert any(out.output_type == "display_data" for out in printed)  # it shows a figure


def test_there_are_notebooks():
    assert NOTEBOOKS
