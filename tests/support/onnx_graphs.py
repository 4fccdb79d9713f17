"""Small ONNX networks with the layouts of exporters and known contents."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 17


def write_graph(
    path: Path,
    inputs: Mapping[str, Sequence],
    outputs: Mapping[str, Sequence],
    nodes: Sequence[onnx.NodeProto],
    constants: Mapping[str, np.ndarray] | None = None,
    metadata: Mapping[str, str] | None = None,
    kind: int = TensorProto.FLOAT,
    output_kinds: Mapping[str, int] | None = None,
) -> Path:
    """Write a graph from names and shapes (a word or None for a variable side); outputs are floats by default."""
    kinds = dict.fromkeys(outputs, TensorProto.FLOAT) | dict(output_kinds or {})
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, kinds[name], shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def write_constant(
    path: Path,
    input_shape: Sequence,
    outputs: Mapping[str, np.ndarray],
    metadata: Mapping[str, str] | None = None,
    kind: int = TensorProto.FLOAT,
) -> Path:
    """Write a network with the same outputs for every picture; `outputs` have no batch axis."""
    nodes = [
        helper.make_node("Cast", ["input"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["numbers"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["zeros"]),
    ]
    constants = {"zero": np.zeros((), np.float32)}
    for name, value in outputs.items():
        constants[f"{name}_value"] = np.asarray(value, np.float32)[None]
        constants[f"{name}_shape"] = np.array([-1] + [1] * np.ndim(value))
        nodes.append(helper.make_node("Reshape", ["zeros", f"{name}_shape"], [f"{name}_zeros"]))
        nodes.append(helper.make_node("Add", [f"{name}_value", f"{name}_zeros"], [name]))
    shapes = {name: (input_shape[0], *np.shape(value)) for name, value in outputs.items()}
    return write_graph(path, {"input": input_shape}, shapes, nodes, constants, metadata, kind)


def write_reading(
    path: Path,
    input_shape: Sequence,
    outputs: Mapping[str, np.ndarray],
    read: Mapping[str, Mapping[tuple[int, ...], tuple[int, ...]]],
    metadata: Mapping[str, str] | None = None,
    kind: int = TensorProto.FLOAT,
) -> Path:
    """Write a network whose outputs are constant, except for values copied from the input.

    `read`: output → index into the output → index into the input.
    """
    nodes, constants = [helper.make_node("Cast", ["images"], ["numbers"], to=TensorProto.FLOAT)], {}
    for name, value in outputs.items():
        constants[f"{name}_value"] = np.asarray(value, np.float32)
        if name not in read:
            nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
            continue
        constants[f"{name}_to"] = np.array(list(read[name]), np.int64)
        constants[f"{name}_from"] = np.array(list(read[name].values()), np.int64)
        nodes.append(helper.make_node("GatherND", ["numbers", f"{name}_from"], [f"{name}_read"]))
        nodes.append(helper.make_node("ScatterND", [f"{name}_value", f"{name}_to", f"{name}_read"], [name]))
    shapes = {name: np.shape(value) for name, value in outputs.items()}
    return write_graph(path, {"images": input_shape}, shapes, nodes, constants, metadata, kind)
