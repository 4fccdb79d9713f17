"""Inputs of networks as in use, for the statistics of their activations: whole frames, and crops of detected birds.

Half of the pictures have a random appearance, as in the training.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfit.perception.instances import Segmenter
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.perception.segmentation.bottom_up import BottomUp
from jaxfit.progress import ProgressTask, silent
from jaxfit.training.activations import store_activations
from jaxfit.training.augment import randomise_appearance

__all__ = ["keypoint_inputs", "pictures_in_use", "segmenter_inputs", "store_training_activations"]

LONGER_SIDE_PX = 864
"""Longer side of the pictures with a random appearance; blur and noise have the scale of the training there."""
MAX_PICTURES = 400
"""Largest number of pictures; more pictures hardly change the statistics."""


def store_training_activations(
    which: str,
    path: str | Path,
    pictures: UInt8[np.ndarray, "S H W 3"],
    owner: UInt8[np.ndarray, "S H W"],
    progress: ProgressTask = silent,
) -> None:
    """Store the statistics of the activations of a trained network over its training pictures.

    Args:
        which: `segmenter`, or `keypoints`, whose birds are those that the built-in segmenter detects.
        path: the ONNX file; it is replaced.
        pictures: blue, green, red; may be memory-mapped.
        owner: number of the bird of each pixel, 0 for no bird.
        progress: reports every picture.

    Raises:
        InputError: the file is no such network, or the pictures show fewer than 10 birds.
    """
    shown = pictures_in_use(pictures, owner)
    if which == "segmenter":
        inputs = segmenter_inputs(path, shown)
    else:
        inputs = keypoint_inputs(path, shown, load_segmenter("builtin"))
    store_activations(path, inputs, min(len(pictures), MAX_PICTURES), progress)


def pictures_in_use(
    pictures: UInt8[np.ndarray, "S H W 3"], owner: UInt8[np.ndarray, "S H W"], seed: int = 0
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Return at most 400 of S labelled pictures, at even distances; every second picture has a random appearance.

    Args:
        pictures: blue, green, red; may be memory-mapped.
        owner: number of the bird of each pixel, 0 for no bird.
        seed: seed of the random appearance.
    """
    S = len(pictures)
    for i, s in enumerate(np.unique(np.linspace(0, S - 1, min(S, MAX_PICTURES)).astype(int))):
        picture = np.asarray(pictures[s])
        if i % 2:
            zoom = LONGER_SIDE_PX / max(picture.shape[:2])
            picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
            size = picture.shape[1], picture.shape[0]
            birds = cv2.resize(np.asarray(owner[s]), size, interpolation=cv2.INTER_NEAREST) > 0
            with np.errstate(over="ignore"):  # far from the edge of a cast shadow
                picture = randomise_appearance(np.random.default_rng((seed, s)), np.asarray(picture, np.uint8), birds)
        yield picture


def segmenter_inputs(path: str | Path, pictures: Iterable[UInt8[np.ndarray, "H W 3"]]) -> Iterator[np.ndarray]:
    """Return the inputs (1, 3, h, w) of a bottom-up segmenter for whole frames.

    Raises:
        InputError: the file is no bottom-up segmenter.
    """
    segmenter = load_segmenter(path, kind="bottom_up")
    assert isinstance(segmenter, BottomUp)
    for picture in pictures:
        yield segmenter.network_input(picture)[0]


def keypoint_inputs(
    path: str | Path, pictures: Iterable[UInt8[np.ndarray, "H W 3"]], segmenter: Segmenter
) -> Iterator[np.ndarray]:
    """Return the inputs (N, 3, h, w) of a keypoint network for the birds that a segmenter detects.

    Raises:
        InputError: the file is no keypoint network.
    """
    detector = load_keypoint_detector(path)
    for picture in pictures:
        birds = segmenter(picture)
        if birds:
            yield detector.network_input(picture, birds)[0]
