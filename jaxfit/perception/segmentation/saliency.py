"""Masks for a detector without masks: salient object segmentation within each box (U²-Net)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.perception.imagenet import normalise
from jaxfit.perception.instances import Instance, collect_instances
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.inputs import image_input
from jaxfit.perception.segmentation.placement import Placement
from jaxfit.perception.segmentation.yolox import Yolox

__all__ = ["DetectorAndSaliency", "Saliency"]

# margins on each side of a box, as shares of its sides:
CONTEXT = 0.25  # of the picture for the saliency network, which needs background around the object
MASK_MARGIN = 0.05  # of the mask, because boxes are seldom exact
_DEFAULT_INPUT_PX = (320, 320)


class Saliency:
    """Probability that a pixel belongs to the salient object of a picture, the first output of U²-Net.

    Input (1, 3, h, w): the picture stretched to the input, divided by its largest value, red-green-blue, normalised
    with ImageNet's mean and standard deviation; 320 x 320 for an input of variable size. First output (1, 1, h, w):
    probabilities. The outputs of coarser stages are not used.

    Raises:
        InputError: an unsupported input.

    Source: Qin et al. 2020, U²-Net; `ToTensorLab` of https://github.com/xuebinqin/U-2-Net (Apache-2.0).
    """

    def __init__(self, model: OnnxModel):
        self._model = model
        self._input = image_input(model)
        self.size_px = self._input.size_px or _DEFAULT_INPUT_PX

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the shapes of a network have this layout."""
        shape = model.outputs[0].shape
        return len(model.inputs) == 1 and len(shape) == 4 and shape[1] == 1

    def __call__(self, picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Compute the probabilities over a blue-green-red picture of `size_px`."""
        rgb = picture[..., ::-1].astype(np.float32) / max(1, int(picture.max()))
        outputs = self._model(self._input.array(normalise(rgb)))
        name = self._model.outputs[0].name
        self._model.check_outputs(outputs, {name: (1, 1, "h", "w")})
        return outputs[name][0, 0].astype(np.float32)


class DetectorAndSaliency:
    """A segmenter of a detector and a saliency network.

    A mask is the part of the largest connected component within the slightly enlarged box. Birds that occlude each
    other within one box share a mask. A box without a salient object gives no instance.

    Args:
        detector: detects the boxes and their scores.
        saliency: computes the masks.
    """

    def __init__(self, detector: Yolox, saliency: Saliency):
        self._detector, self._saliency = detector, saliency
        self.class_names = detector.class_names

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        frame_px = (frame.shape[1], frame.shape[0])
        return collect_instances(self._detector.path, self._instances(frame, frame_px), frame_px)

    def _instances(self, frame: UInt8[np.ndarray, "H W 3"], frame_px: tuple[int, int]) -> Iterator[Instance | None]:
        for corners_px, score, label in self._detector(frame):
            crop_px = _enlarge(corners_px, CONTEXT, frame_px)
            if (crop_px[:2] >= crop_px[2:]).any():  # a box outside the frame
                continue
            placement = Placement.cropped(frame_px, self._saliency.size_px, crop_px)
            probability = self._saliency(placement.picture(frame))
            enlarged_px = _enlarge(corners_px, MASK_MARGIN, frame_px)
            yield placement.instance(probability, enlarged_px, 0.5, score, label, keep=_largest_component)


def _enlarge(corners_px: Float[np.ndarray, "4"], share: float, frame_px: tuple[int, int]) -> Int[np.ndarray, "4"]:
    """Add margins to a box, round outwards to whole pixels, and clip to the frame."""
    margin = np.tile(corners_px[2:] - corners_px[:2], 2) * share * [-1, -1, 1, 1]
    low, high = np.floor(corners_px + margin)[:2], np.ceil(corners_px + margin)[2:]
    return np.clip(np.concatenate([low, high]), 0, np.tile(frame_px, 2)).astype(int)


def _largest_component(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    _, components, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) == 1:
        return mask
    return components == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()
