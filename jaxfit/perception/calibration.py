"""Calibration of confidences: from a network's raw value to the probability that the detection is right.

A network that `jaxfit train` wrote holds a curve in its metadata (`jaxfit.training.calibration` fits the curve): points
`value:probability`, separated by commas, with linear interpolation between the points. The values increase and the
probabilities do not decrease. Without a curve, the confidence is the network's own value.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.errors import InputError
from jaxfit.limits import CURVE_POINTS
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["CONFIDENCE_KEY", "Curve", "read_curve"]

CONFIDENCE_KEY = "confidence_curve"
"""Key of the metadata: the curve of the keypoints' confidences."""


class Curve(NamedTuple):
    """A monotone curve through P points, constant beyond the first and the last point."""

    values: Float[np.ndarray, "P"]
    """Raw values of the network, increasing."""
    probabilities: Float[np.ndarray, "P"]
    """Within [0, 1], not decreasing."""

    def __call__(self, values: Float[np.ndarray, "*B"]) -> Float[np.ndarray, "*B"]:
        """Return the probabilities of raw values; 0 stays 0, because 0 means that nothing was detected."""
        return np.where(values > 0, np.interp(values, self.values, self.probabilities), 0)

    def text(self) -> str:
        """Return the entry of the metadata."""
        points = zip(self.values.tolist(), self.probabilities.tolist(), strict=True)
        return ",".join(f"{value:.6g}:{probability:.4g}" for value, probability in points)


def read_curve(model: OnnxModel, key: str) -> Curve | None:
    """Read a curve from the metadata of a network; None without a curve.

    Raises:
        InputError: the text is not a monotone curve of probabilities.
    """
    text = model.metadata.get(key)
    if text is None:
        return None
    try:
        if text.count(",") >= CURVE_POINTS:
            raise ValueError("too many points")
        points = np.array([[float(number) for number in point.split(":")] for point in text.split(",")])
        values, probabilities = points.T
    except ValueError as error:
        raise _damaged(model, key, text) from error
    rising = (np.diff(values) > 0).all() and (np.diff(probabilities) >= 0).all()
    if not (np.isfinite(points).all() and rising and probabilities[0] >= 0 and probabilities[-1] <= 1):
        raise _damaged(model, key, text)
    return Curve(values, probabilities)


def _damaged(model: OnnxModel, key: str, text: str) -> InputError:
    problem = f"its metadata `{key}` is {text[:60]!r}"
    return InputError(model.path, problem, "expected points value:probability that rise, as in 0:0,0.5:0.4,1:0.9")
