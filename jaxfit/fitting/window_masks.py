"""The masks of a window, which are read when the window is fitted.

The masks of a long video never lie in memory together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.neighbours import FrameMasks

__all__ = ["LoadedMasks", "WindowMasks"]


class LoadedMasks(NamedTuple):
    """The masks of a window of T frames, as run lengths."""

    own: tuple[Mapping[str, Any] | None, ...]
    """The bird's mask in each image; None without a mask."""
    others: tuple[Mapping[str, Any] | Literal[False] | None, ...]
    """The masks of all other birds that reach into the crop; None without them. False where the pixels outside the
    bird's mask are background."""


class WindowMasks:
    """A reference to the masks of a window. A pickle holds the masks themselves, for workers.

    Args:
        load: returns the masks.
    """

    def __init__(self, load: Callable[[], LoadedMasks]):
        self.load = load

    def __reduce__(self) -> tuple[Any, ...]:
        return _loaded, (self.load(),)

    @classmethod
    def of(
        cls,
        frames: FrameMasks,
        n: int,
        frame: Int[np.ndarray, "T"],
        present: Bool[np.ndarray, "T"],
        crop: Float[np.ndarray, "T 3"],
        unknown_pixels: bool,
    ) -> WindowMasks:
        """Return the reference of one window.

        Args:
            frames: the masks of the video.
            n: position of the track.
            frame: positions of the frames.
            present: the frames that are fitted; other frames have no masks.
            crop: x0, y0, size in image pixels.
            unknown_pixels: whether the masks of other birds are needed.
        """

        def load() -> LoadedMasks:
            at = [t if there else -1 for t, there in zip(frame.tolist(), present.tolist(), strict=True)]
            own = tuple(None if t < 0 else frames.mask(n, t) for t in at)
            if not unknown_pixels:
                return LoadedMasks(own, (False,) * len(at))
            boxes = crop[:, [0, 1, 2, 2]]
            others = (None if t < 0 else frames.union_of_others(n, t, boxes[i]) for i, t in enumerate(at))
            return LoadedMasks(own, tuple(others))

        return cls(load)


def _loaded(masks: LoadedMasks) -> WindowMasks:
    return WindowMasks(lambda: masks)
