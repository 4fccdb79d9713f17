"""ONNX networks on a CPU: loaded with one clear error, run by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.errors import InputError

__all__ = ["OnnxModel", "Port"]


class Port(NamedTuple):
    """An input or output as the file declares it."""

    name: str
    shape: tuple[int | None, ...]
    """None where the length is free."""
    kind: str
    """ONNX Runtime's name of the type, such as `tensor(float)`."""

    def __str__(self) -> str:
        return f"{self.name} ({', '.join('?' if side is None else str(side) for side in self.shape)})"


class OnnxModel:
    """A network in a file.

    Args:
        path: the `.onnx` file.
        threads: cores that one run may use; None takes all.

    Raises:
        InputError: no such file, no ONNX, its external data missing, an operator that ONNX Runtime lacks.
    """

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]
    """What whoever exported it wrote beside the graph, such as `names` (Ultralytics)."""

    def __init__(self, path: str | Path, threads: int | None = None):
        import onnxruntime as ort

        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(path, "does not exist", "give an ONNX file")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # what is wrong is said once, below
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's errors share no base class of their own
            raise InputError(path, f"cannot be loaded: {_brief(error)}", _remedy(str(error))) from error
        self.inputs = tuple(_port(value) for value in self._session.get_inputs())
        self.outputs = tuple(_port(value) for value in self._session.get_outputs())
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)

    def __call__(self, *inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Run the network once.

        Args:
            inputs: one array for each input, in their order.

        Returns:
            Name → array of every output.

        Raises:
            InputError: the network refuses what it is given.
        """
        names = [port.name for port in self.outputs]
        feed = {port.name: value for port, value in zip(self.inputs, inputs, strict=True)}
        try:
            values: Any = self._session.run(names, feed)
        except Exception as error:
            raise InputError(self.path, f"cannot be run: {_brief(error)}", "its layout may be another one") from error
        return dict(zip(names, values, strict=True))

    def describe(self) -> str:
        """Inputs and outputs with their shapes, for messages."""
        return f"{', '.join(map(str, self.inputs))} → {', '.join(map(str, self.outputs))}"


def _port(value: Any) -> Port:
    return Port(value.name, tuple(side if isinstance(side, int) else None for side in value.shape), value.type)


def _brief(error: Exception) -> str:
    return " ".join(str(error).split(" : ")[-1].split())[:300]


def _remedy(text: str) -> str:
    lowered = text.lower()
    if "external" in lowered or "model_path" in lowered or "file_size" in lowered:
        return "put the file with its external data (often `….onnx.data`) beside it, under its first name"
    if "protobuf" in lowered:
        return "it is no ONNX file, or was cut short"
    return "export it again, for an older opset if an operator is unknown"
