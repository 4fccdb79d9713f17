"""ONNX networks on a CPU."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.errors import InputError

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
        InputError: the file does not exist, is not ONNX, lacks its external data, or contains an unknown operator.
    """

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]
    """The exporter's metadata, such as `names` (Ultralytics)."""

    def __init__(self, path: str | Path, threads: int | None = None):
        import onnxruntime as ort

        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(path, "does not exist", "give an ONNX file")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # the error below reports the problem
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # the errors of ONNX Runtime have no common base class
            raise InputError(path, f"cannot be loaded: {_shorten(error)}", _remedy(str(error))) from error
        self.inputs = tuple(_read_port(value) for value in self._session.get_inputs())
        self.outputs = tuple(_read_port(value) for value in self._session.get_outputs())
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)

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
