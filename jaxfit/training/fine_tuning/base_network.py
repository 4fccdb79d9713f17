"""Weights of an exported network back into the PyTorch network, as the start of a fine-tuning.

The export folds every batch normalisation into its convolution. So the convolution takes the folded weights, and the
normalisation becomes the addition of the bias: mean 0, variance 1. The normalisations must stay in evaluation mode
during the training; their scales and biases are trained.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, numpy_helper
from torch import nn

from jaxfit.data.keypoint_names import propose_names
from jaxfit.errors import InputError
from jaxfit.perception.keypoints.detector import BUILTIN_PATH
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.bottom_up import BottomUp
from jaxfit.perception.segmentation.load import BUILTIN
from jaxfit.training.keypoints import keypoint_network
from jaxfit.training.networks import FeaturePyramid
from jaxfit.training.segmenter import segmenter_network

__all__ = ["base_file", "freeze_normalisation", "load_keypoint_base", "load_segmenter_base"]

_REMEDY = "give `builtin`, or a network that this version of `jaxfit train` wrote"
_OTHER_LAYOUT = "is a network of another layout than that of `jaxfit train"


def base_file(which: str, base: str | Path) -> Path:
    """Return the file of a base network: `builtin`, or an ONNX file."""
    builtin = {"segmenter": BUILTIN, "keypoints": BUILTIN_PATH}[which]
    return builtin if str(base) == "builtin" else Path(base)


def load_segmenter_base(path: Path) -> FeaturePyramid:
    """Load a segmenter that `jaxfit train segmenter` wrote.

    Raises:
        InputError: the file cannot be read, or is a network of another layout.
    """
    if not BottomUp.fits(OnnxModel(path)):
        raise InputError(path, f"{_OTHER_LAYOUT} segmenter`", _REMEDY)
    network = segmenter_network()
    _load_weights(network, _weights(path), path, "segmenter")
    return network


def load_keypoint_base(path: Path, names: Sequence[str]) -> tuple[FeaturePyramid, tuple[str, ...]]:
    """Load a keypoint network that `jaxfit train keypoints` wrote, for keypoints of other names and number.

    The last layer of a keypoint is copied from the keypoint of the same name in the file, by `propose_names`. Without a
    counterpart, a keypoint gets a new last layer with random initial weights.

    Args:
        path: the ONNX file.
        names: names of the K keypoints of the new network.

    Returns:
        The network, and for each of the K keypoints the name in the file, or an empty text.

    Raises:
        InputError: the file cannot be read, or is a network of another layout.
    """
    own = tuple(OnnxModel(path).metadata.get("keypoint_names", "").split(","))
    weights = _weights(path)
    head = "network.heads.logits"
    shapes = {name: weights[name].shape for name in (f"{head}.weight", f"{head}.bias") if name in weights}
    if set(shapes.values()) != {(len(own), 64, 3, 3), (len(own),)}:
        raise InputError(path, f"{_OTHER_LAYOUT} keypoints`", _REMEDY)
    network = keypoint_network(len(names))
    found = propose_names(names, own).mapped
    for key in (f"{head}.weight", f"{head}.bias"):
        values = network.state_dict()[key.removeprefix("network.")].numpy().copy()
        for k, name in enumerate(names):
            if name in found:
                values[k] = weights[key][own.index(found[name])]
        weights[key] = values
    _load_weights(network, weights, path, "keypoints")
    return network, tuple(found.get(name, "") for name in names)


def freeze_normalisation(network: nn.Module) -> None:
    """Put all batch normalisations into evaluation mode; call this after every `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def _weights(path: Path) -> dict[str, np.ndarray]:
    """Return the weights of an ONNX file by name; weights in 16 bits lose the suffix of their name."""
    try:
        graph = onnx.load(str(path), load_external_data=False).graph
        stored = [weight for weight in graph.initializer if weight.data_location != TensorProto.EXTERNAL]
        return {weight.name.removesuffix("_16"): numpy_helper.to_array(weight) for weight in stored}
    except (ValueError, TypeError, OSError) as error:  # the errors of a damaged array
        raise InputError(path, "holds weights that cannot be read", _REMEDY) from error


def _load_weights(network: nn.Module, weights: dict[str, np.ndarray], path: Path, which: str) -> None:
    """Fill a network with folded weights."""
    state = network.state_dict()
    for convolution, norm in _layers(network):
        bias = f"{convolution}.bias" if norm is None else f"{convolution}.weight_bias"
        for name, target in ((f"{convolution}.weight", f"{convolution}.weight"), (bias, f"{norm or convolution}.bias")):
            value = weights.get(f"network.{name}")
            if value is None or value.shape != tuple(state[target].shape) or not np.isfinite(value).all():
                raise InputError(path, f"{_OTHER_LAYOUT} {which}`: it lacks fitting weights {name}", _REMEDY)
            state[target] = torch.from_numpy(value.astype(np.float32))
        if norm is not None:
            layer = network.get_submodule(norm)
            assert isinstance(layer, nn.BatchNorm2d)
            state[f"{norm}.weight"] = torch.full_like(state[f"{norm}.weight"], math.sqrt(1 + layer.eps))
            state[f"{norm}.running_mean"] = torch.zeros_like(state[f"{norm}.running_mean"])
            state[f"{norm}.running_var"] = torch.ones_like(state[f"{norm}.running_var"])
    network.load_state_dict(state)
    network.eval()


def _layers(network: nn.Module) -> Iterator[tuple[str, str | None]]:
    """Yield every convolution with the batch normalisation that follows it, or None: the order of the modules."""
    before: str | None = None
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            if before is not None:
                yield before, None
            before = name
        elif isinstance(module, nn.BatchNorm2d) and before is not None:
            yield before, name
            before = None
    if before is not None:
        yield before, None
