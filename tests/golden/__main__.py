"""Keep what the library says of drawn cases, or compare it with what was kept.

    python -m tests.golden write results/before.json
    python -m tests.golden compare results/before.json        # runs the cases again
    python -m tests.golden compare results/before.json results/after.json
    python -m tests.golden write --kept tests/golden/kept.json  # where a change is meant

What is compared is compared bit for bit: on one machine, and with the same versions of what the
library stands on.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table
from tqdm import tqdm

import conftest  # noqa: F401  (64-bit floats, quick compilation)
from tests.golden.cases import KEPT, every
from tests.golden.records import SECONDS, Record, differences, read, recorded, written
from tests.memory import forget


def run(pattern: str, kept: bool) -> dict[str, Record]:
    """The records of the cases whose names have a pattern in them; of those that are kept alone."""
    some = [replace(case, differentiated=False) for case in every() if case.name in KEPT]
    found, asked = {}, some if kept else every()
    for case in tqdm([case for case in asked if pattern in case.name], unit="case"):
        found[case.name] = recorded(case)
        forget()  # what is compiled is compiled in each case's own seconds
    return found


def compared(before: dict[str, Record], after: dict[str, Record]) -> int:
    """Print what is not the same; how many cases that are."""
    table, changed = Table("case", "what", "difference"), 0
    for name in before | after:
        pair = before.get(name, {}), after.get(name, {})
        found = differences(*pair)
        changed += bool(found)
        for what, difference in found.items():
            table.add_row(name, what, difference[:100])
    console = Console()
    if changed:
        console.print(table)
    seconds = [sum(each[SECONDS] for each in one.values()) for one in (before, after)]
    console.print(f"{changed} of {len(before | after)} cases are not the same")
    console.print(f"{seconds[0]:.0f} s of the processor before, {seconds[1]:.0f} s after")
    return changed


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0], prog="tests.golden")
    parser.add_argument("what", choices=["write", "compare"])
    parser.add_argument("file", type=Path, help="what was kept, or is to be")
    parser.add_argument(
        "other", type=Path, nargs="?", help="what to compare with; runs if not given"
    )
    parser.add_argument("--case", default="", help="only cases whose names have this in them")
    parser.add_argument(
        "--kept", action="store_true", help="only cases that are kept beside the tests"
    )
    given = parser.parse_args(arguments)
    if given.what == "write":
        written(given.file, run(given.case, given.kept))
        return 0
    before = {name: record for name, record in read(given.file).items() if given.case in name}
    after = run(given.case, given.kept) if given.other is None else read(given.other)
    return 1 if compared(before, after) else 0


if __name__ == "__main__":
    sys.exit(main())
