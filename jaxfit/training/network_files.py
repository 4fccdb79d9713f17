"""The files of trained networks: outputs and metadata as perception reads them."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from jaxfit.perception.segmentation.bottom_up import LONGER_SIDE_PX
from jaxfit.training import keypoints
from jaxfit.training.export import export_onnx

__all__ = ["Probabilities", "write_keypoints", "write_segmenter"]


class Probabilities(nn.Module):
    """The exported segmenter: probabilities, centres and offsets."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute foreground, centre and offset from pictures (B, 3, H, W)."""
        maps = self.network(pictures)
        return torch.sigmoid(maps["foreground"]), maps["centre"], maps["offset"]


def write_segmenter(
    network: nn.Module, facts: Mapping[str, str], path: str | Path, longer_side_px: int = LONGER_SIDE_PX
) -> None:
    """Write a segmenter to an ONNX file.

    Args:
        network: the trained network.
        facts: metadata about the training.
        path: the `.onnx` file; an existing file is replaced.
        longer_side_px: longer side of the pictures that the network expects.
    """
    metadata = {"names": repr({0: "bird"}), "longer_side": str(longer_side_px), **facts}
    outputs = ("foreground", "centre", "offset")
    example, axes = torch.rand(1, 3, 256, 320), {2: "height", 3: "width"}
    export_onnx(Probabilities(network).eval(), example, axes, outputs, metadata, path)


def write_keypoints(
    network: nn.Module,
    names: Sequence[str],
    facts: Mapping[str, str],
    path: str | Path,
    margins_px: tuple[int, int] | None = None,
) -> None:
    """Write a keypoint network to an ONNX file.

    Args:
        network: the trained network.
        names: names of the keypoints, without commas.
        facts: metadata about the training.
        path: the `.onnx` file; an existing file is replaced.
        margins_px: `pad_px` and `dilate_px` of the crops; None for the defaults.
    """
    side = keypoints.SIDE_PX
    margins = {} if margins_px is None else {"pad_px": str(margins_px[0]), "dilate_px": str(margins_px[1])}
    metadata = {
        "keypoint_names": ",".join(names),
        "mean": "0",
        "std": "255",
        "colour": "bgr",
        "input_size": f"{side},{side}",
        **margins,
        **facts,
    }
    exported = keypoints.KeypointMaps(network, len(names)).eval()
    export_onnx(exported, torch.rand(2, 3, side, side), {0: "birds"}, ("heatmaps",), metadata, path)
