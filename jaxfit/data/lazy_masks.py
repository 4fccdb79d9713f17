"""Masks of many birds and frames that are read when they are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

__all__ = ["LazyMasks"]


class LazyMasks(Mapping[tuple[int, int], Mapping[str, Any]]):
    """A mapping as `Observations.masks`, whose values are read at every access.

    Args:
        cells: positions (n, t) of the masks, each once.
        read: returns the run lengths of a mask from its number in `cells`. Masks with near numbers are read together
            at the lowest cost, so iteration follows the numbers.
        numbers: numbers that `read` receives; None counts from 0.
    """

    def __init__(
        self,
        cells: Int[np.ndarray, "M 2"],
        read: Callable[[int], Mapping[str, Any]],
        numbers: Int[np.ndarray, "M"] | None = None,
    ):
        self._cells, self._read = cells.astype(np.int64).reshape(-1, 2), read
        self._numbers = np.arange(len(cells)) if numbers is None else numbers
        self._columns = int(self._cells[:, 1].max(initial=0)) + 1
        keys = self._keys(self._cells)
        self._order = np.argsort(keys)
        self._sorted = keys[self._order]

    def select(self, rows: Mapping[int, int], columns: Mapping[int, int]) -> LazyMasks:
        """Return the masks of some tracks and frames, which are not read.

        Args:
            rows, columns: old position → new position of the tracks and frames that remain.
        """
        kept = [i for i, (n, t) in enumerate(self._cells.tolist()) if n in rows and t in columns]
        cells = np.array([(rows[n], columns[t]) for n, t in self._cells[kept].tolist()], np.int64)
        return LazyMasks(cells, self._read, self._numbers[kept])

    def __getitem__(self, cell: tuple[int, int]) -> Mapping[str, Any]:
        return self._read(int(self._numbers[self._find(cell)]))

    def __contains__(self, cell: object) -> bool:
        try:
            self._find(cell)
        except KeyError:
            return False
        return True

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return ((n, t) for n, t in self._cells.tolist())

    def __len__(self) -> int:
        return len(self._cells)

    def _find(self, cell: Any) -> int:
        n, t = cell
        if not 0 <= t < self._columns:
            raise KeyError(cell)
        key = n * self._columns + t
        i = int(np.searchsorted(self._sorted, key))
        if i == len(self._sorted) or self._sorted[i] != key:
            raise KeyError(cell)
        return int(self._order[i])

    def _keys(self, cells: Int[np.ndarray, "M 2"]) -> Int[np.ndarray, "M"]:
        return cells[:, 0] * self._columns + cells[:, 1]
