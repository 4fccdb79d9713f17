"""The masks of the birds of a frame, and the masks of the other birds near a bird."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float, Real

from jaxfit.data.observations import Observations

__all__ = ["BirdsOfFrame", "FrameMasks"]

_KEPT = 1024
"""Number of frames whose masks stay in memory."""


class BirdsOfFrame(NamedTuple):
    """The masks of the birds that share the image of a frame."""

    tracks: tuple[int, ...]
    """Positions of the tracks."""
    masks: tuple[Mapping[str, Any], ...]
    """Run lengths."""
    boxes_px: Float[np.ndarray, "birds 4"]
    """x, y, width, height of the masks."""


class FrameMasks:
    """The masks of the birds of a video, by frame. Masks of frames that were used lately stay in memory.

    Args:
        observations: the birds.
    """

    def __init__(self, observations: Observations):
        self._masks, self._own_images = observations.masks, observations.own_images
        cells = np.fromiter(chain.from_iterable(self._masks), np.int64, 2 * len(self._masks)).reshape(-1, 2)
        cells = cells[np.argsort(cells[:, 1], kind="stable")].astype(np.int32)
        self._tracks, self._frames = cells.T.copy()
        self.birds = lru_cache(_KEPT)(self._birds)

    def _birds(self, t: int) -> BirdsOfFrame:
        """Return the birds with a mask in the frame at position `t`, without birds that have an image of their own."""
        from pycocotools import mask as coco_mask

        some = slice(*np.searchsorted(self._frames, [t, t + 1]).tolist())
        tracks = tuple(n for n in self._tracks[some].tolist() if (n, t) not in self._own_images)
        masks = [self._masks[n, t] for n in tracks]
        boxes = coco_mask.toBbox(cast(Any, masks)) if masks else np.zeros((0, 4))
        return BirdsOfFrame(tracks, tuple(masks), np.asarray(boxes, np.float64).reshape(-1, 4))

    def mask(self, n: int, t: int) -> Mapping[str, Any] | None:
        """Return the run lengths of the mask of a bird; None without a mask."""
        if (n, t) in self._own_images:
            return self._masks.get((n, t))
        birds = self.birds(t)
        return birds.masks[birds.tracks.index(n)] if n in birds.tracks else None

    def others(self, n: int, t: int, box_px: Real[np.ndarray, "4"]) -> list[Mapping[str, Any]]:
        """Return the masks of the other birds in the image of a bird that reach into a box.

        Args:
            n: position of the track.
            t: position of the frame.
            box_px: x, y, width, height.
        """
        if (n, t) in self._own_images:
            return []
        birds, (x0, y0, w, h) = self.birds(t), box_px
        x, y, width, height = birds.boxes_px.T
        near = (x < x0 + w) & (x + width > x0) & (y < y0 + h) & (y + height > y0)
        return [birds.masks[i] for i in np.flatnonzero(near).tolist() if birds.tracks[i] != n]

    def union_of_others(self, n: int, t: int, box_px: Real[np.ndarray, "4"]) -> Mapping[str, Any] | None:
        """Return the union of the masks of `others`; None without such a mask."""
        from pycocotools import mask as coco_mask

        masks = self.others(n, t, box_px)
        return cast(Any, coco_mask.merge(cast(Any, masks))) if masks else None
