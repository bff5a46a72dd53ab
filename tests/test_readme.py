"""The README's code runs, and its commands are those that continuous integration runs."""

import re
import subprocess
import sys
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_code_runs_from_top_to_bottom():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert re.search(r"^(PROVED|REFUTED|UNKNOWN)$", done.stdout, re.MULTILINE)


def test_continuous_integration_finds_the_test_command():
    after = README.split("<!-- test command -->\n```sh\n")[1]
    assert "pytest" in after.split("\n")[0]
    assert after.split("\n")[1] == "```"


def test_it_is_short():
    assert len(README.split()) < 1000
