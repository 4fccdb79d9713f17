"""Statistics of the activations of a network over its training inputs, stored in the ONNX file.

The module needs the package `onnx`, but not PyTorch. `jaxfit.perception.activations` describes the statistics and
reads them.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnx
from jaxtyping import Float
from onnx import TensorProto, helper

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
    add_activation_output(path)
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
        InputError: fewer than 10 inputs, too many channels, or activations that are not finite or do not vary.
    """
    N, C = activations.shape
    values = activations.astype(np.float64)
    if C > ACTIVATION_CHANNELS:
        problem = f"has {C} channels in its last feature map"
        raise InputError(source, problem, f"the limit is {ACTIVATION_CHANNELS}")
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


def add_activation_output(path: str | Path) -> None:
    """Add the output `activations` (N, C) to a network: its last feature map, averaged over the cells.

    The last feature map is the result of the last Relu of the graph. A network of `jaxfit train` computes its outputs
    from this map. On simulated footage and on pictures without birds, this map separated known from unknown pictures
    better than the map with the coarsest resolution. A network that has the output does not change.

    Raises:
        InputError: the network has no Relu.
    """
    model = onnx.load(str(path))
    if OUTPUT in {output.name for output in model.graph.output}:
        return
    maps = [node.output[0] for node in model.graph.node if node.op_type == "Relu"]
    if not maps:
        raise InputError(path, "has no feature map after a Relu", "give a network of convolutions with Relu")
    model.graph.node.append(helper.make_node("GlobalAveragePool", [maps[-1]], [f"{OUTPUT}_map"]))
    model.graph.node.append(helper.make_node("Flatten", [f"{OUTPUT}_map"], [OUTPUT], axis=1))
    model.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [None, None]))
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString())
