"""Bottom-up segmentation, the layout of the built-in segmenter: foreground, centres, and offsets to the centres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.data.masks import box_of_mask
from jaxfit.errors import InputError
from jaxfit.limits import INSTANCES
from jaxfit.perception.activations import activation_monitor
from jaxfit.perception.instances import Instance, collect_instances
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.large_birds import length_px, replace_parts
from jaxfit.perception.segmentation.network import SegmentationNetwork
from jaxfit.perception.segmentation.placement import Placement

__all__ = ["BottomUp"]

LONGER_SIDE_PX = 864
"""Default of the metadata `longer_side`, the longer side of the input: 6.9 pixels for 2 cm of a ledge 2.5 m wide."""
LARGEST_SIDE_PX = 8192
MULTIPLE = 32
OFFSET_UNIT_PX = 32.0
MIN_PEAK = 0.2
"""Lower peaks of the centre map are noise."""
PEAK_WINDOW = 7
"""Side, in cells, of the square in which a peak must be the maximum."""
MIN_FOREGROUND = 0.1
"""Cells with a lower foreground belong to no bird. Masks are cut at 0.5, between cells."""
MAX_DISTANCE_PX = 60.0
"""Cells whose offset ends at least this far from every centre belong to no bird; pixels of the input."""
LARGE_BIRD_PX = 200.0
"""Birds that are longer in the input are detected in parts, so an input of half the size detects them."""
SMALLER_INPUTS = 2
"""Number of smaller inputs: half and a quarter of the size."""
MOST_PEAKS = 10 * INSTANCES
"""More peaks are the output of a network that was not trained."""
MIN_CELLS = 12
"""Instances with fewer cells are dropped."""


class BottomUp(SegmentationNetwork):
    """Instances as groups of foreground cells whose offsets point to the same centre (Cheng et al. 2020).

    Outputs over cells of equal size: `foreground` (1, 1, h, w), probabilities; `centre` (1, 1, h, w), with a peak of 1
    for each bird; `offset` (1, 2, h, w), x and y from a cell to the centre of its bird in units of 32 pixels. Input:
    blue-green-red within 0 and 1, sides multiples of 32; the frame in the upper left corner, the rest black. The score
    is the peak of the centre times the mean foreground.

    Where the input has a variable size, birds that are long in the input are detected in smaller inputs.

    Raises:
        InputError: an unsupported input, more than one class, or an invalid `longer_side` or `min_track_score` in the
            metadata.

    Source: Cheng et al. 2020, Panoptic-DeepLab.
    """

    layout = "outputs foreground, centre, offset"
    default_min_score = 0.4

    def _set_up(self) -> None:
        (self._label,) = self.class_names
        text = self._model.metadata.get("longer_side", str(LONGER_SIDE_PX))
        if not (
            text.isdecimal() and len(text) <= 5 and 1 <= int(text) <= LARGEST_SIDE_PX and int(text) % MULTIPLE == 0
        ):
            remedy = f"export it with a multiple of {MULTIPLE} pixels, at most {LARGEST_SIDE_PX}"
            raise InputError(self._model.path, f"its metadata `longer_side` is {text[:40]!r}", remedy)
        self._longer_side_px = int(text)
        self.min_track_score = self._min_track_score()
        self.activations = activation_monitor(self._model)

    def _min_track_score(self) -> float:
        """Return the least mean score of a track, 0 if the file does not contain it."""
        text = self._model.metadata.get("min_track_score", "0")
        try:
            score = float(text)
        except ValueError:
            score = float("nan")
        if not 0 <= score <= 1:
            problem = f"its metadata `min_track_score` is {text[:40]!r}"
            raise InputError(self._model.path, problem, "export it with a number within 0 and 1")
        return score

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        names_by_index = super()._all_classes(names)
        if len(names_by_index) != 1:
            raise InputError(self._model.path, f"names {len(names_by_index)} classes", "give a network of one class")
        return names_by_index

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        return {"foreground", "centre", "offset"} <= {port.name for port in model.outputs}

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        array, placement = self.network_input(frame)
        outputs = self._model(array)
        found = self._instances(outputs, placement)
        if self.activations is not None:
            self.activations.add(outputs, 1)
        if self._input.size_px is None:
            found = self._with_large_birds(frame, found)
        return sorted(found, key=lambda instance: -instance.score)

    def _with_large_birds(self, frame: UInt8[np.ndarray, "H W 3"], found: list[Instance]) -> list[Instance]:
        """Replace the parts of large birds; a smaller input is used only if a detection could be half a large bird."""
        least_px = LARGE_BIRD_PX * max(frame.shape[:2]) / self._longer_side_px
        for n in range(1, SMALLER_INPUTS + 1):
            if not any(2 * length_px(bird) >= least_px for bird in found):
                break
            array, placement = self.network_input(frame, self._longer_side_px / 2**n)
            found = replace_parts(found, self._instances(self._model(array), placement), least_px)
            least_px *= 2
        return found

    def _instances(self, outputs: dict[str, np.ndarray], placement: Placement) -> list[Instance]:
        """Return the instances of the outputs of the network."""
        shape = (1, 1, "h", "w")
        self._model.check_outputs(outputs, {"foreground": shape, "centre": shape, "offset": (1, 2, "h", "w")})
        foreground, centre = (outputs[name][0, 0].astype(np.float32, copy=False) for name in ("foreground", "centre"))
        cell_px = placement.input_px[0] / foreground.shape[1]
        peaks = _find_peaks(centre)
        if len(peaks) > MOST_PEAKS:
            problem = f"gives {len(peaks)} centres of birds in one frame"
            raise InputError(self._model.path, problem, "give another network")
        assignment = _assign_cells(foreground, outputs["offset"][0] * OFFSET_UNIT_PX, peaks, cell_px)
        instances = (
            self._instance(foreground, assignment == n, float(centre[row, column]), placement)
            for n, (row, column) in enumerate(peaks)
        )
        return collect_instances(self._model.path, instances, placement.frame_px)

    def network_input(
        self, frame: UInt8[np.ndarray, "H W 3"], longer_side_px: float | None = None
    ) -> tuple[Float[np.ndarray, "1 3 h w"], Placement]:
        """Return the input of the network for a frame, and the place of the frame in the input.

        Args:
            frame: blue, green, red.
            longer_side_px: longer side of an input of variable size; None for the size of the metadata.
        """
        frame_px = frame.shape[1], frame.shape[0]
        input_px = self._input_px(frame_px, longer_side_px or self._longer_side_px)
        placement = Placement.letterboxed(frame_px, input_px, centred=False)
        return self._input.array(_network_picture(frame, placement)), placement

    def _input_px(self, frame_px: tuple[int, int], longer_side_px: float) -> tuple[int, int]:
        """Return width and height of the input; a variable size has the frame's proportions, in multiples of 32."""
        if self._input.size_px is not None:
            return self._input.size_px
        zoom = longer_side_px / max(frame_px)
        width, height = (MULTIPLE * max(1, int(np.ceil(round(side * zoom) / MULTIPLE))) for side in frame_px)
        return width, height

    def _instance(
        self, foreground: Float[np.ndarray, "h w"], own: Bool[np.ndarray, "h w"], peak: float, placement: Placement
    ) -> Instance | None:
        """Create the instance of the cells `own`; None if it is too small or its score too low."""
        certain = own & (foreground > 0.5)
        if np.count_nonzero(certain) < MIN_CELLS:
            return None
        score = float(np.clip(peak, 0, 1) * foreground[certain].mean())
        if score < self._min_score:
            return None
        x0, y0, width, height = cast(tuple[int, int, int, int], box_of_mask(own))
        corners = np.array([x0, y0, x0 + width, y0 + height], np.float32)
        cells = np.array(foreground.shape[::-1], np.float32)
        corners_px = placement.to_frame(corners[None] * np.tile(placement.input_px / cells, 2))[0]
        return placement.instance(np.where(own, foreground, 0), corners_px, 0.5, score, self._label)


def _network_picture(frame: UInt8[np.ndarray, "H W 3"], placement: Placement) -> Float[np.ndarray, "h w 3"]:
    """Resize the frame into the upper left corner of a black picture within 0 and 1."""
    inner = [round(side * scale) for side, scale in zip(placement.frame_px, placement.scale, strict=True)]
    is_reduction = inner[0] < frame.shape[1]
    resized = cv2.resize(frame, inner, interpolation=cv2.INTER_AREA if is_reduction else cv2.INTER_LINEAR)
    width, height = placement.input_px
    picture = np.zeros((height, width, 3), np.float32)
    picture[: inner[1], : inner[0]] = resized
    return picture / 255


def _find_peaks(centre: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "M 2"]:
    """Return rows and columns of the local maxima."""
    maximum = cv2.dilate(centre, np.ones((PEAK_WINDOW, PEAK_WINDOW), np.uint8))
    return np.argwhere((centre >= maximum) & (centre > MIN_PEAK))


def _assign_cells(
    foreground: Float[np.ndarray, "h w"],
    offset_px: Float[np.ndarray, "2 h w"],
    peaks: Int[np.ndarray, "M 2"],
    cell_px: float,
) -> Int[np.ndarray, "h w"]:
    """Assign each cell to the peak nearest to the end of its offset; −1 for no peak."""
    assignment = np.full(foreground.shape, -1)
    rows, columns = np.nonzero(foreground > MIN_FOREGROUND)
    if not len(peaks) or not len(rows):
        return assignment
    ends = (np.stack([columns, rows], 1) + 0.5) * cell_px + offset_px[:, rows, columns].T
    nearest, best = np.full(len(rows), -1), np.full(len(rows), MAX_DISTANCE_PX)
    for n, (x, y) in enumerate((peaks[:, ::-1] + 0.5) * cell_px):
        distance = np.hypot(ends[:, 0] - x, ends[:, 1] - y)
        is_nearer = distance < best
        nearest[is_nearer], best[is_nearer] = n, distance[is_nearer]
    assignment[rows, columns] = nearest
    return assignment
