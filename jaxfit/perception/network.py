"""Detected birds, the protocols of networks, and ONNX networks with jaxfit's metadata.

Distance of a network's activations from the activations of its training. A network that `jaxfit train` wrote has an
output `activations`: its last feature map, averaged over the cells. Its metadata hold the mean μ of the activations of
its training inputs and a matrix W (`jaxfit.learning.networks.network_files`). The distance of an input with activations
a is ‖W (a − μ)‖. W whitens the activations of the training, and its scale is such that 99 % of the training inputs have
a distance below 1.

Calibration of confidences: from a network's raw value to the probability that the detection is right. The metadata of a
network, such as the built-in keypoint network, may hold a curve (`tests/benchmarks/confidence_curve.py` fits it):
points `value:probability`, separated by commas, with linear interpolation between them. The values increase and the
probabilities do not decrease. Without a curve, the confidence is the network's own value.
"""

from __future__ import annotations

import base64
import mmap
import re
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfit.data.masks import box_of_mask, encode_patch
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import check_readable


class Instance(NamedTuple):
    """One bird in one frame. The mask covers the bird's box, not the whole frame."""

    mask: Bool[np.ndarray, "h w"]
    """The visible part of the bird, cropped to its tight box: every border row and column contains a True."""
    x0: int
    """Column of the frame at which the mask begins."""
    y0: int
    """Row of the frame at which the mask begins."""
    score: float
    """Confidence of the instance, within [0, 1]."""
    label: str
    """Name of the class."""

    @property
    def box_px(self) -> Float[np.ndarray, "4"]:
        """The tight box of the mask: x, y of the upper left corner, width, height; image pixels."""
        height, width = self.mask.shape
        return np.array([self.x0, self.y0, width, height], np.float32)

    @property
    def corners_px(self) -> Float[np.ndarray, "4"]:
        """The tight box of the mask: x0, y0, x1, y1; image pixels."""
        height, width = self.mask.shape
        return np.array([self.x0, self.y0, self.x0 + width, self.y0 + height], np.float32)

    def whole(self, size_px: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """Return the mask over a frame of the given width and height."""
        mask = np.zeros(size_px[::-1], bool)
        height, width = self.mask.shape
        mask[self.y0 : self.y0 + height, self.x0 : self.x0 + width] = self.mask
        return mask

    def encode(self, width: int, height: int) -> dict[str, Any]:
        """Encode the mask as run lengths over a frame of the given size, as in `Observations.masks`."""
        return encode_patch(self.mask, self.x0, self.y0, width, height)


def instance_of(mask: Bool[np.ndarray, "h w"], score: float, label: str, x0: int = 0, y0: int = 0) -> Instance | None:
    """Create an instance from a mask that may have empty borders; return None for an empty mask.

    Args:
        mask: mask of the whole frame or of a part of the frame.
        score, label: as in `Instance`; the score is clipped to [0, 1].
        x0, y0: position of this part in the frame, pixels; 0 or more.
    """
    box = box_of_mask(mask)
    if box is None:
        return None
    left, top, width, height = box
    return Instance(
        mask[top : top + height, left : left + width], x0 + left, y0 + top, min(max(float(score), 0.0), 1.0), label
    )


@runtime_checkable
class Segmenter(Protocol):
    """Detects the instances of a frame.

    A method `segment_block` replaces the call where frames follow each other: it takes at most
    `jaxfit.perception.carried_masks.BLOCK_FRAMES` frames, and returns the instances of each.
    """

    class_names: tuple[str, ...]
    """The classes that the segmenter reports."""

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Return the instances of a blue-green-red frame, by falling score; masks lie within the frame."""
        ...


@runtime_checkable
class KeypointDetector(Protocol):
    """Detects the keypoints of instances."""

    keypoint_names: tuple[str, ...]
    """K names in the order of the output."""

    def __call__(
        self, frame: UInt8[np.ndarray, "H W 3"], instances: Sequence[Instance]
    ) -> tuple[Float[np.ndarray, "M K 2"], Float[np.ndarray, "M K"]]:
        """Return positions (x, y in image pixels, pixel centres at i + 0.5) and confidences within [0, 1], float32."""
        ...


class Port(NamedTuple):
    """An input or output, as the file declares it."""

    name: str
    shape: tuple[int | None, ...]
    """Length of each axis; None for an axis of variable length."""
    kind: str
    """ONNX Runtime's name of the element type, such as `tensor(float)`."""

    def __str__(self) -> str:
        return f"{self.name} ({', '.join('?' if side is None else str(side) for side in self.shape)})"


class OnnxModel:
    """A network in an ONNX file.

    Args:
        path: the `.onnx` file.
        threads: number of cores for one run; None uses all cores.

    Raises:
        InputError: the file does not exist, is not ONNX, names external data, or contains an unknown operator.
    """

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]
    """The exporter's metadata, such as `names` (Ultralytics)."""

    def __init__(self, path: str | Path, threads: int | None = None):
        import onnxruntime as ort

        self.path = check_readable(path, "an ONNX file")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads or 0
        # threads that wait in a loop would slow down the other network, which runs at the same time
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # the error below reports the problem
        try:
            if _has_external_data(self.path):
                problem = "stores its weights in another file (external data), which is not read"
                raise InputError(path, problem, "save the network as one file: onnx.save(onnx.load(path), new_path)")
            self._session = ort.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
            self.inputs = tuple(_read_port(value) for value in self._session.get_inputs())
            self.outputs = tuple(_read_port(value) for value in self._session.get_outputs())
            self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        except InputError:
            raise
        except Exception as error:  # the errors of ONNX Runtime have no common base class
            remedy = "export it again; use an older opset if an operator is unknown"
            if "protobuf" in str(error).lower():
                remedy = "give a complete ONNX file"
            raise InputError(path, f"cannot be loaded: {_shorten(error)}", remedy) from error

    def __call__(self, *inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Run the network once.

        Args:
            inputs: one array for each input, in the order of `self.inputs`.

        Returns:
            Name → array of each output.

        Raises:
            InputError: the network fails on these inputs.
        """
        names = [port.name for port in self.outputs]
        feed = {port.name: value for port, value in zip(self.inputs, inputs, strict=True)}
        try:
            values: Any = self._session.run(names, feed)
        except Exception as error:
            problem = f"cannot be run: {_shorten(error)}"
            raise InputError(self.path, problem, "check the layout of its inputs") from error
        return dict(zip(names, values, strict=True))

    def check_outputs(self, outputs: Mapping[str, Any], expected: Mapping[str, Sequence[int | str | None]]) -> None:
        """Check the outputs of a run.

        Args:
            outputs: name → value.
            expected: name → length of each axis. A word stands for one length, which is the same in all outputs and is
                0 only for `n`; None stands for any length.

        Raises:
            InputError: an output has another shape, or does not contain numbers.
        """
        lengths: dict[str, int] = {}
        for name, sides in expected.items():
            value = outputs[name]
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
                raise InputError(self.path, f"its output {name} does not contain numbers", "export it again")
            fits = value.ndim == len(sides)
            for length, side in zip(value.shape, sides, strict=False):
                if isinstance(side, str):
                    fits &= (length >= 1 or side == "n") and lengths.setdefault(side, length) == length
                else:
                    fits &= side is None or length == side
            if not fits:
                shape = f"({', '.join('?' if side is None else str(side) for side in sides)})"
                problem = f"a run gives {name} {value.shape} instead of {shape}"
                raise InputError(self.path, problem, "export it again")

    def describe(self) -> str:
        """List the inputs and outputs with their shapes, for messages."""
        return f"{', '.join(map(str, self.inputs))} → {', '.join(map(str, self.outputs))}"


def _read_port(value: Any) -> Port:
    return Port(value.name, tuple(side if isinstance(side, int) else None for side in value.shape), value.type)


def _shorten(error: Exception) -> str:
    return " ".join(str(error).split(" : ")[-1].split())[:300]


def _has_external_data(path: Path) -> bool:
    """Return whether a file names external data: a tensor with an entry of the key `location` (`onnx.proto`)."""
    if not path.stat().st_size:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        # field 13 of a tensor: tag, length in up to five bytes, then the key; metadata of a model have another tag
        return re.search(rb"\x6a[\x80-\xff]{0,4}[\x00-\x7f]\x0a\x08location\x12", content) is not None


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Red, green, blue within [0, 1]."""


def normalise(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Subtract ImageNet's mean from a red-green-blue picture within [0, 1], and divide by the standard deviation."""
    return (rgb - np.array(IMAGENET_MEAN, np.float32)) / np.array(IMAGENET_STD, np.float32)


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


class ActivationMonitor(threading.local):
    """Collects the distances of the inputs of a network, for every thread that runs the network separately.

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
        """Return the distances since the last call of this thread, in the order of the inputs."""
        taken, self._distances = self._distances, []
        return np.concatenate([np.zeros(0), *taken])


def activation_monitor(model: OnnxModel) -> ActivationMonitor | None:
    """Create the monitor of a network; None for a network without statistics of its training.

    Raises:
        InputError: the statistics are incomplete or damaged.
    """
    keys = (MEAN_KEY, WHITENING_KEY)
    if not any(key in model.metadata for key in keys):
        return None
    try:
        contents = [base64.b64decode(model.metadata[key], validate=True) for key in keys]
        mean, whitening = (np.frombuffer(content, "<f4").astype(np.float64) for content in contents)
        statistics = ActivationStatistics(mean, whitening.reshape(len(mean), len(mean)))
        is_valid = np.isfinite(mean).all() and np.isfinite(whitening).all() and len(mean) > 0
    except (KeyError, ValueError) as error:
        raise _damaged_activations(model) from error
    if not is_valid or OUTPUT not in {port.name for port in model.outputs}:
        raise _damaged_activations(model)
    return ActivationMonitor(model, statistics)


def _damaged_activations(model: OnnxModel) -> InputError:
    problem = f"its metadata `{MEAN_KEY}` and `{WHITENING_KEY}` do not describe its output `{OUTPUT}`"
    return InputError(model.path, problem, "train it again, or remove both entries of the metadata")


def _encode(values: np.ndarray) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


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
        values, probabilities = np.array(
            [[float(number) for number in point.split(":")] for point in text.split(",")]
        ).T
        is_rising = (np.diff(values) > 0).all() and (np.diff(probabilities) >= 0).all()
        if not (np.isfinite(values).all() and is_rising and probabilities[0] >= 0 and probabilities[-1] <= 1):
            raise ValueError("not a rising curve")
    except ValueError as error:
        problem = f"its metadata `{key}` is {text[:60]!r}"
        remedy = "expected points value:probability that rise, as in 0:0,0.5:0.4,1:0.9"
        raise InputError(model.path, problem, remedy) from error
    return Curve(values, probabilities)
