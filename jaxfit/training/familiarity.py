"""Inputs of networks as in use, for the statistics of their activations: whole frames, and crops of detected birds.

Half of the pictures have a random appearance, as in the training.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfit.perception.instances import Instance, Segmenter, instance_of
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.perception.segmentation.bottom_up import BottomUp
from jaxfit.progress import ProgressTask, silent
from jaxfit.training.activations import store_activations
from jaxfit.training.augment import randomise_appearance
from jaxfit.training.labelled_frames import LabelledFrames

__all__ = ["keypoint_inputs", "pictures_in_use", "segmenter_inputs", "store_training_activations"]

LONGER_SIDE_PX = 864
"""Longer side of the pictures with a random appearance; blur and noise have the scale of the training there."""
MAX_PICTURES = 200
"""Number of pictures; more pictures hardly change the statistics."""


def store_training_activations(
    which: str,
    path: str | Path,
    sources: Sequence[LabelledFrames],
    segmenter: Segmenter | None = None,
    progress: ProgressTask = silent,
) -> None:
    """Store the statistics of the activations of a trained network over its training pictures.

    Args:
        which: `segmenter` or `keypoints`.
        path: the ONNX file; it is replaced.
        sources: the training frames; every source gives the same number of pictures.
        segmenter: detects the birds for a keypoint network; None takes the labelled birds.
        progress: reports every picture.

    Raises:
        InputError: the file is no such network, or the pictures show fewer than 10 birds.
    """
    count = MAX_PICTURES // len(sources)
    shown = chain.from_iterable(pictures_in_use(frames, count) for frames in sources)
    if which == "segmenter":
        inputs = segmenter_inputs(path, (picture for picture, _ in shown))
    else:
        inputs = keypoint_inputs(
            path, ((p, labelled_birds(owner) if segmenter is None else segmenter(p)) for p, owner in shown)
        )
    store_activations(path, inputs, count * len(sources), progress)


def pictures_in_use(
    frames: LabelledFrames, count: int, seed: int = 0
) -> Iterator[tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]]:
    """Return pictures at even distances and the bird of each pixel; every second picture has a random appearance.

    Args:
        frames: S labelled frames.
        count: number of pictures; a frame is repeated if S is smaller.
        seed: seed of the random appearance.
    """
    for i, s in enumerate(np.linspace(0, len(frames.pictures) - 1, count).round().astype(int).tolist()):
        picture, owner = np.asarray(frames.pictures[s]), np.asarray(frames.owner[s])
        if i % 2:
            zoom = LONGER_SIDE_PX / max(picture.shape[:2])
            picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
            owner = cv2.resize(owner, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            rng = np.random.default_rng((seed, i))
            picture = randomise_appearance(rng, np.asarray(picture, np.uint8), np.asarray(owner) > 0)
        yield picture, np.asarray(owner, np.uint8)


def labelled_birds(owner: UInt8[np.ndarray, "H W"]) -> list[Instance]:
    """Return the labelled birds of a picture as a segmenter would report the birds."""
    birds = (instance_of(owner == n, 1.0, "bird") for n in np.unique(owner[owner > 0]))
    return [bird for bird in birds if bird is not None]


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
    path: str | Path, pictures: Iterable[tuple[UInt8[np.ndarray, "H W 3"], Sequence[Instance]]]
) -> Iterator[np.ndarray]:
    """Return the inputs (N, 3, h, w) of a keypoint network for pictures and their birds.

    Raises:
        InputError: the file is no keypoint network.
    """
    detector = load_keypoint_detector(path)
    for picture, birds in pictures:
        if birds:
            yield detector.network_input(picture, birds)[0]
