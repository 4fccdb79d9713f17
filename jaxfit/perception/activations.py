"""Distance of a network's activations from the activations of its training.

A network that `jaxfit train` wrote has an output `activations`: its last feature map, averaged over the cells. Its
metadata hold the mean μ of the activations of its training inputs and a matrix W (`jaxfit.training.activations`). The
distance of an input with activations a is ‖W (a − μ)‖. W whitens the activations of the training, and its scale is such
that 99 % of the training inputs have a distance below 1.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.errors import InputError
from jaxfit.limits import ACTIVATION_CHANNELS
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["MEAN_KEY", "OUTPUT", "WHITENING_KEY", "ActivationMonitor", "ActivationStatistics", "activation_monitor"]

OUTPUT = "activations"
"""Name of the output (N, C) of a network."""
MEAN_KEY, WHITENING_KEY = "activation_mean", "activation_whitening"
"""Keys of the metadata: μ (C,) and W (C, C) as little-endian floats of 32 bits in base64."""
LARGEST_DISTANCE = 1e6
"""Distance of activations that are not finite, and largest distance that is reported."""


class ActivationStatistics(NamedTuple):
    """The activations of the training of a network."""

    mean: Float[np.ndarray, "C"]
    whitening: Float[np.ndarray, "C C"]

    def distance(self, activations: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N"]:
        """Compute the distance of each input; 99 % of the training inputs have a distance below 1."""
        with np.errstate(all="ignore"):
            distance = np.linalg.norm((activations.astype(np.float64) - self.mean) @ self.whitening.T, axis=-1)
        return np.minimum(np.where(np.isfinite(distance), distance, LARGEST_DISTANCE), LARGEST_DISTANCE)

    def metadata(self) -> dict[str, str]:
        """Return the entries of the metadata that hold the statistics."""
        return {MEAN_KEY: _encode(self.mean), WHITENING_KEY: _encode(self.whitening)}


class ActivationMonitor:
    """Collects the distances of the inputs of a network.

    Args:
        model: the network, for messages.
        statistics: the activations of its training.
    """

    def __init__(self, model: OnnxModel, statistics: ActivationStatistics):
        self._model, self._statistics = model, statistics
        self._distances: list[Float[np.ndarray, "N"]] = []

    def add(self, outputs: Mapping[str, np.ndarray], count: int) -> None:
        """Add the distances of the first `count` inputs of a run.

        Raises:
            InputError: the output `activations` has another shape than the statistics.
        """
        self._model.check_outputs(outputs, {OUTPUT: ("inputs", len(self._statistics.mean))})
        self._distances.append(self._statistics.distance(outputs[OUTPUT][:count]))

    def take(self) -> Float[np.ndarray, "N"]:
        """Return the distances since the last call, in the order of the inputs."""
        taken, self._distances = self._distances, []
        return np.concatenate([np.zeros(0), *taken])


def activation_monitor(model: OnnxModel) -> ActivationMonitor | None:
    """Create the monitor of a network; None for a network without statistics of its training.

    Raises:
        InputError: the statistics are incomplete, damaged or too large.
    """
    texts = [model.metadata.get(key) for key in (MEAN_KEY, WHITENING_KEY)]
    if texts == [None, None]:
        return None
    mean, whitening = (_decode(text or "") for text in texts)
    if mean is None or whitening is None or not 1 <= len(mean) <= ACTIVATION_CHANNELS:
        raise _damaged(model)
    if len(whitening) != len(mean) ** 2 or OUTPUT not in {port.name for port in model.outputs}:
        raise _damaged(model)
    return ActivationMonitor(model, ActivationStatistics(mean, whitening.reshape(len(mean), -1)))


def _damaged(model: OnnxModel) -> InputError:
    problem = f"its metadata `{MEAN_KEY}` and `{WHITENING_KEY}` do not describe its output `{OUTPUT}`"
    return InputError(model.path, problem, "train it again, or remove both entries of the metadata")


def _encode(values: np.ndarray) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


def _decode(text: str) -> Float[np.ndarray, "n"] | None:
    """Decode finite numbers; None for any other text."""
    if len(text) > 8 * ACTIVATION_CHANNELS**2:
        return None
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None
    values = np.frombuffer(data, "<f4") if len(data) % 4 == 0 else np.array([np.nan])
    return values.astype(np.float64) if len(values) and np.isfinite(values).all() else None
