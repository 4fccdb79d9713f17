"""What segmentation networks share: input size, classes, placement of pictures, boxes and masks."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import Instance, OnnxModel, instance_of

STRIDES = (8, 16, 32)
"""Cell sizes of the grids of both YOLO families, pixels of the input."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class ImageInput(NamedTuple):
    """The picture that a network expects."""

    size_px: tuple[int, int] | None
    """Width and height; None for a variable size."""
    dtype: type
    batched: bool

    def array(self, picture: Float[np.ndarray, "h w 3"]) -> np.ndarray:
        """Convert a picture with the final scale and order of colours to the input array, with the channels first."""
        chw = np.ascontiguousarray(picture.transpose(2, 0, 1), self.dtype)
        return chw[None] if self.batched else chw


def image_input(model: OnnxModel, unbatched: bool = False) -> ImageInput:
    """Read the expected picture from the network's declaration of its input.

    Args:
        model: the network.
        unbatched: whether an input without a batch axis (3, h, w) is allowed.

    Raises:
        InputError: several inputs, a wrong number of channels or axes, a batch above 1, one fixed and one variable
            side, or a type other than floats.
    """
    if len(model.inputs) != 1:
        problem = f"has {len(model.inputs)} inputs: {model.describe()}"
        raise InputError(model.path, problem, "give a network with one input")
    port = model.inputs[0]
    axes = port.shape
    has_axes = (len(axes) == 4 and axes[0] in (1, None)) or (unbatched and len(axes) == 3)
    if not (has_axes and axes[-3] in (3, None) and (axes[-2] is None) == (axes[-1] is None) and port.kind in _TYPES):
        remedy = "export it as (1, 3, height, width) of floats, with both sides fixed or both variable"
        raise InputError(model.path, f"its input {port} of {port.kind} is not supported", remedy)
    height, width = axes[-2:]
    size = None if height is None or width is None else (width, height)
    return ImageInput(size, _TYPES[port.kind], len(axes) == 4)


def cell_count(size_px: tuple[int, int]) -> int:
    """Return the number of cells of all grids over an input of the given width and height."""
    return sum((size_px[0] // stride) * (size_px[1] // stride) for stride in STRIDES)


def literal_metadata(model: OnnxModel, key: str) -> Any:
    """Read a Python literal from the file's metadata; None if the key is absent.

    Raises:
        InputError: the text is not a literal.
    """
    if key not in model.metadata:
        return None
    text = model.metadata[key]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        raise InputError(model.path, f"metadata `{key}` cannot be read: {text[:80]!r}", "export it again") from error


_NAMES = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,"
    "bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,"
    "skis,snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,"
    "cup,fork,knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,"
    "refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush"
)
COCO = tuple(_NAMES.split(","))
"""The 80 classes of COCO, in the order of networks with consecutive class numbers."""
_UNUSED_CATEGORIES = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def coco_by_category() -> dict[int, str]:
    """Return COCO's category numbers (1 to 90 with gaps) → names, as in torchvision and RF-DETR."""
    numbers = (number for number in range(1, 91) if number not in _UNUSED_CATEGORIES)
    return dict(zip(numbers, COCO, strict=True))


def names_of(model: OnnxModel, names: Sequence[str] | None, count: int | None) -> dict[int, str]:
    """Return index → name of the classes of a network that numbers its classes from 0.

    The given names have priority over the file's metadata (`names`, a Python literal, as Ultralytics writes it), and
    the metadata over COCO's names. A network without names whose number of classes is not COCO's has the names
    `class_0`, `class_1` and so on.

    Args:
        model: the network.
        names: names in the order of the classes; None uses the file's names.
        count: number of classes; None if the shapes of the network do not contain it.

    Raises:
        InputError: the numbers of names and classes differ, the metadata cannot be read.
    """
    own = literal_metadata(model, "names") if names is None else list(names)
    if own is None:
        own = COCO if count in (None, len(COCO)) else [f"class_{i}" for i in range(count or 0)]
    try:
        by_index = {int(i): str(name) for i, name in (own.items() if isinstance(own, dict) else enumerate(own))}
    except (ValueError, TypeError, OverflowError) as error:
        problem = f"metadata `names` is not a list of classes: {own!r:.80}"
        raise InputError(model.path, problem, "give the names of its classes") from error
    if sorted(by_index) != list(range(len(by_index) if count is None else count)):
        problem = f"has {count} classes, but its names are {', '.join(by_index.values())}"
        raise InputError(model.path, problem, "give one name for each class, in the order of the classes")
    return by_index


def choose_classes(source: object, names: Mapping[int, str], chosen: Sequence[str] | None) -> dict[int, str]:
    """Return index → name of the classes to keep.

    Args:
        source: the file, for messages.
        names: index → name of every class.
        chosen: names of the classes to keep; None keeps `bird`, or the only class.

    Raises:
        InputError: the network lacks a chosen class, or has several classes without `bird` and `chosen` is None.
    """
    if not names:
        raise InputError(source, "has no classes", "give the names of its classes")
    listing = f"its classes are {', '.join(names.values())}"
    if chosen is None:
        if "bird" not in names.values() and len(names) > 1:
            raise InputError(source, f"has no class called bird; {listing}", "choose the classes that are birds")
        return {i: name for i, name in names.items() if name == "bird"} or dict(names)
    missing = [name for name in chosen if name not in names.values()]
    if missing or not chosen:
        raise InputError(source, f"lacks {', '.join(missing) or 'a class to keep'}; {listing}", "choose from these")
    return {i: name for i, name in names.items() if name in chosen}


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
        columns, along_x = self._interpolation(0, x0, x1, values.shape[-1])
        rows, along_y = self._interpolation(1, y0, y1, values.shape[-2])
        part = values[..., rows, columns].astype(np.float32)
        if coefficients is not None:
            part = np.tensordot(coefficients.astype(np.float32), part, 1)
        # the first axis is the axis of the interpolation: copies of whole rows are fast
        mask = along_y(np.ascontiguousarray(along_x(np.ascontiguousarray(part.T)).T)) > threshold
        return instance_of(mask if keep is None else keep(mask), score, label, x0, y0)

    def _interpolation(self, axis: int, first: int, stop: int, length: int) -> tuple[slice, _Interpolation]:
        """Return the range of map pixels around a range of frame pixels, and the interpolation from these pixels."""
        map_per_input = length / self.input_px[axis]
        centres = np.arange(first, stop) + 0.5
        at = (centres * self.scale[axis] + self.offset[axis]) * map_per_input - 0.5
        at = np.clip(at, 0, length - 1)
        low, high = int(at[0]), int(np.ceil(at[-1])) + 1
        return slice(low, high), _Interpolation.at(at - low, high - low)


class _Interpolation(NamedTuple):
    """Linear interpolation along the first axis of an array."""

    before: Int[np.ndarray, "n"]
    after: Int[np.ndarray, "n"]
    share: Float[np.ndarray, "n 1"]
    """Weight of the element `after`."""

    @classmethod
    def at(cls, positions: Float[np.ndarray, "n"], length: int) -> _Interpolation:
        """Interpolate at positions within 0 and `length` − 1."""
        before = positions.astype(int)
        return cls(before, np.minimum(before + 1, length - 1), (positions - before).astype(np.float32)[:, None])

    def __call__(self, values: Float[np.ndarray, "m w"]) -> Float[np.ndarray, "n w"]:
        interpolated = values[self.before]
        interpolated *= 1 - self.share
        interpolated += values[self.after] * self.share
        return interpolated


def enlarge(corners_px: Float[np.ndarray, "4"], share: float, frame_px: tuple[int, int]) -> Int[np.ndarray, "4"]:
    """Add margins to a box, round outwards to whole pixels, and clip to the frame."""
    margin = np.tile(corners_px[2:] - corners_px[:2], 2) * share * [-1, -1, 1, 1]
    low, high = np.floor(corners_px + margin)[:2], np.ceil(corners_px + margin)[2:]
    return np.clip(np.concatenate([low, high]), 0, np.tile(frame_px, 2)).astype(int)


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
    xywh = np.concatenate([corners_px[:, :2], corners_px[:, 2:] - corners_px[:, :2]], 1)
    kept = cv2.dnn.NMSBoxesBatched(xywh.tolist(), scores.tolist(), labels.tolist(), 0.0, max_iou)
    return np.asarray(kept, int).reshape(-1)


class SegmentationNetwork:
    """Base class of segmentation and detection networks.

    Args:
        model: the network.
        classes: names of the classes to keep; None keeps `bird`, or the only class.
        min_score: least score; None uses `default_min_score`.
        names: names of all classes; None uses the names in the file.

    Raises:
        InputError: an unsupported input or layout, or unknown classes.
    """

    layout: ClassVar[str]
    """Description of the outputs, for messages."""
    default_min_score: ClassVar[float]
    accepts_unbatched: ClassVar[bool] = False
    """Whether the input may be a single picture (3, h, w)."""
    class_names: tuple[str, ...]
    path: Path

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model, self.path = model, model.path
        self._input = image_input(model, self.accepts_unbatched)
        self._min_score = self.default_min_score if min_score is None else min_score
        self._classes = choose_classes(model.path, self._all_classes(names), classes)
        self.class_names = tuple(self._classes.values())
        self._set_up()

    def _set_up(self) -> None:
        """Prepare what a layout needs besides the classes; the last part of `__init__`."""

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the inputs and outputs of a network have this layout."""
        raise NotImplementedError

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        """Return index → name of every class of the network."""
        return names_of(self._model, names, None)
