"""Identity of the footage that observations and results belong to.

The identity is the number of frames and a small grey picture of the first frame. A copy in another container or codec,
or as a folder of pictures, keeps both. A hash of the file, or of exact pixels, would differ in such copies. Two
recordings of one fixed camera have other first frames as soon as a bird has moved.
"""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.formats.fields import Field
from jaxfit.foundation.errors import InputError

SIDE = 32
"""Width and height of the small picture of the first frame."""
TOLERANCE = 16
"""Largest difference of a grey value between copies of one frame. Copies in usual qualities differ by up to 5, the
smallest usable ones by 12. Where birds move, two frames of a fixed camera that are 0.4 s apart differ by 22."""


class FootageIdentity(NamedTuple):
    """What identifies the whole video, also where the result holds only some of its frames."""

    frames: int | None = None
    """Number of frames; None if the container does not store it."""
    first_frame: bytes | None = None
    """Mean grey values of 32×32 equal parts of the first frame, row by row; None if the frame is unknown or damaged."""

    def entries(self) -> dict[str, Any]:
        """Return the values in the types of JSON."""
        first = None if self.first_frame is None else base64.b64encode(self.first_frame).decode()
        return {"frames": self.frames, "first_frame": first}

    def differs(self, other: FootageIdentity) -> bool:
        """Return whether the first frames of two videos are known and differ."""
        if self.first_frame is None or other.first_frame is None:
            return False
        first, second = np.frombuffer(self.first_frame, np.uint8), np.frombuffer(other.first_frame, np.uint8)
        return int(np.abs(first.astype(int) - second).max()) > TOLERANCE


def footage_of(field: Field) -> FootageIdentity:
    """Return the identity from a JSON object with the keys of `FootageIdentity.entries`; a missing key is unknown.

    Raises:
        InputError: a value has another type or size.
    """
    frames = field["frames"].integer(0) if field.has("frames") else None
    if not field.has("first_frame"):
        return FootageIdentity(frames)
    text = field["first_frame"]
    try:
        first_frame = base64.b64decode(text.text(), validate=True)
    except (binascii.Error, ValueError):
        first_frame = b""
    if len(first_frame) != SIDE**2:
        text.fail(f"is not a picture of {SIDE}×{SIDE} grey values in base64", "remove it, or write the file again")
    return FootageIdentity(frames, first_frame)


def read_footage(video: str | Path, frames: int | None) -> FootageIdentity:
    """Return the identity of a video or of a folder of images.

    Args:
        video: the video, which exists.
        frames: its number of frames, as `jaxfit.video.reader.VideoInfo.frames`.
    """
    import cv2  # readers of results need no video library

    from jaxfit.video.reader import read_frames

    try:
        first = next(iter(read_frames(video, 0, 1)), None)
    except InputError:  # the frame is damaged; whoever reads the other frames reports unreadable footage
        first = None
    if first is None:
        return FootageIdentity(frames)
    grey = cv2.cvtColor(first.picture, cv2.COLOR_BGR2GRAY)
    return FootageIdentity(frames, cv2.resize(grey, (SIDE, SIDE), interpolation=cv2.INTER_AREA).tobytes())
