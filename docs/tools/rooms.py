"""The picture of the package's rooms, written to `docs/reference/rooms.svg` by this script."""

from __future__ import annotations

from pathlib import Path

ROOMS = (
    ("numerics", "checks, pytrees, rounding, the seam to the host"),
    ("sets", "boxes, polytopes, ellipsoids, templates, hulls, pictures"),
    ("loops", "units, networks, plants, the closed loop: it simulates itself"),
    ("programs", "rows, bounds, facts, relaxations, windows, the one formula"),
    ("proofs", "the recheck, certificates"),
    ("solvers", "Clarabel, others by cvxpy, the interior-point method, cuts"),
    ("methods", "affine forms, recursion, branch and cut, cells, witnesses"),
    ("tubes", "reach, partitions, files, sizes, tables"),
    ("verdicts", "specifications, counterexamples, winning sets, invariance"),
    ("training", "penalties, schedule, failures"),
)
TRUSTED = 5
"""So many rooms, from the ground up, are what a proof rests on."""

WIDTH, LEFT, ROOM, HEIGHT, GAP = 760, 40, 560, 44, 10
INK, GROUND, UPPER = "#37474f", "#c5cae9", "#eceff1"


def picture() -> str:
    """The rooms as storeys, the first one at the ground."""
    top, parts = 10, []
    for storey, (name, what) in enumerate(reversed(ROOMS)):
        y = top + storey * (HEIGHT + GAP)
        trusted = len(ROOMS) - storey <= TRUSTED
        parts += [
            f'<rect x="{LEFT}" y="{y}" width="{ROOM}" height="{HEIGHT}" rx="6" '
            f'fill="{GROUND if trusted else UPPER}" stroke="{INK}"/>',
            f'<text x="{LEFT + 16}" y="{y + 28}" font-weight="bold">{name}</text>',
            f'<text x="{LEFT + 118}" y="{y + 28}" font-size="14">{what}</text>',
        ]
    rise = HEIGHT + GAP
    bottom, split = top + len(ROOMS) * rise - GAP, top + (len(ROOMS) - TRUSTED) * rise
    parts += [
        f'<path d="M{LEFT - 18} {top + 6} V{bottom - 6}" stroke="{INK}" marker-end="url(#tip)"/>',
        f'<text transform="translate({LEFT - 24} {(top + bottom) / 2}) rotate(-90)" '
        'font-size="13" text-anchor="middle">imports</text>',
        *_brace(top, split - GAP, "proposes, uses,", "draws, trains"),
        *_brace(split, bottom, "trusted:", "imports no solver"),
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {bottom + 10}" '
        f'font-family="sans-serif" font-size="16" fill="{INK}">\n'
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" '
        f'markerHeight="8" orient="auto"><path d="M0 0 L8 4 L0 8 Z" fill="{INK}"/>'
        "</marker></defs>\n"
        f'<rect width="{WIDTH}" height="{bottom + 10}" fill="white"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _brace(top: float, bottom: float, *lines: str) -> list[str]:
    """A bracket to the right of some rooms, and what they have in common."""
    x, middle = LEFT + ROOM + 10, (top + bottom) / 2
    path = f'<path d="M{x} {top} h8 V{bottom} h-8" fill="none" stroke="{INK}"/>'
    return [path] + [
        f'<text x="{x + 16}" y="{middle + 18 * i}" font-size="14">{line}</text>'
        for i, line in enumerate(lines)
    ]


if __name__ == "__main__":
    (Path(__file__).parent.parent / "reference" / "rooms.svg").write_text(picture())
