"""Metadata of a keypoint network: keys and values of `metadata_props` in the ONNX file.

| key | value | default |
|---|---|---|
| `keypoint_names` | names in the order of the output, separated by commas | none: the user must give the names |
| `mean`, `std` | one or three numbers of 0–255, separated by commas, in the network's colour order | see `inputs` |
| `colour` | `rgb` or `bgr`, the colour order of the input | `rgb` |
| `input_size` | `width,height`, for an input of variable size | `256,256` |
| `activation` | `none`, `sigmoid` or `softmax`: the function that turns the output into confidences | `none` |
| `alignment` | position of the cells of a heatmap, see `ALIGNMENTS` | `centres`; with offsets `deeplabcut` |
| `locref_std` | length in pixels of an offset of 1 | 7.2801, DeepLabCut's |
| `pad_px`, `dilate_px` | parameters of the training crops, see `crops` | 40, 70 |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from jaxfit.errors import InputError
from jaxfit.limits import CROP_MARGIN_PX, IMAGE_SIDE_PX
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["ACTIVATIONS", "ALIGNMENTS", "KeypointMetadata", "read_metadata"]

ACTIVATIONS = ("none", "sigmoid", "softmax")

ALIGNMENTS = ("centres", "deeplabcut", "msra", "udp")
"""Position of the centre of cell i, in input pixels (pixel centres at i + 0.5), for w cells over W pixels:

- `centres`: (i + 0.5) · W/w; the cells divide the picture evenly;
- `deeplabcut`: (i + 0.5) · stride + 0.5; DeepLabCut's pixel centres have integer coordinates;
- `msra`: i · W/w + 0.5; MMPose's codec `MSRAHeatmap` (SimpleBaseline, HRNet);
- `udp`: i · (W − 1)/(w − 1) + 0.5; MMPose's codec `UDPHeatmap` (ViTPose): the outermost cells lie on the outermost
  pixels.

Source: `HeatmapPredictor` of DeepLabCut 3, `MSRAHeatmap` and `UDPHeatmap` of MMPose 1."""

T = TypeVar("T")


class KeypointMetadata(NamedTuple):
    """The values of the table above; None for a key that is absent and has no default."""

    keypoint_names: tuple[str, ...] | None
    mean: tuple[float, ...] | None
    std: tuple[float, ...] | None
    colour: str
    input_size: tuple[int, int] | None
    activation: str
    alignment: str | None
    locref_std: float
    pad_px: int | None
    dilate_px: int | None


def read_metadata(model: OnnxModel) -> KeypointMetadata:
    """Read the metadata of a keypoint network.

    Raises:
        InputError: a value that is not valid for its key.
    """

    def value(key: str, read: Callable[[str], T], default: Any = None) -> T:
        text = model.metadata.get(key)
        if text is None:
            return default
        try:
            return read(text)
        except ValueError as error:
            raise InputError(model.path, f"its metadata `{key}` is {text[:100]!r}", f"expected {error}") from error

    return KeypointMetadata(
        keypoint_names=value("keypoint_names", _names),
        mean=value("mean", _colour_values),
        std=value("std", lambda text: _positive(_colour_values(text))),
        colour=value("colour", _one_of("rgb", "bgr"), "rgb"),
        input_size=value("input_size", _size),
        activation=value("activation", _one_of(*ACTIVATIONS), "none"),
        alignment=value("alignment", _one_of(*ALIGNMENTS)),
        locref_std=value("locref_std", lambda text: _positive(_numbers(text, 1))[0], 7.2801),
        pad_px=value("pad_px", _pixels),
        dilate_px=value("dilate_px", _pixels),
    )


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ValueError("names, separated by commas")
    return names


def _one_of(*words: str) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in words:
            raise ValueError(", ".join(words[:-1]) + " or " + words[-1])
        return text

    return read


def _numbers(text: str, *counts: int) -> tuple[float, ...]:
    problem = f"{' or '.join(map(str, counts))} number(s), separated by commas"
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ValueError(problem) from error
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise ValueError(problem)
    return numbers


def _colour_values(text: str) -> tuple[float, ...]:
    numbers = _numbers(text, 1, 3)
    return numbers * 3 if len(numbers) == 1 else numbers


def _positive(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if min(numbers) <= 0:
        raise ValueError("more than 0")
    return numbers


def _size(text: str) -> tuple[int, int]:
    width, height = _numbers(text, 2)
    if not (1 <= width <= IMAGE_SIDE_PX and 1 <= height <= IMAGE_SIDE_PX):
        raise ValueError(f"width,height in pixels, at most {IMAGE_SIDE_PX}")
    return int(width), int(height)


def _pixels(text: str) -> int:
    (number,) = _numbers(text, 1)
    if not 0 <= number <= CROP_MARGIN_PX:
        raise ValueError(f"0 to {CROP_MARGIN_PX} pixels")
    return round(number)
