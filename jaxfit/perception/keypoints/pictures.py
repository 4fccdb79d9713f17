"""How a network wants its pictures: order of axes and colours, size, numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Num, UInt8

from jaxfit.errors import InputError
from jaxfit.perception.keypoints.notes import Notes
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["PictureInput", "picture_input"]

IMAGENET_MEAN = (123.675, 116.28, 103.53)
IMAGENET_STD = (58.395, 57.12, 57.375)
"""Red, green, blue of 0–255, as MMPose and DeepLabCut 3 have them."""
DEFAULT_SIZE_PX = (256, 256)
NUMBERS = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class PictureInput(NamedTuple):
    """What turns pictures into the network's input."""

    size_px: tuple[int, int]
    """Width and height."""
    batch: int | None
    """Pictures that one run takes, always that many; None: as many as there are."""
    channels_last: bool
    number: type[np.generic]
    rgb: bool
    mean: tuple[float, ...]
    std: tuple[float, ...]
    """Of 0–255, in the network's order of colours; bytes are passed as they are."""

    def __call__(self, pictures: UInt8[np.ndarray, "N h w 3"]) -> Num[np.ndarray, "N _ _ _"]:
        """Blue-green-red pictures as the network takes them: (N, 3, h, w), or (N, h, w, 3) if `channels_last`."""
        if self.rgb:
            pictures = pictures[..., ::-1]
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        if not self.channels_last:  # first of all: bytes are moved, and long rows reckoned, ten times as fast
            pictures, mean, std = pictures.transpose(0, 3, 1, 2), mean[:, None, None], std[:, None, None]
        pictures = np.ascontiguousarray(pictures)
        if self.number is np.uint8:
            return pictures
        numbers = pictures.astype(np.float32)
        numbers -= mean
        numbers /= std
        return numbers.astype(self.number, copy=False)


def picture_input(model: OnnxModel, notes: Notes) -> PictureInput:
    """Reads it off the network's declaration and what its exporter wrote.

    Without `mean` and `std`, (N, 3, h, w) is normalised by ImageNet's and (N, h, w, 3), the layout of TensorFlow's
    exports, passed as 0–255, since those (DeepLabCut 2) subtract the mean themselves. Bytes are never normalised.

    Raises:
        InputError: no single input of three channels.
    """
    if len(model.inputs) != 1 or len(model.inputs[0].shape) != 4 or 3 not in model.inputs[0].shape[1::2]:
        problem = f"takes no batch of colour pictures: {model.describe()}"
        raise InputError(model.path, problem, "known are one input of (N, 3, h, w) and one of (N, h, w, 3)")
    port = model.inputs[0]
    if port.kind not in NUMBERS:
        raise InputError(model.path, f"takes {port.kind}", f"known are {', '.join(NUMBERS)}")
    channels_last = port.shape[1] != 3
    height, width = port.shape[1:3] if channels_last else port.shape[2:]
    default = notes.input_size or DEFAULT_SIZE_PX
    return PictureInput(
        size_px=(width or default[0], height or default[1]),
        batch=port.shape[0],
        channels_last=channels_last,
        number=NUMBERS[port.kind],
        rgb=notes.colour == "rgb",
        mean=notes.mean or ((0.0,) * 3 if channels_last else _ordered(IMAGENET_MEAN, notes.colour)),
        std=notes.std or ((1.0,) * 3 if channels_last else _ordered(IMAGENET_STD, notes.colour)),
    )


def _ordered(rgb: tuple[float, ...], colour: str) -> tuple[float, ...]:
    return rgb if colour == "rgb" else rgb[::-1]
