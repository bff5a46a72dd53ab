"""Which cases a run takes, and from where all is drawn, as a plugin of pytest.

`python -m pytest` takes one case of each claim, of laws the basic ones: what somebody needs to
trust an installation, in minutes. With a path, or `--every-case`, all cases are taken; with
`--other-cases`, of those of the library that it leaves out, `OTHERS` of each claim; with
`--experiments` those about experiments, notebooks and site.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

ELSEWHERE = (
    "tests/experiments",
    "tests/test_notebooks.py",
    "tests/test_docs.py",
    "tests/solvers/test_diffcp.py",
)
"""Claims about experiments, notebooks and site, and comparisons with a library of `[dev]`."""

OTHERS = 1
"""So many other cases of a claim are taken at most, all over the range of its cases."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Whether all cases are taken."""
    parser.addoption(
        "--every-case",
        action="store_true",
        help="all cases of each claim, as with a path; else one of each about the library",
    )
    parser.addoption(
        "--other-cases",
        action="store_true",
        help=f"{OTHERS} more of each claim about the library, of what is not taken by default",
    )
    parser.addoption(
        "--experiments",
        action="store_true",
        help=f"all cases about experiments, notebooks and site: {' '.join(ELSEWHERE)}",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Draw all that is random from the seed of the session, before tests are imported."""
    config.addinivalue_line("markers", "costly: a claim that only `--every-case` or a path runs")
    config.addinivalue_line("markers", "basic: a case that is taken wherever one of its claim is")
    draw_from(config.getoption("seed"))
    if config.getoption("experiments"):
        config.args[:] = ELSEWHERE
        config.args_source = pytest.Config.ArgsSource.ARGS


def draw_from(seed: int) -> None:
    """Draw all that is random in this process from a seed, before what draws is imported.

    Args:
        seed: the seed; 0 leaves all as it is.
    """
    if not seed:
        return
    for module, name in (
        (np.random, "default_rng"),
        (jax.random, "key"),
        (jax.random, "PRNGKey"),
    ):
        setattr(module, name, _shifted(getattr(module, name), seed))


def _shifted(draws: Callable[..., Any], seed: int) -> Callable[..., Any]:
    """A source of random numbers, with one more seed mixed into those that are given to it."""

    def shifted(own: Any = None, *args: Any, **kwargs: Any) -> Any:
        if isinstance(own, int | np.integer | list | tuple) and not isinstance(own, bool):
            mixed = np.random.SeedSequence([*np.ravel(own).tolist(), seed])
            own = int(mixed.generate_state(1, np.uint32)[0] >> 1)
        return draws(own, *args, **kwargs)

    return shifted


def _everything(config: pytest.Config) -> bool:
    """Whether all cases are asked for."""
    bare = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    return not bare or config.getoption("every_case") or bool(config.getoption("keyword"))


def _is_elsewhere(path: Path, config: pytest.Config) -> bool:
    """Whether a file or a folder is of claims that are not about the library alone."""
    place = f"{path.relative_to(config.rootpath).as_posix()}/"
    return place.startswith(tuple(f"{each}/" for each in ELSEWHERE))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave unread, in a bare run, the files of claims that are not about the library."""
    if _everything(config):
        return None
    return True if _is_elsewhere(collection_path, config) else None


def _taken(cases: list[pytest.Item]) -> list[pytest.Item]:
    """Of a claim's cases the basic ones, or the one in the middle."""
    basic = [item for item in cases if item.get_closest_marker("basic")]
    return basic or cases[len(cases) // 2 :][:1]


def _spread(cases: list[pytest.Item]) -> list[pytest.Item]:
    """`OTHERS` of these at most, as far apart as they can be."""
    count = min(len(cases), OTHERS)
    return [cases[(2 * k + 1) * len(cases) // (2 * count)] for k in range(count)]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave one case of each claim, the middle one, or basic ones, unless all are asked for."""
    if _everything(config):
        return
    every, others = defaultdict(list), config.getoption("other_cases")
    for item in items:
        every[item.nodeid.partition("[")[0]].append(item)
    chosen = set[int]()
    for cases in every.values():
        first = _taken([item for item in cases if not item.get_closest_marker("costly")])
        if others:
            known = set(map(id, first))
            first = _spread([item for item in cases if id(item) not in known])
        chosen |= set(map(id, first))
    left = [item for item in items if id(item) not in chosen]
    items[:] = [item for item in items if id(item) in chosen]
    config.hook.pytest_deselected(items=left)
