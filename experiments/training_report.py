"""What the experiment on verified training reports: tables, figures, results as JSON."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from rich.table import Table

import reachjax as rj
from experiments.command import blank_table
from experiments.double_integrator import GOAL_BOX, STATE_BOX
from experiments.fine_tuning import HORIZON, Outcome, certified_tube
from experiments.report import COLOURS
from experiments.step_cost import StepCost

Outcomes = dict[str, list[Outcome]]
WAYS = {"plain": "tab:gray", "specification": "tab:blue", "volume": "tab:orange"}


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
    table = blank_table("verdicts (proved / refuted / unknown), and errors on held-out samples")
    table.add_column("trained", no_wrap=True)
    initials = " / ".join(status[0] for status in COLOURS)
    for heading in (initials, "least", "median", "largest", "/ plain", "skipped"):
        table.add_column(heading, justify="right", no_wrap=True)
    plain = [outcome.validation_error for outcome in next(iter(outcomes.values()))]
    for way, group in outcomes.items():
        errors = [outcome.validation_error for outcome in group]
        counts = [sum(outcome.verdict == status for outcome in group) for status in COLOURS]
        spread = [f"{value:.4f}" for value in (min(errors), np.median(errors), max(errors))]
        ratios = np.array(errors) / plain
        skipped = sum(outcome.skipped for outcome in group)
        times = f"{ratios.min():.2f}-{ratios.max():.2f}"
        table.add_row(way, " / ".join(map(str, counts)), *spread, times, str(skipped))
    return table


def seed_table(outcomes: Outcomes) -> Table:
    """Each network: error, and certified margin of the constraint in the colour of the verdict."""
    table = blank_table("each network: imitation error, and certified margin of the constraint")
    table.add_column("\nseed", justify="right")
    for heading in ("error", "margin"):
        for k, way in enumerate(outcomes):
            table.add_column(f"{heading if k == 0 else ''}\n{way}", justify="right", no_wrap=True)
    for k, row in enumerate(zip(*outcomes.values(), strict=True)):
        errors = [f"{each.validation_error:.4f}" for each in row]
        margins = [
            f"[{COLOURS[each.verdict]}]{each.safe_margin:+.4f} {each.verdict[0]}[/]" for each in row
        ]
        table.add_row(str(k), *errors, *margins)
    table.caption = "P: proved, R: refuted, U: unknown"
    return table


def area_table(outcomes: Outcomes) -> Table:
    """Areas at each step: certified and simulated."""
    table = blank_table("areas: of plain training, and ratios to it (medians over networks)")
    table.add_column("\nt", justify="right")
    for way in outcomes:
        for k, column in enumerate(("certified", "hull")):
            table.add_column(f"{way if k == 0 else ''}\n{column}", justify="right", no_wrap=True)
    for t in range(HORIZON):
        cells = [str(t + 1)]
        for way, group in outcomes.items():
            for of in (_areas, _hulls):
                plain = np.array([of(outcome)[t] for outcome in outcomes["plain"]])
                values = np.array([of(outcome)[t] for outcome in group])
                ratio = f"x {np.median(values / plain):.2f}"
                cells.append(f"{np.median(plain):.1e}" if way == "plain" else ratio)
        table.add_row(*cells)
    return table


def goal_table(outcomes: Outcomes, goals: tuple[float, ...]) -> Table:
    """The share of networks that verify for goals of shrinking size."""
    table = blank_table("networks proved to reach the goal box of this half-width, and to be safe")
    table.add_column("trained", no_wrap=True)
    for half in goals:
        table.add_column(f"{half:g}", justify="right")
    for way, group in outcomes.items():
        shares = np.array([outcome.goals for outcome in group]).sum(axis=0)
        table.add_row(way, *(f"{int(share)}/{len(group)}" for share in shares))
    return table


def cost_table(outcomes: Outcomes, cost: StepCost) -> Table:
    """Seconds of training steps."""
    table = blank_table("seconds of a training step")
    table.add_column("what", no_wrap=True)
    table.add_column("seconds", justify="right")
    for way, group in outcomes.items():
        if way != "plain":
            median = np.median([outcome.step_seconds for outcome in group])
            table.add_row(f"{way} penalty, {HORIZON} steps, side by side", f"{median:.3f}")
    table.add_row("log-volume of 5 steps, forward", f"{cost.forward:.3f}")
    table.add_row("  of it in cvxpy and the solver", f"{cost.solver:.3f}")
    table.add_row("forward and backward", f"{cost.both:.3f}")
    table.add_row("first call, compilation included", f"{cost.first:.1f}")
    table.add_row("backward / forward", f"{cost.backward:+.2f}")
    return table


def draw_tubes(outcomes: Outcomes, path: Path) -> None:
    """Certified sets and simulations of one network, trained in each way."""
    import matplotlib.pyplot as plt

    from reachjax.tubes.plotting import plot_set, plot_tube

    chosen = _most_telling(outcomes)
    figure, axes = plt.subplots(
        1, len(outcomes), figsize=(12, 4.6), sharex=True, sharey=True, layout="constrained"
    )
    for ax, (way, group) in zip(axes, outcomes.items(), strict=True):
        outcome = group[chosen]
        tube = certified_tube(rj.MLP.from_layers(outcome.layers))
        plot_set(rj.Box(*GOAL_BOX), ax, edgecolor="none", facecolor="tab:green", alpha=0.3)
        plot_tube(tube, ax)
        ax.axhline(STATE_BOX[0, 1], color="black", linewidth=1)
        ax.set_title(f"{way}: {outcome.verdict}, error {outcome.validation_error:.4f}")
        _zoom(ax.inset_axes((0.34, 0.62, 0.44, 0.34)), tube, ax)
        ax.margins(0.05)
        ax.autoscale_view()
    for ax in axes[1:]:
        ax.set_ylabel("")
    figure.suptitle(
        f"network {chosen}: simulated states (blue), certified sets (red), goal (green), "
        "$x_2 \\geq -1$ (line; the inset is around it)"
    )
    _save(figure, path)


def _zoom(inset, tube: rj.ReachTube, ax) -> None:
    """The second set where it comes close to the constraint."""
    from reachjax.tubes.plotting import plot_tube

    plot_tube(tube, inset, samples=10_000)
    box = tube.sets[2].bounding_box()
    inset.set_xlim(float(box.lower[0]) - 0.05, float(box.upper[0]) + 0.05)
    inset.set_ylim(-1.04, -0.94)
    inset.axhline(STATE_BOX[0, 1], color="black", linewidth=1)
    inset.set(xlabel="", ylabel="", xticks=[])
    inset.tick_params(labelsize=7)
    ax.indicate_inset_zoom(inset, edgecolor="gray")


def draw_seeds(outcomes: Outcomes, path: Path) -> None:
    """Each network's error against its margin, areas step by step, and the imitation loss."""
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
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
        for of, style in ((_areas, "o-"), (_hulls, "s:")):
            median = np.median([of(outcome) for outcome in group], axis=0)
            name = f"{way}, {'certified' if of is _areas else 'simulated hull'}"
            middle.semilogy(steps, median, style, color=WAYS[way], label=name, markersize=4)
    middle.set(xlabel="t", ylabel="area, median over networks")
    middle.legend(frameon=False, fontsize=7)
    for way, group in outcomes.items():
        median = np.median([outcome.imitation for outcome in group], axis=0)
        right.semilogy(median, color=WAYS[way], linewidth=1, label=way)
    right.set(xlabel="training step", ylabel="imitation loss, median over networks")
    right.legend(frameon=False)
    _save(figure, path)


def _most_telling(outcomes: Outcomes) -> int:
    """The network whose plain copy breaks the constraint most."""
    return int(np.argmin([outcome.safe_margin for outcome in outcomes["plain"]]))


def write(settings, outcomes: Outcomes, cost: StepCost, path: Path) -> None:
    """Settings, outcomes without the weights, and costs."""
    content = {
        "settings": {name: str(value) for name, value in dataclasses.asdict(settings).items()},
        "outcomes": {way: [_plain(each) for each in group] for way, group in outcomes.items()},
        "cost": dataclasses.asdict(cost),
    }
    path.write_text(json.dumps(content, indent=1))


def _plain(outcome: Outcome) -> dict:
    fields = dataclasses.asdict(outcome)
    del fields["layers"]
    return {name: np.asarray(value).tolist() for name, value in fields.items()}


def _areas(outcome: Outcome) -> np.ndarray:
    return outcome.areas


def _hulls(outcome: Outcome) -> np.ndarray:
    return outcome.hulls


def _save(figure, path: Path) -> None:
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)
