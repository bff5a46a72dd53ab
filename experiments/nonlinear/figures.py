"""Tables and figures of nonlinear loops."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.nonlinear.analysis import METHODS, Result
from experiments.nonlinear.problems import Problem
from experiments.nonlinear.training import Trained

NOTE = """\
volume: certified over simulated box volume at the last step
width: the largest certified over simulated width at any step
s: seconds of a second call
outside: how far a sampled state is beyond a set, in parts of a width"""


def table(results: Mapping[str, Result]) -> Table:
    """A loop a row."""
    rows = []
    for name, result in results.items():
        cells = [name, report.coloured(result.verdict.status.name)]
        for method in METHODS:
            ratios = result.volumes[method], result.widths[method]
            cells += [*(f"{ratio:.3f}" for ratio in ratios), f"{result.seconds[method]:.2f}"]
        rows.append([*cells, f"{max(result.beyond.values()):+.0e}"])
    columns = report.grouped(METHODS, ("volume", "width", "s"))
    headings = (*columns, "\noutside")
    shown = report.table("nonlinear loops", ("\nloop", "\nverdict"), headings, rows)
    shown.caption = NOTE
    shown.caption_justify = "left"
    return shown


def draw(problem: Problem, result: Result, path: Path) -> None:
    """Certified sets over samples, what is avoided, and the goal."""
    figure, ((ax,),) = report.panels(1, 1, (6.4, 4.8))
    _draw_loop(ax, problem, result)
    ax.set(title=f"{problem.name}: {result.verdict.status.value}")
    report.legend_below(figure)
    report.save(figure, path)


def draw_training(
    problem: Problem, before: Result, after: Result, trained: Trained, path: Path
) -> None:
    """The loop before and after, and what its sets lacked in between."""
    figure, (axes,) = report.panels(1, 3, (13.0, 4.4))
    for ax, result, word in zip(axes, (before, after), ("before", "after"), strict=False):
        _draw_loop(ax, problem, result)
        ax.set(title=f"{word}: {result.verdict.status.value}")
    seen = [(*ax.get_xlim(), *ax.get_ylim()) for ax in axes[:2]]
    (left, right), (bottom, top) = (
        (min(each[k] for each in seen), max(each[k + 1] for each in seen)) for k in (0, 2)
    )
    for ax in axes[:2]:
        ax.set(xlim=(left, right), ylim=(bottom, top))
    axes[2].semilogy(np.maximum(trained.shortfalls, 1e-6), color="tab:blue")
    axes[2].set(title="training", xlabel="step", ylabel="shortfall of the certified sets")
    axes[2].grid(alpha=0.3)
    report.legend_below(figure)
    report.save(figure, path)


def _draw_loop(ax, problem: Problem, result: Result) -> None:
    rj.plot_tube(result.tube, ax, coordinates=problem.plane)
    draw_sets(ax, problem, result.verdict.counterexample)


def draw_sets(ax, problem: Problem, example: rj.Counterexample | None) -> None:
    """What is avoided, the goal, and a trajectory that breaks what is required."""
    i, j = problem.plane
    ax.margins(0.08)
    ax.autoscale_view()
    limits = problem.view or (ax.get_xlim(), ax.get_ylim())
    for number, region in enumerate(problem.avoid):
        style = {"facecolor": "tab:red", "edgecolor": "none", "alpha": 0.5}
        _fill(ax, region, problem, limits, label=None if number else "avoided", **style)
    if problem.goal is not None:
        style = {"facecolor": "tab:green", "edgecolor": "none", "alpha": 0.25}
        _fill(ax, problem.goal, problem, limits, label="goal", **style)
    if example is not None:
        path = example.states[:, [i, j]].T
        ax.plot(*path, ".-", color="tab:orange", linewidth=1, label="counterexample")
    ax.set(xlabel=problem.axes[0], ylabel=problem.axes[1], xlim=limits[0], ylim=limits[1])


def _fill(ax, region: rj.PolyhedralSet, problem: Problem, limits, **style) -> None:
    """What is seen of a set that may be unbounded, in the plane that is drawn."""
    A, b = (np.asarray(part) for part in region.facets)
    view = np.zeros((4, A.shape[1]))
    view[[0, 1], problem.plane[0]] = 1, -1
    view[[2, 3], problem.plane[1]] = 1, -1
    (left, right), (bottom, top) = limits
    other = np.ones(A.shape[1], dtype=bool)
    other[list(problem.plane)] = False
    sides = np.eye(A.shape[1])[other]
    rows = np.vstack([A, view, sides, -sides])
    ends = np.concatenate([b, [right, -left, top, -bottom], np.ones(2 * len(sides))])
    rj.plot_set(rj.Polytope(rows, ends), ax, coordinates=problem.plane, **style)
