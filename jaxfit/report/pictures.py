"""The pictures of a report: some frames of the footage with the fitted birds."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.view.overlay import overlay_pictures

__all__ = ["Picture", "report_pictures", "spread_frames"]

_COUNT, _WIDTH_PX, _QUALITY = 6, 960, 80


class Picture(NamedTuple):
    """One frame with drawn birds."""

    frame: int
    birds: int
    """Number of birds with a pose."""
    width: int
    height: int
    jpeg: bytes


def report_pictures(
    solution: Solution, bird: Bird, video: Path, observations: Observations | None = None, force: bool = False
) -> list[Picture]:
    """Draw some frames of a result; with `force`, also on a video that is not the video of the result.

    Raises:
        InputError: as `jaxfit.view.overlay.overlay_frame`.
    """
    frames = solution.frame_index[spread_frames(solution.valid)].tolist()
    more: dict[str, Any] = {"observations": observations, "max_width": _WIDTH_PX, "force": force}
    drawn = overlay_pictures(solution, bird, video, frames, **more)
    pictures = []
    for frame, image in drawn:
        birds = int(solution.valid[:, int(np.searchsorted(solution.frame_index, frame))].sum())
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        pictures.append(Picture(frame, birds, image.shape[1], image.shape[0], jpeg.tobytes()))
    return pictures


def spread_frames(valid: Bool[np.ndarray, "N T"], count: int = _COUNT) -> list[int]:
    """Return the positions of some frames, spread over the result.

    The frames with a pose are divided into `count` parts of equal length. The frame with the most poses is chosen from
    every part; of several such frames, the frame that is nearest to the middle of the part.

    Args:
        valid: where birds have poses.
        count: number of frames; fewer frames with a pose are all chosen.
    """
    poses = valid.sum(0)
    chosen = []
    for part in np.array_split(np.flatnonzero(poses), count):
        if len(part):
            from_middle = np.abs(np.arange(len(part)) - (len(part) - 1) / 2)
            chosen.append(int(part[np.lexsort((from_middle, -poses[part]))[0]]))
    return chosen
