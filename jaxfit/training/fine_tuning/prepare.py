"""Labelled pictures of a user as `LabelledFrames`: the same kind of training data as the simulated frames.

The networks are trained for birds of a certain length in pixels. The lengths of the labelled birds determine the scale
at which the new network will see the footage: `longer_side` of a segmenter, the margins of the crops of a keypoint
network. Training uses the scales around this scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.data.masks import decode_mask
from jaxfit.perception.keypoints.crops import DILATE_PX, PAD_PX
from jaxfit.perception.segmentation.bottom_up import LONGER_SIDE_PX, MULTIPLE
from jaxfit.storage.files import new_folder
from jaxfit.training.fine_tuning.label_pictures import StoredPicture
from jaxfit.training.fine_tuning.labels import LabelledBird, LabelledPicture
from jaxfit.training.keypoints import PAPER_PIXELS_PER_UNIT
from jaxfit.training.labelled_frames import (
    MARKER,
    UNKNOWN,
    LabelledFrames,
    create_pictures,
    load_frames,
    save_labels,
)
from jaxfit.training.segmenter import PIXELS_PER_UNIT

__all__ = ["Scale", "choose_scale", "owner_of", "prepare_frames"]

PAPER_BIRD_PX = 250.0
"""Length of a bird in the footage for which the margins of the crops are chosen."""
INPUT_BIRD_PX = 60.0, 120.0
"""Range of the median length of a bird in the segmenter's input; the simulated birds have 50 to 139 pixels."""
LONGEST_SIDE_PX = 1728
"""Largest `longer_side`; the time of a segmenter grows with the square."""
STORED_BIRD_PX = 260.0
"""Larger birds are reduced to this median length before the training, which saves disk space."""


class Scale(NamedTuple):
    """The scale at which the network will see the footage."""

    bird_px: float
    """Median length of the labelled birds: the longer side of their boxes, pixels of the pictures."""
    longer_side_px: int
    """Longer side of the segmenter's input."""
    pad_px: int
    """Margin of the crops of the keypoint network, pixels of the pictures."""
    dilate_px: int
    """Side of the square that dilates the masks of these crops, pixels of the pictures."""

    def pixels_per_unit(self, network: str, size_px: tuple[int, int]) -> float:
        """Return the scale of a picture of this size as `LabelledFrames` stores the scale."""
        if network == "keypoints":
            return PAPER_PIXELS_PER_UNIT * self.bird_px / PAPER_BIRD_PX
        # the middle of the training scales becomes the scale in use
        return float(np.sqrt(np.prod(PIXELS_PER_UNIT))) * max(size_px) / self.longer_side_px


def choose_scale(pictures: Iterable[LabelledPicture]) -> Scale:
    """Choose the scale for labelled pictures with at least one bird."""
    lengths, shares = [], []
    for picture in pictures:
        for bird in picture.birds:
            lengths.append(float(bird.box_px[2:].max()))
            shares.append(lengths[-1] / max(picture.size_px))
    length, input_length = float(np.median(lengths)), LONGER_SIDE_PX * float(np.median(shares))
    longer_side = LONGER_SIDE_PX * float(np.clip(input_length, *INPUT_BIRD_PX)) / input_length
    longer_side = min(max(MULTIPLE * round(longer_side / MULTIPLE), 5 * MULTIPLE), LONGEST_SIDE_PX)
    pad, dilate = (max(2, round(margin * length / PAPER_BIRD_PX)) for margin in (PAD_PX, DILATE_PX))
    return Scale(length, longer_side, pad, dilate)


def prepare_frames(
    folder: Path,
    pictures: Sequence[StoredPicture],
    names: Sequence[str],
    scale: Scale,
    network: str,
) -> LabelledFrames:
    """Write labelled pictures to a folder of labelled frames; an earlier folder is replaced.

    Pictures of several sizes lie in the upper left corners of frames of the largest size.

    Args:
        folder: the folder.
        pictures: the pictures and their labels.
        names: names of the keypoints.
        scale: the scale of the network.
        network: `segmenter` or `keypoints`.
    """
    factor = min(1.0, STORED_BIRD_PX / scale.bird_px)
    sizes = np.array(
        [np.maximum(np.round(factor * np.array(picture.labels.size_px)), 1) for picture in pictures]
    ).astype(int)
    width, height = sizes.max(0).tolist()
    S, K, N = len(pictures), len(names), max(1, *(len(picture.labels.birds) for picture in pictures))
    points, visibility = np.zeros((S, N, K, 2), np.float32), np.zeros((S, N, K), np.uint8)
    per_unit = np.zeros(S, np.float32)
    with new_folder(folder, overwrite=True, marker=MARKER) as part:
        stored, owner = create_pictures(part, S, height, width)
        for s, (picture, _) in enumerate(pictures):
            w, h = sizes[s].tolist()
            resample = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
            stored[s, :h, :w] = cv2.resize(pictures[s].pixels(), (w, h), interpolation=resample)
            own = owner_of(picture.birds, picture.size_px)
            owner[s, :h, :w] = cv2.resize(own, (w, h), interpolation=cv2.INTER_NEAREST)
            per_unit[s] = factor * scale.pixels_per_unit(network, picture.size_px)
            for n, bird in enumerate(picture.birds):
                points[s, n] = bird.keypoints_px * (w / picture.size_px[0], h / picture.size_px[1])
                visibility[s, n] = np.where(bird.visibility > 0, bird.visibility, UNKNOWN)
        del stored, owner  # writes the memory-mapped files
        save_labels(part, points, visibility, per_unit, names)
    return load_frames(folder)


def owner_of(birds: Sequence[LabelledBird], size_px: tuple[int, int]) -> np.ndarray:
    """Return the number of the bird of each pixel, from 1: masks, and the boxes of birds without masks below them."""
    owner = np.zeros((size_px[1], size_px[0]), np.uint8)
    for n, bird in enumerate(birds, 1):
        if bird.mask is None:
            x, y, width, height = bird.box_px.tolist()
            rows = slice(max(round(y), 0), max(round(y + height), 0))
            owner[rows, max(round(x), 0) : max(round(x + width), 0)] = n
    for n, bird in enumerate(birds, 1):
        if bird.mask is not None:
            owner[decode_mask(bird.mask)] = n
    return owner
