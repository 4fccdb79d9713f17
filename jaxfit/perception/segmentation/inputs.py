"""What networks ask for as their input, and say of themselves."""

from __future__ import annotations

import ast
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.errors import InputError
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["IMAGENET_MEAN", "IMAGENET_STD", "STRIDES", "ImageInput", "cell_count", "image_input", "literal_metadata"]

IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
"""Mean and deviation of ImageNet's colours, red-green-blue within [0, 1]."""
STRIDES = (8, 16, 32)
"""Pixels of the input that a cell of each grid spans, in both YOLO families."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class ImageInput(NamedTuple):
    """The picture that a network takes."""

    size_px: tuple[int, int] | None
    """Width and height; None where both are free."""
    dtype: type
    batched: bool

    def array(self, picture: Float[np.ndarray, "h w 3"]) -> np.ndarray:
        """A picture, its colours scaled and in order, as the network's one input: channels first."""
        chw = np.ascontiguousarray(picture.transpose(2, 0, 1), self.dtype)
        return chw[None] if self.batched else chw


def image_input(model: OnnxModel, unbatched: bool = False) -> ImageInput:
    """What the network's one input asks for.

    Args:
        unbatched: whether a lone picture (3, h, w) may be asked for.

    Raises:
        InputError: several inputs, another number of channels or axes, a batch above 1, one side free and one not,
            another type than floats.
    """
    if len(model.inputs) != 1:
        raise InputError(model.path, f"takes {len(model.inputs)} inputs: {model.describe()}", "give one of one picture")
    port = model.inputs[0]
    axes = port.shape
    if len(axes) not in ((3, 4) if unbatched else (4,)):
        raise InputError(model.path, f"its input {port} is no batch of pictures", "export it as (1, 3, height, width)")
    if axes[-3] not in (3, None):
        problem = f"its input {port} has {axes[-3]} channels, not 3"
        raise InputError(model.path, problem, "give a network of colour pictures, channels before height and width")
    if len(axes) == 4 and axes[0] not in (1, None):
        raise InputError(model.path, f"its input {port} is a batch of {axes[0]}", "export it for a batch of 1")
    if port.kind not in _TYPES:
        raise InputError(model.path, f"its input {port} is {port.kind}", "export it with floats as input")
    height, width = axes[-2:]
    if (height is None) != (width is None):
        raise InputError(model.path, f"its input {port} has one free side", "export it with both fixed or both free")
    size = None if height is None or width is None else (width, height)
    return ImageInput(size, _TYPES[port.kind], len(axes) == 4)


def cell_count(size_px: tuple[int, int]) -> int:
    """Cells of all grids together, over an input of that width and height."""
    return sum((size_px[0] // stride) * (size_px[1] // stride) for stride in STRIDES)


def literal_metadata(model: OnnxModel, key: str) -> Any:
    """A Python literal from the file's metadata; None where there is none.

    Raises:
        InputError: the text is no literal.
    """
    if key not in model.metadata:
        return None
    try:
        return ast.literal_eval(model.metadata[key])
    except (ValueError, SyntaxError) as error:
        problem = f"metadata `{key}` cannot be read: {model.metadata[key][:80]!r}"
        raise InputError(model.path, problem, "export it again") from error
