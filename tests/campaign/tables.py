"""What a campaign tried and what came of it, as tables in markdown."""

from collections import Counter, defaultdict
from collections.abc import Iterable

from tests.campaign.outcomes import Outcome

LONGEST = 110
SHOWN = 2
"""So many reproductions of each family of failures are printed."""


def table(head: Iterable[str], rows: Iterable[Iterable]) -> str:
    """A table in markdown.

    Example:
        >>> print(table(["status", "programs"], [["SOLVED", 3]]))
        | status | programs |
        | --- | ---: |
        | SOLVED | 3 |
    """
    head = list(head)
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(value) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value).replace("|", "/")[:LONGEST]


def counted(outcomes: list[Outcome], name: str, head: str) -> str:
    """The sum of one of the counts, the largest first."""
    total = sum((getattr(outcome, name) for outcome in outcomes), Counter())
    return table([head, "count"], total.most_common())


def tried(outcomes: list[Outcome]) -> str:
    """How many cases there were of each kind of thing, and what became of them."""
    groups = defaultdict(list)
    for outcome in outcomes:
        for what, value in outcome.tried.items():
            groups[what, value].append(outcome)
    rows = [
        [
            f"{what}: {value}",
            len(some),
            sum(one.counts["tubes"] for one in some),
            sum(bool(one.errors) for one in some),
            sum(bool(one.failures) for one in some),
        ]
        for (what, value), some in sorted(groups.items())
    ]
    return table(["tried", "cases", "tubes", "with clear errors", "failing"], rows)


def families(outcomes: list[Outcome]) -> dict[str, list[Outcome]]:
    """The failing cases of each family, the largest family first."""
    found = defaultdict(list)
    for outcome in outcomes:
        for family in {failure.family for failure in outcome.failures}:
            found[family].append(outcome)
    return dict(sorted(found.items(), key=lambda item: -len(item[1])))


def summary(outcomes: list[Outcome], seed: int) -> str:
    """The tables that are printed at the end."""
    total = sum((outcome.counts for outcome in outcomes), Counter())
    failing = sum(bool(outcome.failures) for outcome in outcomes)
    seconds = sum(outcome.seconds for outcome in outcomes)
    head = (
        f"{len(outcomes):,} cases of seed {seed} gave {total['tubes']:,} tubes in "
        f"{seconds:,.0f} s of the processor; {total['states']:,} states were compared with sets, "
        f"{total['states in fractions']:,} of them in fractions; {failing:,} cases failed."
    )
    parts = [
        head,
        counted(outcomes, "statuses", "status of a program"),
        counted(outcomes, "verdicts", "requirement: verdict"),
        counted(outcomes, "counts", "what was checked"),
        counted(outcomes, "errors", "clear errors"),
    ]
    if failing:
        rows = [
            [family, len(some), ", ".join(str(one.number) for one in some[:6])]
            for family, some in families(outcomes).items()
        ]
        parts.append(table(["family of failures", "cases", "the first"], rows))
    return "\n\n".join(parts)


def report(outcomes: list[Outcome], seed: int) -> str:
    """The whole report: what is printed, what was tried, and reproductions."""
    parts = ["# A campaign of random loops", summary(outcomes, seed), tried(outcomes)]
    for family, some in families(outcomes).items():
        parts.append(f"## {family}")
        for outcome in sorted(some, key=lambda one: sum(map(len, _script(one, family))))[:SHOWN]:
            parts.append("```python\n" + "\n".join(_script(outcome, family)) + "\n```")
    return "\n\n".join(parts) + "\n"


def _script(outcome: Outcome, family: str) -> list[str]:
    return next(failure.script for failure in outcome.failures if failure.family == family)
