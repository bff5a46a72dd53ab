"""What experiments share at the command line: a progress bar and a check of counts."""

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


def bar(progress=True):
    """A bar that counts; silent without `progress`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), disable=not progress)


def at_least_one(**counts):
    """Raise a `ValueError` that names the first count below one."""
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
