"""Measurement of the time that the parts of a computation take."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

__all__ = ["Clock"]

T = TypeVar("T")


class Clock:
    """Sums the time of each part: `with clock("read"): …`."""

    seconds: dict[str, float]
    """Part → time so far in seconds, in the order of the first use of the parts."""

    def __init__(self):
        self.seconds = {}

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - began

    def each(self, part: str, items: Iterable[T]) -> Iterator[T]:
        """Yield the items, and count the time to get each item as `part`."""
        source, none = iter(items), object()
        while True:
            with self(part):
                item = next(source, none)
            if item is none:
                return
            yield item  # pyright: ignore[reportReturnType]
