"""Layouts of other projects' networks: YOLO, YOLOX, RF-DETR, Mask R-CNN."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import Instance, OnnxModel, normalise
from jaxfit.perception.segmentation_inputs import (
    GREY,
    STRIDES,
    Placement,
    SegmentationNetwork,
    cell_count,
    coco_by_category,
    literal_metadata,
    names_of,
    non_maximum_suppression,
)

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
        return [instance for instance in instances if instance is not None]

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
    if not (
        isinstance(sides, (list, tuple)) and len(sides) == 2 and all(type(side) is int and side > 0 for side in sides)
    ):
        problem = f"its metadata `imgsz` is {size!r:.80}"
        raise InputError(model.path, problem, "export it with height and width")
    return sides[1], sides[0]


_LARGEST_VALUE = 80.0  # the exponential of larger values is not finite


class Detection(NamedTuple):
    """A box in a frame."""

    corners_px: Float[np.ndarray, "4"]
    """x0, y0, x1, y1, within the frame."""
    score: float
    label: str


class View(NamedTuple):
    """A way to show a picture to a detector, which knows upright birds of some sizes best."""

    zoom: float = 1.0
    """At most 1: a smaller picture, in the upper left corner."""
    turns: int = 0
    """Quarter turns against the clock."""
    mirrored: bool = False

    def of(self, picture: UInt8[np.ndarray, "s t 3"]) -> UInt8[np.ndarray, "s2 t2 3"]:
        """Return the input of a detector in this view."""
        if self.zoom != 1:
            small = cv2.resize(picture, None, fx=self.zoom, fy=self.zoom, interpolation=cv2.INTER_AREA)
            picture = np.full_like(picture, GREY)
            picture[: small.shape[0], : small.shape[1]] = small
        picture = np.rot90(picture, self.turns)
        return picture[:, ::-1] if self.mirrored else picture

    def back(self, corners: Float[np.ndarray, "N 4"], side_px: int) -> Float[np.ndarray, "N 4"]:
        """Return the boxes of the original input, which is a square if the view has turns."""
        x0, y0, x1, y1 = corners.T
        if self.mirrored:
            x0, x1 = side_px - x1, side_px - x0
        for _ in range(self.turns):
            x0, y0, x1, y1 = side_px - y1, x0, side_px - y0, x1
        return np.stack([x0, y0, x1, y1], 1) / self.zoom


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
        self.is_square = self._size_px[0] == self._size_px[1]

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

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"], *views: View) -> list[Detection]:
        """Detect boxes in the views of a blue-green-red frame (by default as it is); return them by falling score."""
        placement = Placement.letterboxed((frame.shape[1], frame.shape[0]), self._size_px, centred=False)
        picture = placement.picture(frame)
        found = [self._boxes(picture, view, placement) for view in views or (View(),)]
        corners_px, scores, labels = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return [
            Detection(corners_px[i], float(scores[i]), self._classes[int(labels[i])])
            for i in non_maximum_suppression(corners_px, scores, labels, self.max_iou)
        ]

    def _boxes(
        self, picture: UInt8[np.ndarray, "s t 3"], view: View, placement: Placement
    ) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Return corners in the frame, scores and classes of the boxes in a view, with duplicates."""
        outputs = self._model(self._input.array(view.of(picture).astype(np.float32)))
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
        corners = view.back(np.concatenate([centre - half, centre + half], 1), self._size_px[0])
        return placement.to_frame(corners), scores, labels


def _grid(size_px: tuple[int, int]) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, "cells 1"]]:
    """Return column and row of every cell in its grid, and its stride in pixels."""
    cells, strides = [], []
    for stride in STRIDES:
        rows, columns = np.indices((size_px[1] // stride, size_px[0] // stride)).reshape(2, -1)
        cells.append(np.stack([columns, rows], 1))
        strides.append(np.full((len(rows), 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)


class RfDetrSeg(SegmentationNetwork):
    """Queries with a box, class logits and a mask each; suppression of duplicates is not necessary.

    Outputs: `dets` (1, queries, 4), centre and size as shares of the picture; `labels` (1, queries, slots), one logit
    per slot, with a sigmoid; `masks` (1, queries, h, w), logits over the whole picture at a quarter of its resolution.
    Input: the frame stretched to the input, red-green-blue, normalised with ImageNet's mean and standard deviation.

    Newer exports name the slots in their metadata (`rfdetr_inference`). Otherwise 91 slots are COCO's category numbers,
    with an unused slot 0. With any other number of slots, the last slot is "no object".

    Raises:
        InputError: an input of variable size, an unsupported layout, or unknown classes.

    Source: `PostProcess` and the export of https://github.com/roboflow/rf-detr (Apache-2.0).
    """

    layout = "outputs dets (1, queries, 4), labels (1, queries, slots), masks (1, queries, h, w)"
    default_min_score = 0.5  # as in RF-DETR

    def _set_up(self) -> None:
        if self._input.size_px is None:
            raise InputError(self._model.path, "has an input of variable size", "export it with a fixed size")
        self._size_px = self._input.size_px
        self._slots = _slots(self._model)

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        shapes = {port.name: port.shape for port in model.outputs}
        if set(shapes) != {"dets", "labels", "masks"}:
            return False
        ranks = [len(shapes[name]) for name in ("dets", "labels", "masks")]
        # exports of mmdeploy have the same names, but boxes with five columns and labels without slots
        return ranks == [3, 3, 4] and shapes["dets"][2] == 4 and shapes["labels"][2] is not None

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        placement = Placement.stretched((frame.shape[1], frame.shape[0]), self._size_px)
        rgb = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array(normalise(rgb)))
        head = {"dets": (1, "queries", 4), "labels": (1, "queries", self._slots)}
        self._model.check_outputs(outputs, head | {"masks": (1, "queries", "h", "w")})
        dets, logits = (outputs[name][0].astype(np.float32) for name in ("dets", "labels"))
        slots = np.array(list(self._classes))
        scores = 1 / (1 + np.exp(-np.clip(logits[:, slots], -80, 80)))
        best = scores.argmax(1)
        scores = scores[np.arange(len(scores)), best]
        centre, half = dets[:, :2], dets[:, 2:] / 2
        corners_px = placement.to_frame(np.concatenate([centre - half, centre + half], 1) * np.tile(self._size_px, 2))
        instances = (
            placement.instance(
                outputs["masks"][0, i], corners_px[i], 0.0, float(scores[i]), self._classes[int(slots[best[i]])]
            )
            for i in np.argsort(-scores)
            if scores[i] >= self._min_score
        )
        return [instance for instance in instances if instance is not None]

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        """Return slot → name of every slot that is a class."""
        model = self._model
        count = _slots(model)
        if names is None and "rfdetr_inference" in model.metadata:
            try:
                named = json.loads(model.metadata["rfdetr_inference"])["class_id_to_name"]
                return {int(slot): str(name) for slot, name in named.items() if 0 <= int(slot) < count}
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                problem = "metadata `rfdetr_inference` names no classes"
                raise InputError(model.path, problem, "give the names of its classes") from error
        if names is None and count == 91:
            return coco_by_category()
        return names_of(model, names, count - 1)


def _slots(model: OnnxModel) -> int:
    return next(port.shape[2] for port in model.outputs if port.name == "labels") or 0


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
        return [instance for instance in instances if instance is not None]


def _reduced(frame_px: tuple[int, int], zoom: float) -> tuple[int, int]:
    return max(1, round(frame_px[0] * zoom)), max(1, round(frame_px[1] * zoom))
