"""Large frames in overlapping tiles, so that small birds keep their pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from jaxfit.perception.instances import Instance, Segmenter

__all__ = ["Tiled"]

SAME_BIRD = 0.5  # share of the smaller mask, of what both tiles could see


class _Tile(NamedTuple):
    x0: int
    y0: int
    x1: int
    y1: int

    def common(self, other: _Tile) -> _Tile:
        x0, y0 = max(self.x0, other.x0), max(self.y0, other.y0)
        return _Tile(x0, y0, max(x0, min(self.x1, other.x1)), max(y0, min(self.y1, other.y1)))


class Tiled:
    """A segmenter that sees a frame tile by tile.

    Tiles are squares, spread evenly so that the first and the last end with the frame. Instances of two tiles are the
    same bird if they bear one label and, within the part of the frame that both tiles show, their masks share at least
    half of the smaller one. That joins the parts of a bird that an edge cuts, and drops what
    both tiles found whole. The surest pairs are joined first, and no bird has two instances of one tile, since those
    were told apart where they were seen together. A joined bird has the union of the masks and the best score.

    Args:
        segmenter: sees the tiles.
        tile_px: side of a tile.
        overlap: least share of a tile that neighbours have in common.

    Raises:
        ValueError: a tile below 16 pixels, an overlap outside of [0, 1).
    """

    def __init__(self, segmenter: Segmenter, tile_px: int, overlap: float = 0.25):
        if tile_px < 16:
            raise ValueError(f"tile_px must be 16 or more, not {tile_px}")
        if not 0 <= overlap < 1:
            raise ValueError(f"overlap must be within 0 and 1, not {overlap}")
        self._segmenter, self._tile_px, self._overlap = segmenter, tile_px, overlap
        self.class_names = segmenter.class_names

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        height, width = frame.shape[:2]
        found: list[tuple[Instance, _Tile]] = []
        for y0, y1 in _spans(height, self._tile_px, self._overlap):
            for x0, x1 in _spans(width, self._tile_px, self._overlap):
                part = self._segmenter(np.ascontiguousarray(frame[y0:y1, x0:x1]))
                tile = _Tile(x0, y0, x1, y1)
                found += [(one._replace(x0=one.x0 + x0, y0=one.y0 + y0), tile) for one in part]
        return sorted(_joined(found), key=lambda instance: -instance.score)


def _spans(length: int, tile: int, overlap: float) -> list[tuple[int, int]]:
    """Starts and ends of the fewest tiles along one side that overlap as much."""
    if length <= tile:
        return [(0, length)]
    count = 1 + int(np.ceil((length - tile) / (tile * (1 - overlap))))
    starts = np.linspace(0, length - tile, count).round().astype(int)
    return [(int(start), int(start) + tile) for start in starts]


def _joined(found: list[tuple[Instance, _Tile]]) -> list[Instance]:
    pairs = [
        (share, i, j)
        for i in range(len(found))
        for j in range(i + 1, len(found))
        if (share := _shared(*found[i], *found[j])) >= SAME_BIRD
    ]
    owner = list(range(len(found)))
    birds = {i: [i] for i in owner}
    for _, i, j in sorted(pairs, key=lambda pair: -pair[0]):
        one, other = birds[owner[i]], birds[owner[j]]
        if {found[k][1] for k in one} & {found[k][1] for k in other}:
            continue  # so also where they are one bird already
        one += birds.pop(owner[j])
        for k in other:
            owner[k] = owner[i]
    return [_union([found[k][0] for k in bird]) for bird in birds.values()]


def _shared(one: Instance, its: _Tile, other: Instance, others: _Tile) -> float:
    """What the masks share where both tiles look, as a part of the smaller one."""
    if its == others or one.label != other.label:
        return 0.0
    region = its.common(others)
    smaller = min(np.count_nonzero(_part(one, region)), np.count_nonzero(_part(other, region)))
    if not smaller:
        return 0.0
    both = region.common(_reach(one)).common(_reach(other))
    return np.count_nonzero(_part(one, both) & _part(other, both)) / smaller


def _reach(instance: Instance) -> _Tile:
    height, width = instance.mask.shape
    return _Tile(instance.x0, instance.y0, instance.x0 + width, instance.y0 + height)


def _part(instance: Instance, region: _Tile) -> Bool[np.ndarray, "h w"]:
    """The instance's mask as far as it lies in the region."""
    inside = region.common(_reach(instance))
    x, y = instance.x0, instance.y0
    return instance.mask[inside.y0 - y : inside.y1 - y, inside.x0 - x : inside.x1 - x]


def _union(instances: list[Instance]) -> Instance:
    best = max(instances, key=lambda instance: instance.score)
    if len(instances) == 1:
        return best
    corners = np.array([_reach(instance) for instance in instances])
    (x0, y0), (x1, y1) = corners[:, :2].min(0).tolist(), corners[:, 2:].max(0).tolist()
    mask = np.zeros((y1 - y0, x1 - x0), bool)
    for instance in instances:
        height, width = instance.mask.shape
        mask[instance.y0 - y0 :, instance.x0 - x0 :][:height, :width] |= instance.mask
    return Instance(mask, x0, y0, best.score, best.label)
