"""Work in threads of this process, for functions of libraries that let other threads run meanwhile."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")


MAX_AT_ONCE = 8
"""Largest number of items that threads work on at the same time, to bound the memory."""


def usable_cores() -> int:
    """Return the number of cores that this process may use, at most `MAX_AT_ONCE`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores or 1, MAX_AT_ONCE)


def in_threads(function: Callable[[A], B], items: Iterable[A], at_once: int) -> Generator[B]:
    """Yield the results of all items in their order; threads compute `at_once` results at the same time."""
    waiting: deque[Future[B]] = deque()
    with ThreadPoolExecutor(at_once, "jaxfit") as pool:
        try:
            for item in items:
                if len(waiting) == at_once:
                    yield waiting.popleft().result()
                waiting.append(pool.submit(function, item))
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
