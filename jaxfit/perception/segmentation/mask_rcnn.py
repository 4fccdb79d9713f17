"""Mask R-CNN of torchvision, exported to ONNX."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance, collect_instances
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import coco_by_category
from jaxfit.perception.segmentation.network import SegmentationNetwork
from jaxfit.perception.segmentation.placement import Placement

__all__ = ["MaskRcnn"]

LONGEST_SIDE_PX = 1333  # torchvision reduces longer pictures to this side; its masks have the size of the input


class MaskRcnn(SegmentationNetwork):
    """Boxes, labels, scores and masks; the network itself suppresses duplicates and pastes masks.

    Outputs: `boxes` (N, 4), corners in pixels of the input; `labels` (N,) from 1 on, 0 is the background; `scores`
    (N,); `masks` (N, 1, H, W), probabilities over the whole input. The export pastes the head's 28 x 28 masks. Input:
    (3, H, W) or (1, 3, H, W), red-green-blue within [0, 1]; the network scales and normalises. For an input of variable
    size, frames longer than 1333 pixels are first reduced to 1333 pixels, as the network would do: masks over a larger
    frame need much memory and show no more detail. For an input of fixed size, frames are letterboxed.

    The classes are COCO's, unless the metadata contains `names` or the caller gives names. These names exclude the
    background.

    Source: `paste_masks_in_image` and `test_onnx.py` of https://github.com/pytorch/vision (BSD-3).
    """

    layout = "outputs boxes (N, 4), labels (N), scores (N), masks (N, 1, H, W)"
    default_min_score = 0.5
    accepts_unbatched = True

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        ranks = {port.name: len(port.shape) for port in model.outputs}
        return ranks == {"boxes": 2, "labels": 1, "scores": 1, "masks": 4}

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        if names is None and "names" not in self._model.metadata:
            return coco_by_category()
        return {i + 1: name for i, name in super()._all_classes(names).items()}

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        frame_px = (frame.shape[1], frame.shape[0])
        if self._input.size_px is not None:
            placement = Placement.letterboxed(frame_px, self._input.size_px, centred=False)
        else:
            zoom = min(1.0, LONGEST_SIDE_PX / max(frame_px))
            placement = Placement.stretched(frame_px, _reduced(frame_px, zoom))
        picture = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array(picture))
        shapes = {"boxes": ("n", 4), "labels": ("n",), "scores": ("n",), "masks": ("n", None, None, None)}
        self._model.check_outputs(outputs, shapes)
        boxes, scores = (outputs[name].astype(np.float32) for name in ("boxes", "scores"))
        labels, masks = np.nan_to_num(outputs["labels"]), outputs["masks"]
        if len(masks) and masks.shape[1:] != (1, *placement.input_px[::-1]):
            problem = f"its masks {masks.shape} do not cover its input"
            raise InputError(self._model.path, problem, "export the whole network, with its own post-processing")
        corners_px = placement.to_frame(boxes)
        instances = (
            placement.instance(masks[i, 0], corners_px[i], 0.5, float(scores[i]), self._classes[int(labels[i])])
            for i in np.argsort(-scores)
            if scores[i] >= self._min_score and int(labels[i]) in self._classes
        )
        return collect_instances(self._model.path, instances, frame_px)


def _reduced(frame_px: tuple[int, int], zoom: float) -> tuple[int, int]:
    return max(1, round(frame_px[0] * zoom)), max(1, round(frame_px[1] * zoom))
