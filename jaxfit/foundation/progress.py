"""Progress of long work, and the durations of its parts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import timedelta
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

ReportProgress = Callable[[float, str], None]
"""Function of the amount of work since the last call and a short note."""
ProgressTask = Callable[[str, float | None], AbstractContextManager[ReportProgress]]
"""Function that opens a task with a name and a total amount of work; None is an unknown amount."""

_LINE_S = 30.0
"""Seconds between two lines where stderr is not a terminal."""
_SPEED_S = 600.0
"""Seconds over which a bar measures its speed. Work may pause for a minute, for example tracking during a fit."""


@contextmanager
def silent(_name: str, _total: float | None) -> Iterator[ReportProgress]:
    """Report nothing."""
    yield lambda _done, _note: None


class _Terminal:
    """Opens tasks on stderr; tasks that are open at the same time share one display."""

    def __init__(self):
        self._display: _Bars | _Lines | None = None
        self._open = 0

    @contextmanager
    def __call__(self, name: str, total: float | None) -> Iterator[ReportProgress]:
        """Show a bar with elapsed and remaining time on stderr.

        If stderr is not a terminal, such as in a log file, print a line for each open task every half minute, and a
        line at the end of the task.
        """
        if self._display is None:
            console = Console(stderr=True)
            self._display = _Bars(console) if console.is_terminal else _Lines(console)
        display = self._display
        self._open += 1
        try:
            with display.task(name, total) as report_progress:
                yield report_progress
        finally:
            self._open -= 1
            if not self._open:
                self._display = None
                display.close()


terminal: ProgressTask = _Terminal()


def annotated(progress: ProgressTask, state: Callable[[], str]) -> ProgressTask:
    """Return tasks whose notes end with a text about the present state, such as the size of stored files."""

    @contextmanager
    def task(name: str, total: float | None) -> Iterator[ReportProgress]:
        with progress(name, total) as report_progress:
            yield lambda done, note: report_progress(done, f"{note}, {state()}" if note else state())

    return task


class _Bars:
    """Bars on a terminal, one for each task."""

    def __init__(self, console: Console):
        self._bars = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=16),
            TaskProgressColumn("{task.percentage:>3.0f} %", text_format_no_percentage=""),
            TimeElapsedColumn(),
            TextColumn("{task.fields[plus]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=console,
            speed_estimate_period=_SPEED_S,
        )
        self._bars.start()

    @contextmanager
    def task(self, name: str, total: float | None) -> Iterator[ReportProgress]:
        task = self._bars.add_task(name, total=total, note="", plus="" if total is None else "+")
        try:
            yield lambda done, note: self._bars.update(task, advance=done, note=note)
        finally:
            self._bars.stop_task(task)

    def close(self) -> None:
        self._bars.stop()


class _Lines:
    """Lines in a log: one for each open task every `_LINE_S` seconds."""

    def __init__(self, console: Console):
        self._console, self._printed = console, time.monotonic()
        self._open: list[Callable[[], None]] = []  # each prints the line of a task

    @contextmanager
    def task(self, name: str, total: float | None) -> Iterator[ReportProgress]:
        start = time.monotonic()
        done, note = 0.0, ""
        reports = 0
        first = 0.0, math.inf  # time and work of the second report: before it, programs compile

        def show() -> None:
            elapsed = time.monotonic() - start
            parts = []
            if total is not None:
                parts.append(f"{100 * done / total if total else 100:.0f} %")
            parts.append(f"{timedelta(seconds=round(elapsed))}")
            if total is not None and first[1] < done < total:
                rest_s = (time.monotonic() - first[0]) * (total - done) / (done - first[1])
                parts[-1] += f" + {timedelta(seconds=round(rest_s))}"
            line = f"{name}: {', '.join([*parts, note] if note else parts)}"
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)

        def report_progress(more: float, text: str) -> None:
            nonlocal done, note, reports, first
            done, note, reports = done + more, text, reports + 1
            if reports == 2:
                first = time.monotonic(), done
            if time.monotonic() - self._printed >= _LINE_S:
                self._printed = time.monotonic()
                for show_task in self._open:
                    show_task()

        self._open.append(show)
        try:
            yield report_progress
        finally:
            self._open.remove(show)
        show()

    def close(self) -> None:
        """Print nothing more; every task has printed its last line."""


T = TypeVar("T")


class Clock:
    """Sums the time of each part: `with clock("read"): …`. Time in a nested part counts for the nested part only."""

    seconds: dict[str, float]
    """Part → time so far in seconds, in the order of the first use of the parts."""

    def __init__(self):
        self.seconds = {}
        self._nested_s = 0.0  # time of finished parts within the part that is measured

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        self.seconds.setdefault(part, 0.0)
        began, outer_s, self._nested_s = time.perf_counter(), self._nested_s, 0.0
        try:
            yield
        finally:
            elapsed_s = time.perf_counter() - began
            self.seconds[part] += elapsed_s - self._nested_s
            self._nested_s = outer_s + elapsed_s

    def each(self, part: str, items: Iterable[T]) -> Iterator[T]:
        """Yield the items, and count the time to get each item as `part`."""
        source, none = iter(items), object()
        while True:
            with self(part):
                item = next(source, none)
            if item is none:
                return
            yield item  # pyright: ignore[reportReturnType]
