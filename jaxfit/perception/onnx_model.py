"""ONNX networks on a CPU."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.errors import InputError
from jaxfit.limits import IMAGE_SIDE_PX, NETWORK_BYTES, NETWORK_INPUT_VALUES
from jaxfit.storage.reading import open_file

__all__ = ["OnnxModel", "Port"]


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
        InputError: the file does not exist, is not ONNX, lacks its external data, contains an unknown operator or text
            that is not UTF-8, or declares an input without values or with too many values.
    """

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]
    """The exporter's metadata, such as `names` (Ultralytics)."""

    def __init__(self, path: str | Path, threads: int | None = None):
        import onnxruntime as ort

        self.path = Path(path)
        with open_file(self.path, "an ONNX file") as file:
            size = os.fstat(file.fileno()).st_size
        if size > NETWORK_BYTES:
            raise InputError(path, f"has {size:,} bytes", f"the limit is {NETWORK_BYTES:,}")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # the error below reports the problem
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # the errors of ONNX Runtime have no common base class
            raise InputError(path, f"cannot be loaded: {_shorten(error)}", _remedy(str(error))) from error
        try:
            self.inputs = tuple(_read_port(value) for value in self._session.get_inputs())
            self.outputs = tuple(_read_port(value) for value in self._session.get_outputs())
            self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        except UnicodeDecodeError as error:
            raise InputError(path, "has names or metadata that are not UTF-8", "export it again") from error
        for port in self.inputs:
            self.check_input(port.shape)

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

    def check_input(self, shape: Sequence[int | None]) -> None:
        """Raise InputError if an input of this shape has no values or too many values; None is a variable side."""
        sides = [side for side in shape if side is not None]
        if sides and (min(sides) < 1 or max(sides) > IMAGE_SIDE_PX or math.prod(sides) > NETWORK_INPUT_VALUES):
            problem = f"has an input of {' × '.join(map(str, sides))} values"
            remedy = f"the limits are {IMAGE_SIDE_PX} for a side and {NETWORK_INPUT_VALUES:,} values"
            raise InputError(self.path, problem, remedy)

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


def _remedy(text: str) -> str:
    lowered = text.lower()
    if "external" in lowered or "model_path" in lowered or "file_size" in lowered:
        return "put the file with its external data (often `….onnx.data`) into the same folder, with its original name"
    if "protobuf" in lowered:
        return "give a complete ONNX file"
    return "export it again; use an older opset if an operator is unknown"
