"""A detector's boxes, and in each the mask of what stands out there (U²-Net)."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.perception.instances import Instance
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.inputs import IMAGENET_MEAN, IMAGENET_STD, image_input
from jaxfit.perception.segmentation.placing import Placement
from jaxfit.perception.segmentation.yolox import Yolox

__all__ = ["DetectorAndSaliency", "Saliency"]

# Shares of a box's sides, added on each of them:
SEEN = 0.25  # what the saliency sees around the box: without background nothing stands out
REACH = 0.05  # how far a mask may leave the box, which is seldom exact
_FREE_INPUT_PX = (320, 320)


class Saliency:
    """How much every pixel belongs to what a picture shows, U²-Net's first output.

    Input (1, 3, h, w): a picture stretched to it, divided by its own brightest value, red-green-blue, less ImageNet's
    mean and by its deviation; 320 x 320 where its size is free. First output (1, 1, h, w): probabilities;
    the others, of coarser stages, are not used.

    Raises:
        InputError: another layout.

    Source: Qin et al. 2020, U²-Net; `ToTensorLab` of https://github.com/xuebinqin/U-2-Net (Apache-2.0).
    """

    def __init__(self, model: OnnxModel):
        self._model = model
        self._input = image_input(model)
        self.size_px = self._input.size_px or _FREE_INPUT_PX

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its shapes."""
        shape = model.outputs[0].shape
        return len(model.inputs) == 1 and len(shape) == 4 and shape[1] == 1

    def __call__(self, picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Probabilities over a blue-green-red picture of `size_px`."""
        rgb = picture[..., ::-1].astype(np.float32) / max(1, int(picture.max()))
        outputs = self._model(self._input.array((rgb - IMAGENET_MEAN) / IMAGENET_STD))
        return outputs[self._model.outputs[0].name][0, 0].astype(np.float32)


class DetectorAndSaliency:
    """Masks for a detector that has none.

    The part of the largest connected piece that lies within the box, slightly widened; birds that hide each other
    within one box share a mask. Boxes in which nothing stands out give no instance.

    Args:
        detector: finds the boxes; the instances have its scores.
        saliency: finds what stands out.
    """

    def __init__(self, detector: Yolox, saliency: Saliency):
        self._detector, self._saliency = detector, saliency
        self.class_names = detector.class_names

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        frame_px = (frame.shape[1], frame.shape[0])
        found = []
        for box_px, score, label in self._detector(frame):
            placement = Placement.cropped(frame_px, self._saliency.size_px, _widened(box_px, SEEN, frame_px))
            values = self._saliency(placement.picture(frame))
            reach_px = _widened(box_px, REACH, frame_px)
            found.append(placement.instance(values, reach_px, 0.5, score, label, keep=_largest_piece))
        return [instance for instance in found if instance is not None]


def _widened(box_px: Float[np.ndarray, "4"], share: float, frame_px: tuple[int, int]) -> Int[np.ndarray, "4"]:
    """A box with margins, out to whole pixels, as far as the frame goes."""
    margin = np.tile(box_px[2:] - box_px[:2], 2) * share * [-1, -1, 1, 1]
    low, high = np.floor(box_px + margin)[:2], np.ceil(box_px + margin)[2:]
    return np.clip(np.concatenate([low, high]), 0, np.tile(frame_px, 2)).astype(int)


def _largest_piece(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) == 1:
        return mask
    return pieces == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()
