"""Tables and figures of verified training: outcomes, way by way."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.table import Table

import reachjax as rj
from experiments import report
from experiments.double_integrator.problem import GOAL_BOX, HORIZON, STATE_BOX
from experiments.verified_training.fine_tuning import Outcome, certified_tube
from experiments.verified_training.step_cost import StepCost

Outcomes = dict[str, list[Outcome]]
WAYS = {"plain": "tab:gray", "specification": "tab:blue", "volume": "tab:orange"}
SIZES: dict[str, Callable[[Outcome], np.ndarray]] = {
    "certified": lambda outcome: outcome.areas,
    "simulated hull": lambda outcome: outcome.hulls,
}


def tables(outcomes: Outcomes, goals: tuple[float, ...], cost: StepCost) -> list[Table]:
    """Verdicts, seeds, areas, goals and costs."""
    return [
        verdict_table(outcomes),
        seed_table(outcomes),
        area_table(outcomes),
        goal_table(outcomes, goals),
        cost_table(outcomes, cost),
    ]


def verdict_table(outcomes: Outcomes) -> Table:
    """How many controllers are proved, and at what imitation error."""
    rows, plain = [], [each.validation_error for each in next(iter(outcomes.values()))]
    for way, group in outcomes.items():
        errors = np.array([each.validation_error for each in group])
        counts = [sum(each.verdict == name for each in group) for name in report.COLOURS]
        spread = [f"{value:.4f}" for value in (errors.min(), np.median(errors), errors.max())]
        ratios = errors / plain
        times = f"{ratios.min():.2f}-{ratios.max():.2f}"
        skipped = sum(each.skipped for each in group)
        rows.append([way, " / ".join(map(str, counts)), *spread, times, skipped])
    initials = " / ".join(name[0] for name in report.COLOURS)
    headings = (initials, "least", "median", "largest", "/ plain", "skipped")
    title = "verdicts (proved / refuted / unknown), and errors on held-out samples"
    return report.table(title, ("trained",), headings, rows)


def seed_table(outcomes: Outcomes) -> Table:
    """Each network: error, and certified margin of the constraint in the colour of the verdict."""
    rows = []
    for k, row in enumerate(zip(*outcomes.values(), strict=True)):
        errors = [f"{each.validation_error:.4f}" for each in row]
        margins = [f"{each.safe_margin:+.4f} {each.verdict[0]}" for each in row]
        margins = [report.coloured(each.verdict, m) for each, m in zip(row, margins, strict=True)]
        rows.append([k, *errors, *margins])
    title = "each network: imitation error, and certified margin of the constraint"
    headings = report.grouped(("error", "margin"), list(outcomes))
    shown = report.table(title, (), ["\nseed", *headings], rows)
    shown.caption = "P: proved, R: refuted, U: unknown"
    return shown


def area_table(outcomes: Outcomes) -> Table:
    """Areas at each step: certified and simulated."""
    columns = []
    for way, group in outcomes.items():
        for of in SIZES.values():
            plain, values = (np.array([*map(of, each)]) for each in (outcomes["plain"], group))
            ratios = np.median(values / plain, axis=0)
            first = [f"{value:.1e}" for value in np.median(plain, axis=0)]
            columns.append(first if way == "plain" else [f"x {ratio:.2f}" for ratio in ratios])
    title = "areas: of plain training, and ratios to it (medians over networks)"
    headings = ["\nt", *report.grouped(outcomes, ("certified", "hull"))]
    return report.table(title, (), headings, zip(range(1, HORIZON + 1), *columns, strict=True))


def goal_table(outcomes: Outcomes, goals: tuple[float, ...]) -> Table:
    """The share of networks that verify for goals of shrinking size."""
    rows = []
    for way, group in outcomes.items():
        shares = np.array([outcome.goals for outcome in group]).sum(axis=0)
        rows.append([way, *(f"{share}/{len(group)}" for share in shares)])
    title = "networks proved to reach the goal box of this half-width, and to be safe"
    return report.table(title, ("trained",), [f"{half:g}" for half in goals], rows)


def cost_table(outcomes: Outcomes, cost: StepCost) -> Table:
    """Seconds of training steps."""
    rows = [
        (
            f"{way} penalty, {HORIZON} steps, side by side",
            f"{np.median([each.step_seconds for each in group]):.3f}",
        )
        for way, group in outcomes.items()
        if way != "plain"
    ] + [
        ("log-volume of 5 steps, forward", f"{cost.forward:.3f}"),
        ("  of it in cvxpy and the solver", f"{cost.solver:.3f}"),
        ("forward and backward", f"{cost.both:.3f}"),
        ("first call, compilation included", f"{cost.first:.1f}"),
        ("backward / forward", f"{cost.backward:+.2f}"),
    ]
    return report.table("seconds of a training step", ("what",), ("seconds",), rows)


def draw_tubes(outcomes: Outcomes, path: Path) -> None:
    """Certified sets and simulations of one network, trained in each way."""
    chosen = _most_telling(outcomes)
    figure, axes = report.panels(1, len(outcomes), (12, 4.6), sharex=True, sharey=True)
    for ax, (way, group) in zip(axes[0], outcomes.items(), strict=True):
        outcome = group[chosen]
        tube = certified_tube(rj.MLP.from_layers(outcome.layers))
        report.draw_tube(ax, tube, GOAL_BOX)
        ax.axhline(STATE_BOX[0, 1], color="black", linewidth=1)
        ax.set_title(f"{way}: {outcome.verdict}, error {outcome.validation_error:.4f}")
        _zoom(ax.inset_axes((0.34, 0.62, 0.44, 0.34)), tube, ax)
        ax.autoscale_view()
        ax.label_outer()
    figure.suptitle(
        f"network {chosen}: simulated states (blue), certified sets (red), goal (green), "
        "$x_2 \\geq -1$ (line; the inset is around it)"
    )
    report.save(figure, path)


def _zoom(inset, tube: rj.ReachTube, ax) -> None:
    """The second set where it comes close to the constraint."""
    rj.plot_tube(tube, inset, samples=10_000)
    box = tube.sets[2].bounding_box()
    inset.set_xlim(float(box.lower[0]) - 0.05, float(box.upper[0]) + 0.05)
    inset.set_ylim(-1.04, -0.94)
    inset.axhline(STATE_BOX[0, 1], color="black", linewidth=1)
    inset.set(xlabel="", ylabel="", xticks=[])
    inset.tick_params(labelsize=7)
    ax.indicate_inset_zoom(inset, edgecolor="gray")


def draw_seeds(outcomes: Outcomes, path: Path) -> None:
    """Each network's error against its margin, areas step by step, and the imitation loss."""
    figure, ((left, middle, right),) = report.panels(1, 3, (13, 4.2))
    points = {
        way: np.array([(each.validation_error, each.safe_margin) for each in group])
        for way, group in outcomes.items()
    }
    for before, after in zip(points["plain"], points["specification"], strict=True):
        left.plot(*np.array([before, after]).T, color="lightgray", linewidth=1, zorder=1)
    for way, each in points.items():
        left.scatter(*each.T, color=WAYS[way], label=way, s=22, zorder=2)
    left.axhline(0, color="black", linewidth=1)
    left.set(xlabel="imitation error", ylabel="certified margin of $x_2 \\geq -1$")
    left.legend(frameon=False)
    steps = np.arange(1, HORIZON + 1)
    for way, group in outcomes.items():
        for (name, of), style in zip(SIZES.items(), ("o-", "s:"), strict=True):
            median = np.median([*map(of, group)], axis=0)
            label = f"{way}, {name}"
            middle.semilogy(steps, median, style, color=WAYS[way], label=label, markersize=4)
    middle.set(xlabel="t", ylabel="area, median over networks")
    middle.legend(frameon=False, fontsize=7)
    for way, group in outcomes.items():
        median = np.median([outcome.imitation for outcome in group], axis=0)
        right.semilogy(median, color=WAYS[way], linewidth=1, label=way)
    right.set(xlabel="training step", ylabel="imitation loss, median over networks")
    right.legend(frameon=False)
    report.save(figure, path)


def _most_telling(outcomes: Outcomes) -> int:
    """The network whose plain copy breaks the constraint most."""
    return int(np.argmin([outcome.safe_margin for outcome in outcomes["plain"]]))
