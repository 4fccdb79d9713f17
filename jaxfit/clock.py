"""Measurement of the time that the parts of a computation take."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

__all__ = ["Clock"]

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
