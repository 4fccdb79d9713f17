"""Mask R-CNN of torchvision, exported to ONNX."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, coco_by_category, names_of
from jaxfit.perception.segmentation.inputs import image_input
from jaxfit.perception.segmentation.placing import Placement

__all__ = ["MaskRcnn"]

LONGEST_PX = 1333  # what torchvision shrinks longer pictures to; its masks come at the size it is given


class MaskRcnn:
    """Boxes, labels, scores and masks, suppressed and pasted within the network.

    `boxes` (N, 4): corners in pixels of the input; `labels` (N,) from 1 on, 0 being the background; `scores` (N,);
    `masks` (N, 1, H, W): probabilities over the whole input. The export pastes the head's 28 x 28 masks itself. Input:
    (3, H, W) or (1, 3, H, W), red-green-blue within [0, 1]; the network scales and normalises. Where the
    size is free, frames longer than 1333 pixels are shrunk to that beforehand, as the network would: masks over
    the whole of a larger frame cost much memory and show nothing more. Where it is fixed, frames are letterboxed.

    The file tells nothing of its classes: they are COCO's, unless its metadata holds `names` or they are given here,
    the background left out.

    Args:
        classes: names that are kept; None takes `bird`.
        min_score: least score; None takes 0.5.
        names: of its classes, where they are not COCO's.

    Raises:
        InputError: another layout, or other classes than asked for.

    Source: `paste_masks_in_image` and `test_onnx.py` of https://github.com/pytorch/vision (BSD-3).
    """

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model = model
        self._input = image_input(model, unbatched=True)
        self._min_score = 0.5 if min_score is None else min_score
        if names is None and "names" not in model.metadata:
            found = coco_by_category()
        else:
            found = {i + 1: name for i, name in names_of(model, names, None).items()}
        self._chosen = choose_classes(model.path, found, classes)
        self.class_names = tuple(self._chosen.values())

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its outputs."""
        ranks = {port.name: len(port.shape) for port in model.outputs}
        return ranks == {"boxes": 2, "labels": 1, "scores": 1, "masks": 4}

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        frame_px = (frame.shape[1], frame.shape[0])
        if self._input.size_px is not None:
            placement = Placement.letterboxed(frame_px, self._input.size_px, centred=False)
        else:
            zoom = min(1.0, LONGEST_PX / max(frame_px))
            placement = Placement.stretched(frame_px, (round(frame_px[0] * zoom), round(frame_px[1] * zoom)))
        picture = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array(picture))
        boxes, scores = (outputs[name].astype(np.float32) for name in ("boxes", "scores"))
        labels, masks = outputs["labels"], outputs["masks"]
        if len(masks) and masks.shape[1:] != (1, *placement.input_px[::-1]):
            problem = f"its masks {masks.shape} do not cover its input"
            raise InputError(self._model.path, problem, "export the whole network, with its own post-processing")
        boxes_px = placement.boxes_px(boxes)
        found = (
            placement.instance(masks[i, 0], boxes_px[i], 0.5, float(scores[i]), self._chosen[int(labels[i])])
            for i in np.argsort(-scores)
            if scores[i] >= self._min_score and int(labels[i]) in self._chosen
        )
        return [instance for instance in found if instance is not None]
