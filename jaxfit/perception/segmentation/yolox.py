"""YOLOX detectors, exported to ONNX: boxes without masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import names_of
from jaxfit.perception.segmentation.inputs import STRIDES, cell_count
from jaxfit.perception.segmentation.network import SegmentationNetwork
from jaxfit.perception.segmentation.placement import Placement, non_maximum_suppression

__all__ = ["Detection", "Yolox"]

_DEFAULT_INPUT_PX = (640, 640)
_LARGEST_VALUE = 80.0  # the exponential of larger values is not finite


class Detection(NamedTuple):
    """A box in a frame."""

    corners_px: Float[np.ndarray, "4"]
    """x0, y0, x1, y1, within the frame."""
    score: float
    label: str


class Yolox(SegmentationNetwork):
    """Boxes on three grids, in the encoding of the network.

    `output` (1, cells, 5 + classes) contains the cells of strides 8, 16 and 32 one after the other, row by row:
    centre = (value + cell) · stride, size = exp(value) · stride, then the probability of an object and of each class.
    The score is the product of both probabilities. Input: the frame letterboxed in the upper left corner with grey 114,
    blue-green-red within [0, 255]; 640 x 640 for a variable size. Exports that decode the boxes
    (`--decode_in_inference`) have the same shapes, but are not supported.

    Source: `demo_postprocess` of https://github.com/Megvii-BaseDetection/YOLOX (Apache-2.0).
    """

    layout = "one output (1, cells of strides 8, 16, 32, 5 + classes)"
    default_min_score = 0.3  # as in YOLOX' demo
    max_iou = 0.45

    def _set_up(self) -> None:
        self._size_px = self._input.size_px or _DEFAULT_INPUT_PX
        self._cells, self._strides = _grid(self._size_px)

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        return names_of(self._model, names, (self._model.outputs[0].shape[2] or 0) - 5)

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the shapes of a network have this layout."""
        if len(model.inputs) != 1 or len(model.outputs) != 1:
            return False
        head, expected = model.outputs[0].shape, model.inputs[0].shape
        if len(head) != 3 or len(expected) != 4 or head[2] is None or head[2] < 6:
            return False
        height, width = expected[2:]
        return None in (head[1], height, width) or head[1] == cell_count((width or 0, height or 0))

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Detection]:
        """Detect boxes in a blue-green-red frame; return them by falling score."""
        placement = Placement.letterboxed((frame.shape[1], frame.shape[0]), self._size_px, centred=False)
        outputs = self._model(self._input.array(placement.picture(frame).astype(np.float32)))
        port = self._model.outputs[0]
        self._model.check_outputs(outputs, {port.name: (1, len(self._cells), port.shape[2])})
        (head,) = outputs.values()
        rows = head[0].astype(np.float32)
        scores = rows[:, 4:5] * rows[:, 5:]
        labels = scores.argmax(1)
        scores = scores[np.arange(len(rows)), labels]
        is_kept = np.isin(labels, list(self._classes)) & (scores >= self._min_score)
        is_kept &= np.isfinite(rows[:, :4]).all(1) & (rows[:, 2:4] < _LARGEST_VALUE).all(1)
        rows, scores, labels, strides = rows[is_kept], scores[is_kept], labels[is_kept], self._strides[is_kept]
        centre, half = (rows[:, :2] + self._cells[is_kept]) * strides, np.exp(rows[:, 2:4]) * strides / 2
        corners_px = placement.to_frame(np.concatenate([centre - half, centre + half], 1))
        return [
            Detection(corners_px[i], float(scores[i]), self._classes[int(labels[i])])
            for i in non_maximum_suppression(corners_px, scores, labels, self.max_iou)
        ]


def _grid(size_px: tuple[int, int]) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, "cells 1"]]:
    """Return column and row of every cell in its grid, and its stride in pixels."""
    cells, strides = [], []
    for stride in STRIDES:
        rows, columns = np.indices((size_px[1] // stride, size_px[0] // stride)).reshape(2, -1)
        cells.append(np.stack([columns, rows], 1))
        strides.append(np.full((len(rows), 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)
