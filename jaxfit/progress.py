"""Progress of long computations: silent by default, a bar on the terminal or lines in a log for the command line."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["ProgressTask", "ReportProgress", "annotated", "silent", "terminal"]

ReportProgress = Callable[[float, str], None]
"""Function of the amount of work since the last call and a short note."""
ProgressTask = Callable[[str, float | None], AbstractContextManager[ReportProgress]]
"""Function that opens a task with a name and a total amount of work; None is an unknown amount."""

_LINE_S = 30.0
"""Seconds between two lines where stderr is not a terminal."""


@contextmanager
def silent(_name: str, _total: float | None) -> Iterator[ReportProgress]:
    """Report nothing."""
    yield lambda _done, _note: None


@contextmanager
def terminal(name: str, total: float | None) -> Iterator[ReportProgress]:
    """Show a bar with elapsed and remaining time on stderr.

    If stderr is not a terminal, such as in a log file, print a line every half minute and at the end.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        with _lines(name, total, console) as report_progress:
            yield report_progress
        return
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


def annotated(progress: ProgressTask, state: Callable[[], str]) -> ProgressTask:
    """Return tasks whose notes end with a text about the present state, such as the size of stored files."""

    @contextmanager
    def task(name: str, total: float | None) -> Iterator[ReportProgress]:
        with progress(name, total) as report_progress:
            yield lambda done, note: report_progress(done, f"{note}, {state()}" if note else state())

    return task


@contextmanager
def _lines(name: str, total: float | None, console: Console) -> Iterator[ReportProgress]:
    """Print a line every `_LINE_S` seconds, and one line at the end."""
    start = printed = time.monotonic()
    done, note = 0.0, ""

    def show() -> None:
        elapsed = time.monotonic() - start
        parts = []
        if total is not None:
            parts.append(f"{100 * done / total if total else 100:.0f} %")
        parts.append(f"{timedelta(seconds=round(elapsed))}")
        if total is not None and 0 < done < total:
            parts[-1] += f" + {timedelta(seconds=round(elapsed * (total - done) / done))}"
        console.print(
            f"{name}: {', '.join([*parts, note] if note else parts)}", markup=False, highlight=False, soft_wrap=True
        )

    def report_progress(more: float, text: str) -> None:
        nonlocal done, note, printed
        done, note = done + more, text
        if time.monotonic() - printed >= _LINE_S:
            printed = time.monotonic()
            show()

    yield report_progress
    show()
