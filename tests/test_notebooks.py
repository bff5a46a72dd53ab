"""Every notebook runs from top to bottom."""

import pytest

from docs.tools.tutorials import NOTEBOOKS, executed


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path):
    printed = [out for cell in executed(path).cells for out in cell.get("outputs", [])]
    assert any(out.output_type == "display_data" for out in printed)  # it shows a figure


def test_there_are_notebooks():
    assert NOTEBOOKS
