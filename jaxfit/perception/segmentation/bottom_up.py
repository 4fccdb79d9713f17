"""The built-in segmenter's layout: which pixels are bird, and where the centre of each one's bird is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.data.masks import box_of_mask
from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, names_of
from jaxfit.perception.segmentation.inputs import image_input
from jaxfit.perception.segmentation.placing import Placement

__all__ = ["BottomUp"]

LONGER_SIDE_PX = 864
"""Of the network's input, where its metadata (`longer_side`) does not say: 6.9 for 2 cm of a ledge 2.5 m wide."""
LARGEST_SIDE_PX = 8192
MULTIPLE = 32
OFFSET_UNIT_PX = 32.0
LEAST_PEAK = 0.2
"""Centres below this are noise."""
NEIGHBOURHOOD = 7
"""Side, in cells, of the square within which a centre is the highest."""
LEAST_FOREGROUND = 0.1
"""Cells below this belong to nobody; masks are cut at 0.5, between cells."""
FARTHEST_PX = 60.0
"""A cell that points to a place this far from every centre belongs to nobody, pixels of the input."""
LEAST_CELLS = 12
"""Smaller birds are specks."""


class BottomUp:
    """Cells that are bird, gathered around the centres they point to (Cheng et al. 2020, Panoptic-DeepLab).

    Outputs over cells of equal size: `foreground` (1, 1, h, w) probabilities; `centre` (1, 1, h, w), a peak of 1 for
    each bird; `offset` (1, 2, h, w), x and y from a cell to its bird's centre in units of 32 pixels. Input:
    blue-green-red within 0 and 1, sides multiples of 32; the frame in its upper left corner, black beside it.

    Args:
        classes: names that are kept; None takes the only class there is.
        min_score: least score, the centre's height times the mean foreground; None takes 0.4.
        names: of its one class, where the file does not hold it.

    Raises:
        InputError: another input, or other classes than asked for.
    """

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model = model
        self._input = image_input(model)
        told = model.metadata.get("longer_side", str(LONGER_SIDE_PX))
        if not (told.isdecimal() and 1 <= int(told) <= LARGEST_SIDE_PX):
            raise InputError(
                model.path, f"its metadata `longer_side` is {told[:40]!r}", "export it with a side in pixels"
            )
        self._longer_side_px = int(told)
        self._min_score = 0.4 if min_score is None else min_score
        found = names_of(model, names, None)
        if len(found) != 1:
            raise InputError(model.path, f"names {len(found)} classes", "give a network of one class")
        (self._label,) = choose_classes(model.path, found, classes).values()
        self.class_names = (self._label,)

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its outputs."""
        return {"foreground", "centre", "offset"} <= {port.name for port in model.outputs}

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        placement = self._place((frame.shape[1], frame.shape[0]))
        outputs = self._model(self._input.array(_picture(frame, placement)))
        foreground, centre = outputs["foreground"][0, 0], outputs["centre"][0, 0]
        cell_px = placement.input_px[0] / foreground.shape[1]
        peaks = _peaks(centre)
        owner = _owners(foreground, outputs["offset"][0] * OFFSET_UNIT_PX, peaks, cell_px)
        found = [
            instance
            for n, (row, column) in enumerate(peaks)
            if (instance := self._instance(foreground, owner == n, float(centre[row, column]), placement))
        ]
        return sorted(found, key=lambda instance: -instance.score)

    def _place(self, frame_px: tuple[int, int]) -> Placement:
        size_px = self._input.size_px
        if size_px is None:
            zoom = self._longer_side_px / max(frame_px)
            size_px = tuple(MULTIPLE * max(1, int(np.ceil(round(side * zoom) / MULTIPLE))) for side in frame_px)
            inner = tuple(max(1, round(side * zoom)) for side in frame_px)
            scale = inner[0] / frame_px[0], inner[1] / frame_px[1]
            return Placement(scale, (0.0, 0.0), (size_px[0], size_px[1]), frame_px)
        return Placement.letterboxed(frame_px, size_px, centred=False)

    def _instance(
        self, foreground: Float[np.ndarray, "h w"], mine: Bool[np.ndarray, "h w"], peak: float, placement: Placement
    ) -> Instance | None:
        sure = mine & (foreground > 0.5)
        if np.count_nonzero(sure) < LEAST_CELLS:
            return None
        score = float(np.clip(peak, 0, 1) * foreground[sure].mean())
        if score < self._min_score:
            return None
        x0, y0, width, height = cast(tuple[int, int, int, int], box_of_mask(mine))
        box = np.array([x0, y0, x0 + width, y0 + height], np.float32)
        cells = np.array(foreground.shape[::-1], np.float32)
        box_px = placement.boxes_px(box[None] * np.tile(placement.input_px / cells, 2))[0]
        return placement.instance(np.where(mine, foreground, 0), box_px, 0.5, score, self._label)


def _picture(frame: UInt8[np.ndarray, "H W 3"], placement: Placement) -> Float[np.ndarray, "h w 3"]:
    inner = [round(side * scale) for side, scale in zip(placement.frame_px, placement.scale, strict=True)]
    shrinks = inner[0] < frame.shape[1]
    small = cv2.resize(frame, inner, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    width, height = placement.input_px
    picture = np.zeros((height, width, 3), np.float32)
    picture[: inner[1], : inner[0]] = small
    return picture / 255


def _peaks(centre: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "M 2"]:
    """Rows and columns of the cells that are higher than all around them."""
    around = cv2.dilate(centre, np.ones((NEIGHBOURHOOD, NEIGHBOURHOOD), np.uint8))
    return np.argwhere((centre >= around) & (centre > LEAST_PEAK))


def _owners(
    foreground: Float[np.ndarray, "h w"],
    offset_px: Float[np.ndarray, "2 h w"],
    peaks: Int[np.ndarray, "M 2"],
    cell_px: float,
) -> Int[np.ndarray, "h w"]:
    """Which peak each cell points to, −1 for none: the nearest to where its offset leads."""
    owner = np.full(foreground.shape, -1)
    rows, columns = np.nonzero(foreground > LEAST_FOREGROUND)
    if not len(peaks) or not len(rows):
        return owner
    at = (np.stack([columns, rows], 1) + 0.5) * cell_px + offset_px[:, rows, columns].T
    distance = np.stack(list(_distances(at, (peaks[:, ::-1] + 0.5) * cell_px)))
    nearest = distance.argmin(0)
    owner[rows, columns] = np.where(distance.min(0) < FARTHEST_PX, nearest, -1)
    return owner


def _distances(at: Float[np.ndarray, "P 2"], centres: Float[np.ndarray, "M 2"]) -> Iterator[np.ndarray]:
    for x, y in centres:
        yield np.hypot(at[:, 0] - x, at[:, 1] - y)
