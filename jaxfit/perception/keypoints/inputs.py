"""Input of a keypoint network: order of axes and colours, size, element type, normalisation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Num, UInt8

from jaxfit.errors import InputError
from jaxfit.limits import NETWORK_ASPECT
from jaxfit.perception.imagenet import IMAGENET_MEAN, IMAGENET_STD
from jaxfit.perception.keypoints.metadata import KeypointMetadata
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["KeypointInput", "read_input"]

DEFAULT_SIZE_PX = (256, 256)
_DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class KeypointInput(NamedTuple):
    """The input that a keypoint network expects."""

    size_px: tuple[int, int]
    """Width and height of the input, pixels."""
    batch: int | None
    """Fixed number of crops in one run; None for any number."""
    channels_last: bool
    dtype: type[np.generic]
    rgb: bool
    mean: tuple[float, ...]
    std: tuple[float, ...]
    """Within 0–255, in the network's colour order; input of bytes is not normalised."""

    def array(self, pictures: UInt8[np.ndarray, "N h w 3"]) -> Num[np.ndarray, "N _ _ _"]:
        """Convert blue-green-red pictures to the input array: (N, 3, h, w), or (N, h, w, 3) if `channels_last`."""
        if self.rgb:
            pictures = pictures[..., ::-1]
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        if not self.channels_last:  # transposing bytes first is ten times as fast
            pictures, mean, std = pictures.transpose(0, 3, 1, 2), mean[:, None, None], std[:, None, None]
        pictures = np.ascontiguousarray(pictures)
        if self.dtype is np.uint8:
            return pictures
        numbers = pictures.astype(np.float32)
        numbers -= mean
        numbers /= std
        return numbers.astype(self.dtype, copy=False)


def read_input(model: OnnxModel, metadata: KeypointMetadata) -> KeypointInput:
    """Read the expected input from the network's declaration and its metadata.

    Without `mean` and `std` in the metadata, an input (N, 3, h, w) is normalised with ImageNet's values, as in MMPose
    and DeepLabCut 3. An input (N, h, w, 3), the layout of TensorFlow, stays within 0–255, because such networks
    (DeepLabCut 2) subtract the mean themselves. Bytes are never normalised.

    Raises:
        InputError: several inputs, an input without three channels, or an unknown element type.
    """
    if len(model.inputs) != 1 or len(model.inputs[0].shape) != 4 or 3 not in model.inputs[0].shape[1::2]:
        problem = f"has no input for colour pictures: {model.describe()}"
        raise InputError(model.path, problem, "supported is one input (N, 3, h, w) or (N, h, w, 3)")
    port = model.inputs[0]
    if port.kind not in _DTYPES:
        raise InputError(model.path, f"has an input of type {port.kind}", f"supported are {', '.join(_DTYPES)}")
    channels_last = port.shape[1] != 3
    height, width = port.shape[1:3] if channels_last else port.shape[2:]
    default = metadata.input_size or DEFAULT_SIZE_PX
    width, height = width or default[0], height or default[1]
    model.check_input((port.shape[0], height, width, 3))
    if max(width, height) > NETWORK_ASPECT * min(width, height):
        problem = f"has an input of {width}×{height} pixels"
        raise InputError(model.path, problem, f"one side may be {NETWORK_ASPECT} times as long as the other")
    return KeypointInput(
        size_px=(width, height),
        batch=port.shape[0],
        channels_last=channels_last,
        dtype=_DTYPES[port.kind],
        rgb=metadata.colour == "rgb",
        mean=metadata.mean or ((0.0,) * 3 if channels_last else _in_bytes(IMAGENET_MEAN, metadata.colour)),
        std=metadata.std or ((1.0,) * 3 if channels_last else _in_bytes(IMAGENET_STD, metadata.colour)),
    )


def _in_bytes(rgb: tuple[float, ...], colour: str) -> tuple[float, ...]:
    """Scale red-green-blue values of [0, 1] to 0–255, in the given colour order."""
    scaled = tuple(255 * value for value in rgb)
    return scaled if colour == "rgb" else scaled[::-1]
