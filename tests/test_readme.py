"""The README's code runs, and its commands are those that continuous integration runs."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_ten_lines_run():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert re.search(r"^(PROVED|REFUTED|UNKNOWN)$", done.stdout, re.MULTILINE)


def test_continuous_integration_finds_the_test_command():
    after = (ROOT / "README.md").read_text().split("<!-- test command -->\n```sh\n")[1]
    assert "pytest" in after.split("\n")[0]
    assert after.split("\n")[1] == "```"
