"""Ultralytics' segmentation networks (YOLOv8, 11, 26 and similar), exported to ONNX."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance, collect_instances
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import names_of
from jaxfit.perception.segmentation.inputs import cell_count, literal_metadata
from jaxfit.perception.segmentation.network import SegmentationNetwork
from jaxfit.perception.segmentation.placement import Placement, non_maximum_suppression

__all__ = ["YoloSeg"]

MAX_FINAL_ROWS = 1000  # an end-to-end head has at most 300 rows; a head with thousands of rows is raw
_DEFAULT_INPUT_PX = (640, 640)


class YoloSeg(SegmentationNetwork):
    """Boxes with 32 coefficients each, and 32 prototype masks; a mask is the weighted sum of the prototypes.

    Two heads are supported. A raw head, `output0` (1, 4 + classes + 32, anchors), contains centre, size, a probability
    for each class, and coefficients; it needs non-maximum suppression within each class. A final head, `output0`
    (1, rows, 6 + 32), contains corners, score, class and coefficients; it needs no suppression. Boxes are in pixels of
    the input. `output1` (1, 32, h, w) covers the input at a quarter of its resolution. Input: the frame letterboxed in
    the middle with grey 114, red-green-blue within [0, 1]. A variable size is the metadata's `imgsz`, or 640 x 640.

    Masks are interpolated to the pixels of the frame and then cut to the box, as in Ultralytics'
    `process_mask_native`; the opposite order gives coarser edges.

    Source: the layout of https://docs.ultralytics.com/tasks/segment/ and /guides/end2end-detection/.
    """

    layout = "outputs (1, 4 + classes + 32, anchors) or (1, rows, 6 + 32), and (1, 32, h, w)"
    default_min_score = 0.25  # as in Ultralytics
    max_iou = 0.7

    def _set_up(self) -> None:
        self._is_final = _is_final(self._model)
        self._size_px = self._input.size_px or _variable_size_px(self._model)
        head, protos = self._model.outputs
        channels = (1, None, head.shape[2]) if self._is_final else (1, head.shape[1], None)
        self._shapes = {head.name: channels, protos.name: (1, protos.shape[1], "h", "w")}

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        head, protos = (port.shape for port in self._model.outputs)
        return names_of(self._model, names, None if _is_final(self._model) else (head[1] or 0) - 4 - (protos[1] or 0))

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        if len(model.outputs) != 2 or len(model.inputs) != 1:
            return False
        head, protos = (port.shape for port in model.outputs)
        if len(head) != 3 or len(protos) != 4 or protos[1] is None:
            return False
        height, width = model.inputs[0].shape[-2:]
        # the raw head of YOLOv5 has another order of axes: (1, anchors, 5 + classes + 32)
        anchors = cell_count((width or 0, height or 0))
        raw = head[1] is not None and head[1] > 4 + protos[1] and (head[2] is None or head[2] >= anchors)
        return raw or _is_final(model)

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        placement = Placement.letterboxed((frame.shape[1], frame.shape[0]), self._size_px, centred=True)
        picture = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array(picture))
        self._model.check_outputs(outputs, self._shapes)
        head, protos = (output[0] for output in outputs.values())
        boxes, scores, labels, coefficients = self._decode(head.astype(np.float32), len(protos))
        is_kept = np.isin(labels, list(self._classes)) & (scores >= self._min_score) & np.isfinite(boxes).all(1)
        corners_px = placement.to_frame(boxes[is_kept])
        scores, labels, coefficients = scores[is_kept], labels[is_kept], coefficients[is_kept]
        if self._is_final:
            order = np.argsort(-scores)
        else:
            order = non_maximum_suppression(corners_px, scores, labels, self.max_iou)
        instances = (
            # a probability is above 1/2 where the weighted sum of prototypes is above 0
            placement.instance(
                protos, corners_px[i], 0.0, float(scores[i]), self._classes[int(labels[i])], coefficients[i]
            )
            for i in order
        )
        return collect_instances(self._model.path, instances, placement.frame_px)

    def _decode(
        self, head: Float[np.ndarray, "R C"], prototypes: int
    ) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N"], Int[np.ndarray, "N"], Float[np.ndarray, "N P"]]:
        """Return corners in pixels of the input, scores, classes and coefficients of all rows."""
        if self._is_final:
            return head[:, :4], head[:, 4], np.nan_to_num(head[:, 5]).astype(int), head[:, 6:]
        rows = head.T
        centre, half, scores = rows[:, :2], rows[:, 2:4] / 2, rows[:, 4:-prototypes]
        labels = scores.argmax(1)
        boxes = np.concatenate([centre - half, centre + half], 1)
        return boxes, scores[np.arange(len(rows)), labels], labels, rows[:, -prototypes:]


def _is_final(model: OnnxModel) -> bool:
    head, protos = (port.shape for port in model.outputs)
    has_few_rows = head[1] is None or head[1] <= MAX_FINAL_ROWS
    return has_few_rows and head[2] is not None and protos[1] is not None and head[2] == 6 + protos[1]


def _variable_size_px(model: OnnxModel) -> tuple[int, int]:
    """Return width and height for an input of variable size: the size of the export, or the default."""
    size = literal_metadata(model, "imgsz")
    if size is None:
        return _DEFAULT_INPUT_PX
    sides = [size, size] if isinstance(size, int) else size
    if not (isinstance(sides, (list, tuple)) and len(sides) == 2 and all(type(side) is int for side in sides)):
        problem = f"its metadata `imgsz` is {size!r:.80}"
        raise InputError(model.path, problem, "export it with height and width")
    model.check_input((1, 3, *sides))
    return sides[1], sides[0]
