"""How tight certified reachable sets are, and what that costs, method by method.

Methods are the paper's quadratic constraints, local bounds, cutting planes over windows of several
lengths, and partitions of the initial set. Loops are the double integrator with trained and with
random networks, and the quadrotor. Certified sets are compared with the tightest ones of the same
template: those of exact maxima where mixed-integer programming is affordable, else of the largest
values that simulations and ascents attain. No bound may be below such a value: the study fails if
one is.
"""

import jax
import rich

from experiments.command import bar, require_folder
from experiments.tightness.cases import Group, Settings, groups
from experiments.tightness.figures import NOTE, draw, table, write
from experiments.tightness.methods import chosen, measure
from experiments.tightness.reference import Result, reference


def study(settings: Settings) -> list[Result]:
    """Every method on every group; each table is printed as soon as it is complete."""
    results, found = [], groups(settings)
    runs = {group.name: _methods(group, settings) for group in found}
    with bar() as shown:
        task = shown.add_task("", total=sum(len(names) + 1 for names in runs.values()))
        for group in found:
            jax.clear_caches()  # of the group before: all together fill gigabytes
            measured = {}
            for name in runs[group.name]:
                shown.update(task, description=f"{group.name}: {name}")
                measured[name] = measure(group, name, settings)
                shown.advance(task)
            shown.update(task, description=f"{group.name}: largest values")
            results.append(Result(group, measured, reference(group, measured, settings)))
            shown.advance(task)
            shown.console.print(table(results[-1]))
    return results


def _methods(group: Group, settings: Settings) -> list[str]:
    """Names of those that are run on a group.

    Raises:
        ValueError: there are none.
    """
    names = [name for name in chosen(settings) if name not in group.left_out]
    if not names:
        raise ValueError(f"--methods must name one that is run on {group.name}, but none is")
    return names


def main(settings: Settings) -> None:
    """Measure, print, and write the rows and the figure; fail if a bound is below what is known."""
    require_folder(settings.output)
    jax.config.update("jax_enable_x64", True)  # no compilation cache: first calls are timed
    results = study(settings)
    rich.print(NOTE)
    folder = settings.output
    write(results, folder / "tightness.csv")
    draw(results, folder / "tightness.png", folder / "tightness.pdf")
    rich.print(f"written: {folder}/tightness.csv, .png, .pdf, and bounds under measured")
    if unsound := [result.group.name for result in results if not result.sound]:
        raise SystemExit(f"error: bounds are below values that are attained: {', '.join(unsound)}")
