"""No malformed file is read as another function, or ends in an error that is not its own."""

import pytest

from tests.loops.malformed import judged


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.long)])
def test_malformed_files_are_refused_or_read_as_what_they_hold(count, tmp_path, monkeypatch):
    fates, wrong = judged(tmp_path, count, monkeypatch)
    print(dict(fates))  # noqa: T201  (a study's figures)
    assert not wrong
    assert sum(fates.values()) >= count
    assert fates["onnx", "refused"] > 0.2 * count * 2 / 5
