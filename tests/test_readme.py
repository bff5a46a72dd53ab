"""The README's code runs, and its commands are those that continuous integration runs."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_code_runs_from_top_to_bottom():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 2  # the ten lines, a training step
    code = "\n".join([*blocks, "print('skipped:', rj.failures(state))"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert re.search(r"^(PROVED|REFUTED|UNKNOWN)$", done.stdout, re.MULTILINE)
    assert "skipped: 0" in done.stdout


def test_continuous_integration_finds_the_test_command():
    after = (ROOT / "README.md").read_text().split("<!-- test command -->\n```sh\n")[1]
    assert "pytest" in after.split("\n")[0]
    assert after.split("\n")[1] == "```"
