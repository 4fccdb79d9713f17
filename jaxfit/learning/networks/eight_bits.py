"""Networks in 8 bits, which run about twice as fast on a CPU; networks in floats remain the base of a training.

Activations have 8 bits, weights 7: with 8, processors without VNNI saturate sums of two products. The first three and
the last convolutions stay in floats: all others depend on the first, whose few channels are quick in floats, and the
few outputs need the accuracy. Last convolutions of one map become one convolution.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from jaxfit.foundation.files import write_whole
from jaxfit.learning.networks.network_files import set_metadata

SUFFIX = "_8bit"
"""End of the name of a network in 8 bits."""
INPUTS = 40
"""Number of frames that give the ranges of the activations."""
FIRST = 3
"""Number of first convolutions in floats. With one, the errors of the built-in segmenter are twice as large, with more
not smaller."""
OPERATORS = ("Conv", "Add", "Concat", "MaxPool", "Relu", "Clip", "Resize")


def write_eight_bits(source: str | Path, inputs: Iterable[np.ndarray], path: str | Path) -> None:
    """Write a network in 8 bits; inputs, outputs and metadata stay as they are.

    Args:
        source: the ONNX file of a network in floats with one input and convolutions with biases.
        inputs: arrays (N, 3, h, w) as tracking passes them to the network. They give the ranges of the activations.
        path: the file to write; an existing file is replaced.
    """
    with TemporaryDirectory() as folder:
        plain, small = Path(folder) / "plain.onnx", Path(folder) / "small.onnx"
        options = onnxruntime.SessionOptions()  # weights become floats of 32 bits, and constants are folded
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(plain)
        onnxruntime.InferenceSession(str(source), options, providers=["CPUExecutionProvider"])
        model = onnx.load(str(plain))
        first = [node.name for node in model.graph.node if node.op_type == "Conv"][:FIRST]
        last = _joined(model, _last_convolutions(model))
        used = [opset for opset in model.opset_import if opset.domain in {node.domain for node in model.graph.node}]
        del model.opset_import[:]  # ONNX Runtime adds all that it knows
        model.opset_import.extend(used)
        onnx.save(model, str(plain))
        logging.getLogger().addFilter(_is_no_advice)  # to optimise the network before, which was done
        try:
            quantize_static(
                str(plain),
                str(small),
                _Inputs(model.graph.input[0].name, inputs),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=list(OPERATORS),
                nodes_to_exclude=[*first, *last],
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                per_channel=True,
                reduce_range=True,
            )
        finally:
            logging.getLogger().removeFilter(_is_no_advice)
        write_whole(path, small.read_bytes())
    set_metadata(path, {"eight_bits_of": Path(source).name})


def _is_no_advice(record: logging.LogRecord) -> bool:
    return "pre-processing before quantization" not in record.getMessage()


class _Inputs(CalibrationDataReader):
    """Single inputs, because the ranges are those of all inputs of a run."""

    def __init__(self, name: str, arrays: Iterable[np.ndarray]):
        self._feeds = ({name: array[n : n + 1]} for array in arrays for n in range(len(array)))

    def get_next(self) -> dict[str, np.ndarray] | None:
        return next(self._feeds, None)


def _last_convolutions(model: onnx.ModelProto) -> list[onnx.NodeProto]:
    """Return the convolutions on which no other convolution depends."""
    leads_on: set[str] = set()  # values on which a convolution depends
    last = []
    for node in reversed(model.graph.node):
        if node.op_type == "Conv" and not leads_on & set(node.output):
            last.append(node)
        if node.op_type == "Conv" or leads_on & set(node.output):
            leads_on |= set(node.input)
    return last[::-1]


def _joined(model: onnx.ModelProto, convolutions: Sequence[onnx.NodeProto]) -> list[str]:
    """Join convolutions of the same map with kernels of the same size; return the names of the convolutions."""
    graph = model.graph
    arrays = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    groups: dict[tuple[str, tuple[int, ...], bytes], list[onnx.NodeProto]] = {}
    for node in convolutions:
        attributes = b"".join(sorted(a.SerializeToString() for a in node.attribute))
        groups.setdefault((node.input[0], arrays[node.input[1]].shape[1:], attributes), []).append(node)
    for nodes in groups.values():
        if len(nodes) == 1:
            continue
        first = nodes[0]
        names = [f"{first.name}_{part}" for part in ("weight", "bias", "sizes", "joined")]
        parts = [np.concatenate([arrays[node.input[i]] for node in nodes]) for i in (1, 2)]
        sizes = np.array([len(arrays[node.input[2]]) for node in nodes])
        added = zip([*parts, sizes], names, strict=False)
        graph.initializer.extend(numpy_helper.from_array(array, name) for array, name in added)
        outputs = [node.output[0] for node in nodes]
        split = helper.make_node("Split", [names[3], names[2]], outputs, f"{first.name}_split", axis=1)
        graph.node.insert(list(graph.node).index(nodes[-1]) + 1, split)
        joined = {name for node in nodes for name in node.input[1:]}
        for part in [part for part in graph.initializer if part.name in joined]:
            graph.initializer.remove(part)
        for node in nodes[1:]:
            graph.node.remove(node)
        first.input[1:], first.output[:] = names[:2], names[3:]
    return [nodes[0].name for nodes in groups.values()]
