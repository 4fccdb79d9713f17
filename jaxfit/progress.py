"""Progress of long computations: silent by default, a bar on the terminal for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["ProgressTask", "ReportProgress", "silent", "terminal"]

ReportProgress = Callable[[float, str], None]
"""Function of the amount of work since the last call and a short note."""
ProgressTask = Callable[[str, float | None], AbstractContextManager[ReportProgress]]
"""Function that opens a task with a name and a total amount of work; None is an unknown amount."""


@contextmanager
def silent(_name: str, _total: float | None) -> Iterator[ReportProgress]:
    """Report nothing."""
    yield lambda _done, _note: None


@contextmanager
def terminal(name: str, total: float | None) -> Iterator[ReportProgress]:
    """Show a bar with elapsed and remaining time on stderr, or plain lines if stderr is not a terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=16),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("+"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(name, total=total, note="")
        yield lambda done, note: bar.update(task, advance=done, note=note)
