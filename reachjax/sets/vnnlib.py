"""Specifications in VNN-LIB: where states begin, and which ones must not be reached.

A file declares numbers `X_0 .. X_(n-1)` and `Y_0 .. Y_(m-1)` and asserts inequalities that are
linear in them, joined by `and` and `or`. It describes what would be a violation. Those of `X` are
the initial set; those of `Y` are a union of polytopes to be avoided. Sets are closed, whether an
inequality is strict or not: what is proved is proved of both. Decimals are computed with exactly:
inequalities are multiplied until their factors are whole numbers, and what bounds a linear form is
rounded outwards. Only factors of which that makes numbers beyond 2^53 are the nearest floats.

Source: VNN-LIB 1.0 (Tacchella, Demarchi, Guidotti, Pulina), as competitions use it.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from reachjax.numerics.archives import existing_file
from reachjax.numerics.checks import EXACT
from reachjax.sets.base import Box, PolyhedralSet
from reachjax.sets.polytope import Polytope

TOKEN = re.compile(r";[^\n]*|[()]|[^\s();]+")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
NAME = re.compile(r"([XY])_(\d+)", re.ASCII)

MOST = 10_000
"""So many polytopes may be what is left of nested disjunctions."""


class VnnLib(NamedTuple):
    """What a file in VNN-LIB describes.

    Attributes:
        X0: the initial set.
        avoid: polytopes, in none of which a state may be.
    """

    X0: PolyhedralSet
    avoid: tuple[PolyhedralSet, ...]


class _Half(NamedTuple):
    """An inequality `row . numbers <= offset`, of the numbers of one letter."""

    letter: str
    row: tuple[Fraction, ...]
    offset: Fraction


def read_vnnlib(path: str | os.PathLike[str]) -> VnnLib:
    """The initial set and the sets to avoid of a file in VNN-LIB.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of VNN-LIB, or has something else than linear inequalities, each of
            initial states or of others; the error says where.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> path = Path(tempfile.mkdtemp()) / "low.vnnlib"
        >>> _ = path.write_text('''
        ... (declare-const X_0 Real) (declare-const Y_0 Real)
        ... (assert (>= X_0 1.0)) (assert (<= X_0 2.0)) ; where it begins
        ... (assert (<= Y_0 -0.5))
        ... ''')
        >>> found = read_vnnlib(path)
        >>> found.X0.lower.tolist(), found.X0.upper.tolist(), found.avoid[0].b.tolist()
        ([1.0], [2.0], [-0.5])
    """
    path = existing_file("path", path)
    try:
        return _read(path.read_text(encoding="utf-8"))
    except (ValueError, OverflowError, RecursionError) as error:  # text that is none, too
        raise ValueError(f"{path} cannot be read: {error}") from error


def _read(text: str) -> VnnLib:
    counts, cases = {"X": 0, "Y": 0}, list[list[list[_Half]]]()
    commands = _parsed(text)
    for command in commands:
        match command:
            case ["declare-const", str(name), "Real"] | ["declare-fun", str(name), [], "Real"]:
                letter, number = _letter(name)
                if number != counts[letter]:
                    raise ValueError(f"{name} is not declared in order")
                counts[letter] += 1
            case ["assert", _] | ["set-logic" | "set-info" | "check-sat", *_]:
                pass
            case _:
                raise ValueError(f"{_told(command)} is not known")
    for command in commands:
        if command[0] == "assert":
            cases.append(_cases(command[1], counts))
    every = [[half for part in case for half in part] for case in _products(cases)]
    if not every:
        raise ValueError("it has a disjunction of nothing, which never holds")
    initial, avoided = [], []
    for case in every:
        initial.append([half for half in case if half.letter == "X"])
        avoided.append([half for half in case if half.letter == "Y"])
    if any(set(each) != set(initial[0]) for each in initial):
        raise ValueError("it has several initial sets: give a file for each")
    if not counts["X"] or not all(avoided):
        raise ValueError("it says nothing of initial states, or nothing of what to avoid")
    return VnnLib(_set(initial[0]), tuple(_polytope(each) for each in avoided))


def _parsed(text: str) -> list[Any]:
    """Nested lists of words."""
    stack: list[list[Any]] = [[]]
    for token in TOKEN.findall(text):
        if token.startswith(";"):
            continue
        if token == "(":
            stack.append([])
        elif token == ")":
            if len(stack) < 2:
                raise ValueError("a bracket is closed that was not opened")
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(token)
    if len(stack) > 1:
        raise ValueError("it ends within brackets")
    if any(not isinstance(each, list) or not each for each in stack[0]):
        raise ValueError("it has words outside of brackets")
    return stack[0]


def _products(cases: Sequence[list[list[_Half]]]) -> list[tuple[list[_Half], ...]]:
    count = int(np.prod([float(len(each)) for each in cases]))
    if count > MOST:
        raise ValueError(f"it has {count} cases, more than {MOST}")
    return list(itertools.product(*cases))


def _cases(term: Any, counts: dict[str, int]) -> list[list[_Half]]:
    """The cases of a condition, each of which is a list of inequalities."""
    match term:
        case ["and", *parts]:
            found = [_cases(each, counts) for each in parts]
            return [[half for part in case for half in part] for case in _products(found)]
        case ["or", *parts]:
            return [case for each in parts for case in _cases(each, counts)]
        case ["<=" | "<", one, other]:
            return [[_half(one, other, counts)]]
        case [">=" | ">", one, other]:
            return [[_half(other, one, counts)]]
        case ["=", one, other]:
            return [[_half(one, other, counts), _half(other, one, counts)]]
    raise ValueError(f"{_told(term)} is no condition that is known")


def _half(one: Any, other: Any, counts: dict[str, int]) -> _Half:
    """The inequality by which a term is at most another one."""
    (row, constant), (less, least) = _linear(one, counts), _linear(other, counts)
    row, constant = (
        {k: row.get(k, Fraction(0)) - less.get(k, Fraction(0)) for k in row | less},
        least - constant,
    )
    letters = {letter for letter, _ in row}
    if len(letters) != 1:
        raise ValueError(f"{_told(['<=', one, other])} is not of initial states or of others alone")
    (letter,) = letters
    found = [row.get((letter, number), Fraction(0)) for number in range(counts[letter])]
    if not any(found):
        raise ValueError(f"{_told(['<=', one, other])} is of no number")
    return _Half(letter, tuple(found), constant)


def _linear(term: Any, counts: dict[str, int]) -> tuple[dict[tuple[str, int], Fraction], Fraction]:
    """Factors of numbers, and a constant."""
    if isinstance(term, str):
        if NUMBER.fullmatch(term):
            return {}, Fraction(term)
        letter, number = _letter(term)
        if number >= counts[letter]:
            raise ValueError(f"{term} is not declared")
        return {(letter, number): Fraction(1)}, Fraction(0)
    match term:
        case ["-", one]:
            row, constant = _linear(one, counts)
            return {k: -v for k, v in row.items()}, -constant
        case ["+" | "-" as sign, first, *rest] if rest:
            row, constant = _linear(first, counts)
            row = dict(row)
            for each in rest:
                more, added = _linear(each, counts)
                by = 1 if sign == "+" else -1
                constant += by * added
                for k, v in more.items():
                    row[k] = row.get(k, 0) + by * v
            return row, constant
        case ["*", one, other]:
            (row, factor), (less, by) = _linear(one, counts), _linear(other, counts)
            if row and less:
                raise ValueError(f"{_told(term)} is not linear")
            row, factor, by = (row, factor, by) if row else (less, by, factor)
            return {k: by * v for k, v in row.items()}, by * factor
    raise ValueError(f"{_told(term)} is no term that is known")


def _letter(name: str) -> tuple[str, int]:
    found = NAME.fullmatch(name)
    if not found:
        raise ValueError(f"{name!r:.40} is no number that is known: X_0, X_1, ..., Y_0, ...")
    return found[1], int(found[2])


def _set(halves: Sequence[_Half]) -> PolyhedralSet:
    """A box where all facets are along axes, and each side has one."""
    if not halves:
        raise ValueError("it says nothing of initial states")
    n = len(halves[0].row)
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    for half in halves:
        (k, *others) = (number for number, factor in enumerate(half.row) if factor)
        if others:
            return _polytope(halves)
        end = half.offset / half.row[k]
        if half.row[k] > 0:
            upper[k] = min(upper[k], _above(end))
        else:
            lower[k] = max(lower[k], -_above(-end))
    if np.isfinite([lower, upper]).all():
        return Box(lower, upper)
    return _polytope(halves)


def _polytope(halves: Sequence[_Half]) -> Polytope:
    whole = [_whole(half) for half in halves]
    rows = np.array([[float(factor) for factor in half.row] for half in whole])
    return Polytope(rows, [_above(half.offset) for half in whole])


def _whole(half: _Half) -> _Half:
    """The same inequality with whole factors, if floats hold these: then it is exactly that."""
    times = math.lcm(*(factor.denominator for factor in half.row))
    times = Fraction(times, math.gcd(*(int(factor * times) for factor in half.row)))
    row = tuple(factor * times for factor in half.row)
    if max(map(abs, row)) > EXACT:
        return half
    return half._replace(row=row, offset=half.offset * times)


def _above(number: Fraction) -> float:
    """The least float that is no smaller."""
    found = float(number)
    return found if Fraction(found) >= number else float(np.nextafter(found, np.inf))


def _told(term: Any) -> str:
    """A term as it stands in a file."""
    text = term if isinstance(term, str) else f"({' '.join(map(_told, term))})"
    return text if len(text) < 60 else f"{text[:57]}..."
