"""Inputs of segmentation networks, and literals in their metadata."""

from __future__ import annotations

import ast
import re
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.errors import InputError
from jaxfit.limits import METADATA_CHARACTERS, METADATA_DEPTH
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["STRIDES", "ImageInput", "cell_count", "image_input", "literal_metadata"]

STRIDES = (8, 16, 32)
"""Cell sizes of the grids of both YOLO families, pixels of the input."""
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", re.DOTALL)
_LITERAL = re.compile(rf"(?:{_QUOTED.pattern}|None|True|False|[\d.\s,:\[\](){{}}])*", re.DOTALL)
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
    if len(axes) not in ((3, 4) if unbatched else (4,)):
        raise InputError(
            model.path, f"its input {port} is not a batch of pictures", "export it as (1, 3, height, width)"
        )
    if axes[-3] not in (3, None):
        problem = f"its input {port} has {axes[-3]} channels, not 3"
        raise InputError(
            model.path, problem, "give a network for colour pictures, with the channels before height and width"
        )
    if len(axes) == 4 and axes[0] not in (1, None):
        raise InputError(model.path, f"its input {port} is a batch of {axes[0]}", "export it for a batch of 1")
    if port.kind not in _TYPES:
        raise InputError(model.path, f"its input {port} is {port.kind}", "export it with an input of floats")
    height, width = axes[-2:]
    if (height is None) != (width is None):
        raise InputError(
            model.path, f"its input {port} has one variable side", "export it with both sides fixed or both variable"
        )
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
        if not _is_flat(text):
            raise ValueError("operators or deep nesting, which need much memory")
        return ast.literal_eval(text)
    except (ValueError, SyntaxError) as error:
        raise InputError(model.path, f"metadata `{key}` cannot be read: {text[:80]!r}", "export it again") from error


def _is_flat(text: str) -> bool:
    """Whether a text contains only names, numbers, quoted text, and brackets of at most `METADATA_DEPTH` levels."""
    if len(text) > METADATA_CHARACTERS or not _LITERAL.fullmatch(text):
        return False
    depth = deepest = 0
    for bracket in re.findall(r"[\[({})\]]", _QUOTED.sub("", text)):
        depth += 1 if bracket in "[({" else -1
        deepest = max(deepest, depth)
    return deepest <= METADATA_DEPTH
