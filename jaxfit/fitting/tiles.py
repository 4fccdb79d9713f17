"""Tiles: parts of a fixed shape, in which batches are computed: the result of a problem does not depend on others.

The compiler fuses and orders the operations of a program by the shapes of its arrays. Programs for different numbers of
problems therefore round differently. The steps of Adam do not become smaller, so a difference of one rounding grows to
tenths of a pixel within some hundred steps. The shape of a tile depends only on the length of the windows, so all
problems run through one compiled program.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

FRAMES_PER_TILE = 16
"""Frames in a tile of short windows. Larger tiles are not faster, and a single short window fills its tile up."""
MIN_PROBLEMS_PER_TILE = 2
"""A tile of a single long window is slow: the compiler then computes the joint transforms several times."""


def tile_size(frames: int) -> int:
    """Return the number of problems in a tile, for windows of `frames` frames."""
    return max(FRAMES_PER_TILE // frames, MIN_PROBLEMS_PER_TILE)


def tile_rows(count: int, size: int) -> list[Int[np.ndarray, "G"]]:
    """Return the rows of each tile of `size` of `count` rows.

    Rows that the last tile lacks are −1: the tile is filled with problems whose results are discarded.
    """
    rows = np.full(-(-count // size) * size, -1)
    rows[:count] = np.arange(count)
    return list(rows.reshape(-1, size))


def join_tiles(tiles: Sequence[Any], count: int) -> Any:
    """Return the first `count` rows of some tiles (pytrees of arrays with a leading axis) as NumPy arrays."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(part) for part in x])[:count], *tiles)


def take_tile(tree: Any, rows: Int[np.ndarray, "G"]) -> Any:
    """Return some rows of a pytree of arrays as JAX arrays; −1 is the last row."""
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[rows], tree))
