"""Ultralytics' segmentation networks (YOLOv8, 11, 26 and their like), exported to ONNX."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.perception.instances import Instance
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, names_of
from jaxfit.perception.segmentation.inputs import cell_count, image_input, literal_metadata
from jaxfit.perception.segmentation.placing import Placement, suppress

__all__ = ["YoloSeg"]

MOST_FINAL_ROWS = 1000  # an end-to-end head lists 300 at most; thousands of rows are a raw head of another kind
_FREE_INPUT_PX = (640, 640)


class YoloSeg:
    """Boxes with 32 coefficients each, and as many prototype masks that they weigh.

    Two heads: raw (`output0` (1, 4 + classes + 32, anchors): centre, size, a probability for each class,
    coefficients), which needs suppression within each class; and final (`output0` (1, rows, 6 + 32): corners, score,
    class, coefficients) of networks that need none or have it built in. Boxes are in pixels of the input;
    `output1` (1, 32, h, w) covers it at a quarter of its resolution. Input: the frame letterboxed in its middle with
    grey 114, red-green-blue within [0, 1]; where its size is free, the metadata's `imgsz`, else 640 x 640.

    Masks are read as Ultralytics' `process_mask_native` does: interpolated to the frame's own pixels first and cut
    to the box then, which keeps edges finer than the other way round.

    Args:
        classes: names that are kept; None takes `bird`.
        min_score: least score; None takes 0.25, as Ultralytics does.
        names: of its classes, where the file does not hold them.

    Raises:
        InputError: another layout than these, or other classes than asked for.

    Source: the layout of https://docs.ultralytics.com/tasks/segment/ and /guides/end2end-detection/.
    """

    max_iou = 0.7

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model = model
        self._input = image_input(model)
        self._size_px = self._input.size_px or _size_px(model)
        self._min_score = 0.25 if min_score is None else min_score
        head, protos = (port.shape for port in model.outputs)
        self._final = _is_final(model)
        count = None if self._final else (head[1] or 0) - 4 - (protos[1] or 0)
        self._chosen = choose_classes(model.path, names_of(model, names, count), classes)
        self.class_names = tuple(self._chosen.values())

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its outputs."""
        if len(model.outputs) != 2 or len(model.inputs) != 1:
            return False
        head, protos = (port.shape for port in model.outputs)
        if len(head) != 3 or len(protos) != 4 or protos[1] is None:
            return False
        height, width = model.inputs[0].shape[-2:]
        # YOLOv5's raw head is the other way round: (1, anchors, 5 + classes + 32)
        anchors = cell_count((width or 0, height or 0))
        raw = head[1] is not None and head[1] > 4 + protos[1] and (head[2] is None or head[2] >= anchors)
        return raw or _is_final(model)

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        placement = Placement.letterboxed((frame.shape[1], frame.shape[0]), self._size_px, centred=True)
        picture = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        head, protos = (output[0] for output in self._model(self._input.array(picture)).values())
        boxes, scores, labels, coefficients = self._decode(head.astype(np.float32), len(protos))
        wanted = np.isin(labels, list(self._chosen)) & (scores >= self._min_score)
        boxes_px = placement.boxes_px(boxes[wanted])
        scores, labels, coefficients = scores[wanted], labels[wanted], coefficients[wanted]
        order = np.argsort(-scores) if self._final else suppress(boxes_px, scores, labels, self.max_iou)
        found = (
            # the sigmoid of these sums is above a half where they are above 0
            placement.instance(
                protos, boxes_px[i], 0.0, float(scores[i]), self._chosen[int(labels[i])], coefficients[i]
            )
            for i in order
        )
        return [instance for instance in found if instance is not None]

    def _decode(
        self, head: Float[np.ndarray, "R C"], prototypes: int
    ) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N"], Int[np.ndarray, "N"], Float[np.ndarray, "N P"]]:
        """Corners in pixels of the input, scores, classes and coefficients of all rows."""
        if self._final:
            return head[:, :4], head[:, 4], head[:, 5].astype(int), head[:, 6:]
        rows = head.T
        centre, half, scores = rows[:, :2], rows[:, 2:4] / 2, rows[:, 4:-prototypes]
        labels = scores.argmax(1)
        boxes = np.concatenate([centre - half, centre + half], 1)
        return boxes, scores[np.arange(len(rows)), labels], labels, rows[:, -prototypes:]


def _is_final(model: OnnxModel) -> bool:
    head, protos = (port.shape for port in model.outputs)
    few = head[1] is None or head[1] <= MOST_FINAL_ROWS
    return few and head[2] is not None and protos[1] is not None and head[2] == 6 + protos[1]


def _size_px(model: OnnxModel) -> tuple[int, int]:
    """Width and height for an input of free size: what the network was exported for."""
    size = literal_metadata(model, "imgsz")
    if size is None:
        return _FREE_INPUT_PX
    height, width = (size, size) if isinstance(size, int) else size
    return int(width), int(height)
