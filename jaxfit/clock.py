"""How long the parts of some work take."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

__all__ = ["Clock"]

T = TypeVar("T")


class Clock:
    """Adds up the time of each of several parts: `with clock("read"): …`."""

    seconds: dict[str, float]
    """Part → its time so far, in the order in which they began."""

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
        """The same items; to get each of them is the part."""
        source, none = iter(items), object()
        while True:
            with self(part):
                item = next(source, none)
            if item is none:
                return
            yield item  # pyright: ignore[reportReturnType]
