"""Birds of several inputs of one frame: smaller inputs for large birds, and the tiles of large frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from jaxfit.perception.network import Instance, Segmenter

MIN_SAME_IOU = 0.5
"""Boxes or masks with a larger IoU show the same bird, the usual limit of a match (Everingham et al. 2010)."""
MIN_PART_SHARE = 0.5
"""Least share of a part that lies in the whole bird, and least share of a whole bird that hides it."""


def length_px(bird: Instance) -> int:
    """Return the longer side of a bird's box, in image pixels."""
    return max(bird.mask.shape)


def replace_parts(
    birds: Sequence[Instance], birds_of_smaller_input: Sequence[Instance], min_length_px: float
) -> list[Instance]:
    """Return the birds of a frame, in which long birds of a smaller input replace their parts.

    A long bird replaces all birds of which at least half lies in its mask. A bird that reaches beyond the long bird and
    that contains at least half of it stays, and the long bird is dropped. The scores do not count: parts can have high
    scores.

    Args:
        birds: birds of the usual input.
        birds_of_smaller_input: birds of the same frame in a smaller input.
        min_length_px: shorter birds of the smaller input are dropped, image pixels.
    """
    kept = list(birds)
    for whole in birds_of_smaller_input:
        if length_px(whole) < min_length_px:
            continue
        common = [common_pixels(bird, whole) for bird in kept]
        is_part = [n >= MIN_PART_SHARE * np.count_nonzero(bird.mask) for n, bird in zip(common, kept, strict=True)]
        least = MIN_PART_SHARE * np.count_nonzero(whole.mask)
        if any(n >= least and not part for n, part in zip(common, is_part, strict=True)):
            continue
        kept = [bird for bird, part in zip(kept, is_part, strict=True) if not part] + [whole]
    return kept


def common_pixels(first: Instance, second: Instance) -> int:
    """Count the pixels that belong to both birds."""
    corners = np.array([first.corners_px, second.corners_px]).astype(int)
    (x0, y0), (x1, y1) = corners.max(0)[:2].tolist(), corners.min(0)[2:].tolist()
    if x0 >= x1 or y0 >= y1:
        return 0
    parts = [i.mask[y0 - i.y0 : y1 - i.y0, x0 - i.x0 : x1 - i.x0] for i in (first, second)]
    return int(np.count_nonzero(parts[0] & parts[1]))


def mask_iou(first: Instance, second: Instance) -> float:
    """Return the intersection over union of the masks of two birds."""
    common = common_pixels(first, second)
    return common / (np.count_nonzero(first.mask) + np.count_nonzero(second.mask) - common)


def smaller_inside(first: Instance, second: Instance) -> float:
    """Return the share of the smaller of two birds that lies in the other."""
    return common_pixels(first, second) / min(np.count_nonzero(first.mask), np.count_nonzero(second.mask))


MIN_TILE_SHARE = 0.5  # of the smaller mask within the intersection of two tiles


class _Tile(NamedTuple):
    x0: int
    y0: int
    x1: int
    y1: int

    def intersection(self, other: _Tile) -> _Tile:
        x0, y0 = max(self.x0, other.x0), max(self.y0, other.y0)
        return _Tile(x0, y0, max(x0, min(self.x1, other.x1)), max(y0, min(self.y1, other.y1)))


class Tiled:
    """A segmenter that runs another segmenter on the tiles of a frame and merges the instances.

    Tiles are squares with equal distances; the first and the last tile touch the border of the frame. Two instances of
    different tiles are the same bird if their labels agree and if, within the intersection of the tiles, their masks
    share at least half of the smaller mask. This rule merges the parts of a bird at the edge of a tile and removes
    duplicates. Pairs with the largest share are merged first. Two instances of the same tile are never merged, because
    the segmenter separated them. A merged bird has the union of the masks and the best score.

    Args:
        segmenter: runs on each tile.
        tile_px: side of a tile.
        overlap: least share of a tile that lies in the next tile.

    Raises:
        ValueError: a tile below 16 pixels, or an overlap outside [0, 1).
    """

    def __init__(self, segmenter: Segmenter, tile_px: int, overlap: float = 0.25):
        if tile_px < 16:
            raise ValueError(f"tile_px must be 16 or more, not {tile_px}")
        if not 0 <= overlap < 1:
            raise ValueError(f"overlap must be within 0 and 1, not {overlap}")
        self._segmenter, self._tile_px, self._overlap = segmenter, tile_px, overlap
        self.class_names = segmenter.class_names
        self.min_track_score = getattr(segmenter, "min_track_score", 0.0)
        self.min_best_score = getattr(segmenter, "min_best_score", 0.0)

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        height, width = frame.shape[:2]
        detections: list[tuple[Instance, _Tile]] = []
        for y0, y1 in tile_spans(height, self._tile_px, self._overlap):
            for x0, x1 in tile_spans(width, self._tile_px, self._overlap):
                instances = self._segmenter(np.ascontiguousarray(frame[y0:y1, x0:x1]))
                tile = _Tile(x0, y0, x1, y1)
                detections += [(bird._replace(x0=bird.x0 + x0, y0=bird.y0 + y0), tile) for bird in instances]
        return sorted(_merge(detections), key=lambda instance: -instance.score)


def tile_spans(length: int, tile: int, overlap: float) -> list[tuple[int, int]]:
    """Return starts and ends of the smallest number of tiles along one side that have the overlap."""
    if length <= tile:
        return [(0, length)]
    count = 1 + int(np.ceil((length - tile) / (tile * (1 - overlap))))
    starts = np.linspace(0, length - tile, count).round().astype(int)
    return [(int(start), int(start) + tile) for start in starts]


def _merge(detections: list[tuple[Instance, _Tile]]) -> list[Instance]:
    """Merge the instances of the same bird."""
    pairs = [
        (share, i, j)
        for i in range(len(detections))
        for j in range(i + 1, len(detections))
        if (share := _shared_part(*detections[i], *detections[j])) >= MIN_TILE_SHARE
    ]
    bird_of = list(range(len(detections)))
    birds = {i: [i] for i in bird_of}
    for _, i, j in sorted(pairs, key=lambda pair: -pair[0]):
        first, second = birds[bird_of[i]], birds[bird_of[j]]
        if {detections[k][1] for k in first} & {detections[k][1] for k in second}:
            continue  # a common tile; this is also the case if both are the same bird already
        first += birds.pop(bird_of[j])
        for k in second:
            bird_of[k] = bird_of[i]
    return [_union([detections[k][0] for k in bird]) for bird in birds.values()]


def _shared_part(first: Instance, first_tile: _Tile, second: Instance, second_tile: _Tile) -> float:
    """Compute the intersection of two masks, as a share of the smaller mask within the intersection of the tiles."""
    if first_tile == second_tile or first.label != second.label:
        return 0.0
    region = first_tile.intersection(second_tile)
    smaller = min(np.count_nonzero(_mask_within(first, region)), np.count_nonzero(_mask_within(second, region)))
    if not smaller:
        return 0.0
    both = region.intersection(_extent(first)).intersection(_extent(second))
    return np.count_nonzero(_mask_within(first, both) & _mask_within(second, both)) / smaller


def _extent(instance: Instance) -> _Tile:
    """Return the box of an instance."""
    height, width = instance.mask.shape
    return _Tile(instance.x0, instance.y0, instance.x0 + width, instance.y0 + height)


def _mask_within(instance: Instance, region: _Tile) -> Bool[np.ndarray, "h w"]:
    """Return the part of an instance's mask that lies in the region."""
    inside = region.intersection(_extent(instance))
    x, y = instance.x0, instance.y0
    return instance.mask[inside.y0 - y : inside.y1 - y, inside.x0 - x : inside.x1 - x]


def _union(instances: list[Instance]) -> Instance:
    """Combine the instances of one bird: the union of the masks, the label and score of the best instance."""
    best = max(instances, key=lambda instance: instance.score)
    if len(instances) == 1:
        return best
    corners = np.array([_extent(instance) for instance in instances])
    (x0, y0), (x1, y1) = corners[:, :2].min(0).tolist(), corners[:, 2:].max(0).tolist()
    mask = np.zeros((y1 - y0, x1 - x0), bool)
    for instance in instances:
        height, width = instance.mask.shape
        mask[instance.y0 - y0 :, instance.x0 - x0 :][:height, :width] |= instance.mask
    return Instance(mask, x0, y0, best.score, best.label)
