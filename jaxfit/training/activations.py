"""Statistics of the activations of a network over its training inputs, stored in the ONNX file.

The module needs the package `onnx`, but not PyTorch. `jaxfit.perception.activations` describes the statistics and
reads them.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterable
from math import prod
from pathlib import Path

import numpy as np
import onnx
from jaxtyping import Float
from onnx import TensorProto, helper, shape_inference

from jaxfit.errors import InputError
from jaxfit.fitting.learn import oas_shrinkage
from jaxfit.limits import ACTIVATION_CHANNELS
from jaxfit.perception.activations import OUTPUT, ActivationStatistics
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import write_whole
from jaxfit.training.onnx_metadata import set_metadata

__all__ = ["activation_statistics", "add_activation_output", "store_activations"]

INSIDE = 0.99
"""Share of the training inputs whose distance is below 1."""
LEAST_VARIANCE = 1e-3
"""Least variance of a direction of the activations, as a share of the mean variance."""
MIN_INPUTS = 10
"""Least number of training inputs."""


def store_activations(
    path: str | Path, inputs: Iterable[np.ndarray], count: int | None = None, progress: ProgressTask = silent
) -> ActivationStatistics:
    """Add the output `activations` to a network, run the network over training inputs, and store the statistics.

    The other outputs do not change. Statistics that the file already holds are replaced.

    Args:
        path: the ONNX file of a network with one input; it is replaced.
        inputs: arrays (N, 3, h, w) as tracking passes them to the network: whole frames for a segmenter, crops of
            single birds for a keypoint network.
        count: number of arrays, for the progress.
        progress: reports every array.

    Returns:
        The stored statistics.

    Raises:
        InputError: the file is no usable network, or there are fewer than 10 inputs.
    """
    arrays = iter(inputs)
    first = next(arrays, None)
    if first is None:
        raise InputError(path, "has no training inputs for the statistics of activations", "give at least 10 inputs")
    add_activation_output(path, first.shape)
    network = OnnxModel(path)
    activations = [network(first)[OUTPUT]]
    with progress("Measuring activations", count) as report_progress:
        report_progress(1, "")
        for array in arrays:
            activations.append(network(array)[OUTPUT])
            report_progress(1, "")
    statistics = activation_statistics(np.concatenate(activations), path)
    set_metadata(path, statistics.metadata())
    return statistics


def activation_statistics(activations: Float[np.ndarray, "N C"], source: object = "inputs") -> ActivationStatistics:
    """Compute the mean and the whitening matrix of activations.

    The covariance is shrunk towards a multiple of the identity (`oas_shrinkage`), so that a few inputs suffice.

    Args:
        activations: one row for each training input.
        source: the network, for messages.

    Raises:
        InputError: fewer than 10 inputs, or activations that are not finite or do not vary.
    """
    N, C = activations.shape
    values = activations.astype(np.float64)
    if N < MIN_INPUTS or not np.isfinite(values).all() or not values.var(0).any():
        problem = f"has no usable activations in {N} inputs"
        raise InputError(source, problem, f"give at least {MIN_INPUTS} different inputs with finite numbers")
    mean = values.mean(0)
    covariance = np.atleast_2d(np.cov(values, rowvar=False, bias=True))
    variance = np.trace(covariance) / C
    shrinkage = oas_shrinkage(covariance, N) if C > 1 else 0.0
    covariance = (1 - shrinkage) * covariance + shrinkage * variance * np.eye(C)
    eigenvalues, directions = np.linalg.eigh(covariance)
    whitening = directions.T / np.sqrt(np.maximum(eigenvalues, LEAST_VARIANCE * variance))[:, None]
    unscaled = ActivationStatistics(mean, whitening)
    return ActivationStatistics(mean, whitening / np.quantile(unscaled.distance(values), INSIDE))


def add_activation_output(path: str | Path, input_shape: tuple[int, ...]) -> None:
    """Add the output `activations` (N, C) to a network: its deepest feature map, averaged over the cells.

    The deepest feature map has the fewest cells and, of several, the most channels and the last place in the graph. A
    network that has the output does not change.

    Args:
        path: the ONNX file; it is replaced.
        input_shape: shape of an input, without variable sides.

    Raises:
        InputError: the network has no feature map, or one with too many channels.
    """
    model = onnx.load(str(path))
    if OUTPUT in {output.name for output in model.graph.output}:
        return
    name, channels = _deepest_features(model, input_shape, path)
    if channels > ACTIVATION_CHANNELS:
        problem = f"has {channels} channels in its deepest feature map"
        raise InputError(path, problem, f"the limit is {ACTIVATION_CHANNELS}")
    model.graph.node.append(helper.make_node("GlobalAveragePool", [name], [f"{OUTPUT}_map"]))
    model.graph.node.append(helper.make_node("Flatten", [f"{OUTPUT}_map"], [OUTPUT], axis=1))
    model.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [None, channels]))
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString())


def _deepest_features(model: onnx.ModelProto, input_shape: tuple[int, ...], path: str | Path) -> tuple[str, int]:
    """Return the name and the number of channels of the deepest feature map."""
    fixed = onnx.ModelProto()
    fixed.CopyFrom(model)
    for dim, length in zip(fixed.graph.input[0].type.tensor_type.shape.dim, input_shape, strict=True):
        dim.dim_value = length
    for output in fixed.graph.output:
        output.type.tensor_type.ClearField("shape")
    inferred = shape_inference.infer_shapes(fixed, data_prop=True)
    shapes = {
        value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim] for value in inferred.graph.value_info
    }
    best: tuple[tuple[int, int], str] | None = None
    for node in model.graph.node:
        shape = shapes.get(node.output[0], [])
        if node.op_type != "Relu" or len(shape) != 4 or not all(shape):
            continue
        size = prod(shape[2:]), -shape[1]
        if best is None or size <= best[0]:
            best = size, node.output[0]
    if best is None:
        raise InputError(path, "has no feature map after a Relu", "give a network of convolutions")
    return best[1], -best[0][1]
