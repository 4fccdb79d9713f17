"""YOLOX detectors, exported to ONNX: boxes without masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, names_of
from jaxfit.perception.segmentation.inputs import STRIDES, cell_count, image_input
from jaxfit.perception.segmentation.placing import Placement, suppress

__all__ = ["Detection", "Yolox"]

_FREE_INPUT_PX = (640, 640)


class Detection(NamedTuple):
    """A box in a frame."""

    box_px: Float[np.ndarray, "4"]
    """x0, y0, x1, y1, within the frame."""
    score: float
    label: str


class Yolox:
    """Boxes on three grids, not yet decoded.

    `output` (1, cells, 5 + classes), cells of strides 8, 16 and 32 one after the other, row by row:
    centre = (value + cell) · stride, size = exp(value) · stride, then the probability of an object and of each class;
    the score is their product. Input: the frame letterboxed to its upper left corner with grey 114, blue-green-red
    within [0, 255]; 640 x 640 where its size is free. Exports that decode themselves (`--decode_in_inference`) look
    the same by their shapes and are not meant here.

    Args:
        classes: names that are kept; None takes `bird`.
        min_score: least score; None takes 0.3, as YOLOX' own demo does.
        names: of its classes, where they are not COCO's.

    Raises:
        InputError: another layout, or other classes than asked for.

    Source: `demo_postprocess` of https://github.com/Megvii-BaseDetection/YOLOX (Apache-2.0).
    """

    max_iou = 0.45

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model = model
        self._input = image_input(model)
        self._size_px = self._input.size_px or _FREE_INPUT_PX
        self._min_score = 0.3 if min_score is None else min_score
        count = (model.outputs[0].shape[2] or 0) - 5
        self._chosen = choose_classes(model.path, names_of(model, names, count), classes)
        self.class_names = tuple(self._chosen.values())
        self._cells, self._strides = _grid(self._size_px)

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its shapes."""
        if len(model.inputs) != 1 or len(model.outputs) != 1:
            return False
        head, asked = model.outputs[0].shape, model.inputs[0].shape
        if len(head) != 3 or len(asked) != 4 or head[2] is None or head[2] < 6:
            return False
        height, width = asked[2:]
        return None in (head[1], height, width) or head[1] == cell_count((width or 0, height or 0))

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Detection]:
        """Boxes in a blue-green-red frame, the most trusted first."""
        placement = Placement.letterboxed((frame.shape[1], frame.shape[0]), self._size_px, centred=False)
        (head,) = self._model(self._input.array(placement.picture(frame).astype(np.float32))).values()
        rows = head[0].astype(np.float32)
        scores = rows[:, 4:5] * rows[:, 5:]
        labels = scores.argmax(1)
        scores = scores[np.arange(len(rows)), labels]
        wanted = np.isin(labels, list(self._chosen)) & (scores >= self._min_score)
        rows, scores, labels, strides = rows[wanted], scores[wanted], labels[wanted], self._strides[wanted]
        centre, half = (rows[:, :2] + self._cells[wanted]) * strides, np.exp(rows[:, 2:4]) * strides / 2
        boxes_px = placement.boxes_px(np.concatenate([centre - half, centre + half], 1))
        return [
            Detection(boxes_px[i], float(scores[i]), self._chosen[int(labels[i])])
            for i in suppress(boxes_px, scores, labels, self.max_iou)
        ]


def _grid(size_px: tuple[int, int]) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, "cells 1"]]:
    """Column and row of every cell in its grid, and its stride in pixels."""
    cells, strides = [], []
    for stride in STRIDES:
        rows, columns = np.indices((size_px[1] // stride, size_px[0] // stride)).reshape(2, -1)
        cells.append(np.stack([columns, rows], 1))
        strides.append(np.full((len(rows), 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)
