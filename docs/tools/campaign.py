"""The tables of a campaign's report, on the page of the site that says what they mean.

python docs/tools/campaign.py             # those of results/campaign-0.md
python docs/tools/campaign.py report.md   # those of another one
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PAGE = ROOT / "docs" / "measured" / "campaign.md"
REPORT = ROOT / "results" / "campaign-0.md"
BEGIN, END = "<!-- tables: docs/tools/campaign.py -->", "<!-- end of tables -->"


def tables(report: str) -> str:
    """The first paragraph and the tables of a report, each with a heading.

    What was tried becomes one table for each kind of thing. Reproductions of failures stay out:
    that there were some is said by the first paragraph, and which by a table.
    """
    _, said, *rest = report.split("\n## ")[0].strip().split("\n\n")
    parts = [said]
    for lines in (table.splitlines() for table in rest):
        name, columns = _first(lines[0])
        if name == "tried":
            parts += _by_kind(columns, lines[1], lines[2:])
        elif len(lines) > 2:
            parts += [f"### {name.capitalize()}", "\n".join(lines)]
    return "\n\n".join(parts)


def _by_kind(columns: str, rule: str, rows: list[str]) -> list[str]:
    """The rows `| kind: value | ...` as one table for each kind, under headings."""
    kinds: dict[str, list[str]] = {}
    for cell, numbers in map(_first, rows):
        kind, value = cell.split(": ", 1)
        kinds.setdefault(kind, []).append(f"| {value} | {numbers}")
    return [
        text
        for kind, lines in kinds.items()
        for text in (f"### Tried: {kind}", "\n".join([f"| {kind} | {columns}", rule, *lines]))
    ]


def _first(row: str) -> tuple[str, str]:
    """The first cell of a row, and the others."""
    cell, others = row.removeprefix("| ").split(" | ", 1)
    return cell, others


def filled(page: str, report: str) -> str:
    """The page with the tables of a report in place of those that it has."""
    before, _, after = re.split(f"({re.escape(BEGIN)}.*{re.escape(END)})", page, flags=re.DOTALL)
    return f"{before}{BEGIN}\n\n{tables(report)}\n\n{END}{after}"


if __name__ == "__main__":
    report = Path(sys.argv[1]) if len(sys.argv) > 1 else REPORT
    PAGE.write_text(filled(PAGE.read_text(), report.read_text()))
