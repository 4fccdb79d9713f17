"""Conversion between a frame and a network's input: pictures to the input, boxes and masks to the frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.limits import DETECTIONS
from jaxfit.perception.instances import Instance, instance_of

__all__ = ["Placement", "non_maximum_suppression"]

GREY = 114  # padding of letterboxed pictures in both YOLO families


class Placement(NamedTuple):
    """Position of a frame in a network's input: input = frame · scale + offset, in pixels (x, y)."""

    scale: tuple[float, float]
    offset: tuple[float, float]
    input_px: tuple[int, int]
    """Width and height of the input."""
    frame_px: tuple[int, int]
    """Width and height of the frame."""

    @classmethod
    def stretched(cls, frame_px: tuple[int, int], input_px: tuple[int, int]) -> Placement:
        """Stretch the whole frame to the whole input; the proportions may change."""
        scale = (input_px[0] / frame_px[0], input_px[1] / frame_px[1])
        return cls(scale, (0.0, 0.0), input_px, frame_px)

    @classmethod
    def letterboxed(cls, frame_px: tuple[int, int], input_px: tuple[int, int], centred: bool) -> Placement:
        """Fit the whole frame with its proportions, in the middle of the input or in the upper left corner."""
        zoom = min(input_px[0] / frame_px[0], input_px[1] / frame_px[1])
        inner = [max(1, round(side * zoom)) for side in frame_px]
        # an odd margin is larger on the right and below
        offset = [(whole - part) // 2 if centred else 0 for whole, part in zip(input_px, inner, strict=True)]
        scale = (inner[0] / frame_px[0], inner[1] / frame_px[1])
        return cls(scale, (offset[0], offset[1]), input_px, frame_px)

    @classmethod
    def cropped(cls, frame_px: tuple[int, int], input_px: tuple[int, int], crop_px: Int[np.ndarray, "4"]) -> Placement:
        """Stretch a part of the frame (x0, y0, x1, y1 in whole pixels) to the whole input."""
        x0, y0, x1, y1 = (int(side) for side in crop_px)
        scale = (input_px[0] / (x1 - x0), input_px[1] / (y1 - y0))
        return cls(scale, (-x0 * scale[0], -y0 * scale[1]), input_px, frame_px)

    def picture(self, frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Resample the frame to the input; the margins are grey."""
        (x0, y0), (x1, y1) = (self._frame_corner((0, 0)), self._frame_corner(self.input_px))
        part = frame[y0:y1, x0:x1]
        inner = round(part.shape[1] * self.scale[0]), round(part.shape[0] * self.scale[1])
        if inner != (part.shape[1], part.shape[0]):
            part = cv2.resize(part, inner, interpolation=cv2.INTER_LINEAR)
        left, top = (max(0, round(side)) for side in self.offset)
        right, bottom = self.input_px[0] - left - inner[0], self.input_px[1] - top - inner[1]
        if not (left or top or right or bottom):
            return part
        return cv2.copyMakeBorder(part, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(GREY,) * 3)

    def _frame_corner(self, corner: tuple[int, int]) -> tuple[int, int]:
        x, y = ((c - o) / s for c, o, s in zip(corner, self.offset, self.scale, strict=True))
        return min(max(round(x), 0), self.frame_px[0]), min(max(round(y), 0), self.frame_px[1])

    def to_frame(self, corners: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
        """Convert boxes (x0, y0, x1, y1) from input pixels to frame pixels, clipped to the frame."""
        corners_px = (corners - np.tile(self.offset, 2)) / np.tile(self.scale, 2)
        return np.clip(corners_px, 0, np.tile(self.frame_px, 2)).astype(np.float32)

    def instance(
        self,
        values: Float[np.ndarray, "*C h w"],
        corners_px: Float[np.ndarray, "4"],
        threshold: float,
        score: float,
        label: str,
        coefficients: Float[np.ndarray, "C"] | None = None,
        keep: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Instance | None:
        """Create the instance in a box: interpolate a coarse map at every pixel of the box, then apply a threshold.

        Args:
            values: a map over the whole input, at any resolution; or prototypes, one map for each coefficient.
            corners_px: x0, y0, x1, y1 in the frame; the box contains the pixels whose centres lie within.
            threshold: pixels with larger values belong to the bird.
            score, label: score and class of the instance.
            coefficients: weights of the prototypes; the map is their weighted sum.
            keep: function that maps the mask within the box to the part to keep.

        Returns:
            The instance; None if no value exceeds the threshold.
        """
        if not np.isfinite(corners_px).all():
            return None
        x0, y0, x1, y1 = (int(side) for side in np.ceil(corners_px - 0.5))
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, self.frame_px[0]), min(y1, self.frame_px[1])
        if x0 >= x1 or y0 >= y1:
            return None
        columns, weights_x = self._interpolation(0, x0, x1, values.shape[-1])
        rows, weights_y = self._interpolation(1, y0, y1, values.shape[-2])
        part = values[..., rows, columns].astype(np.float32)
        if coefficients is not None:
            part = np.tensordot(coefficients.astype(np.float32), part, 1)
        mask = weights_y @ part @ weights_x.T > threshold
        return instance_of(mask if keep is None else keep(mask), score, label, x0, y0)

    def _interpolation(self, axis: int, first: int, stop: int, length: int) -> tuple[slice, Float[np.ndarray, "n m"]]:
        """Return the range of map pixels around a range of frame pixels, and the bilinear weights (frame, map)."""
        map_per_input = length / self.input_px[axis]
        centres = np.arange(first, stop) + 0.5
        at = (centres * self.scale[axis] + self.offset[axis]) * map_per_input - 0.5
        at = np.clip(at, 0, length - 1)
        low, high = int(at[0]), int(np.ceil(at[-1])) + 1
        weights = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(low, high)))
        return slice(low, high), weights.astype(np.float32)


def non_maximum_suppression(
    corners_px: Float[np.ndarray, "N 4"], scores: Float[np.ndarray, "N"], labels: Int[np.ndarray, "N"], max_iou: float
) -> Int[np.ndarray, "M"]:
    """Return the detections without a better detection of the same class above an IoU of `max_iou`, best first.

    Args:
        corners_px: boxes x0, y0, x1, y1; 0 or more.
        scores: score of each box.
        labels: class of each box.
        max_iou: largest IoU between two boxes of one class.
    """
    if not len(corners_px):
        return np.zeros(0, int)
    if len(corners_px) > DETECTIONS:  # the time is quadratic
        best = np.argsort(-scores, kind="stable")[:DETECTIONS]
        return best[non_maximum_suppression(corners_px[best], scores[best], labels[best], max_iou)]
    xywh = np.concatenate([corners_px[:, :2], corners_px[:, 2:] - corners_px[:, :2]], 1)
    kept = cv2.dnn.NMSBoxesBatched(xywh.tolist(), scores.tolist(), labels.tolist(), 0.0, max_iou)
    return np.asarray(kept, int).reshape(-1)
