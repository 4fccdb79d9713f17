"""Trained networks as ONNX files that need nothing but ONNX Runtime."""

# pyright: reportMissingImports=false

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from jaxfit.storage.files import write_whole

__all__ = ["export_onnx"]

OPSET = 18
LARGE = 256
"""Arrays of fewer numbers are kept in 32 bits."""


def export_onnx(
    network: nn.Module,
    example: torch.Tensor,
    free: Mapping[int, str],
    outputs: tuple[str, ...],
    metadata: Mapping[str, str],
    path: str | Path,
) -> None:
    """Write a network whole, its weights in 16 bits, which halves the file and changes no result that matters.

    Args:
        network: maps one tensor to tensors, in evaluation mode.
        example: an input.
        free: axes of the input whose length is free, with a name each.
        outputs: names of the outputs, in their order.
        metadata: kept in the file; what a reader needs to know of input and output.
        path: an `.onnx` file, replaced if it exists.
    """
    shapes = {axis: torch.export.Dim.DYNAMIC for axis in free}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter's own making
        program = torch.onnx.export(
            network,
            (example,),
            input_names=["pictures"],
            output_names=list(outputs),
            opset_version=OPSET,
            dynamic_shapes=(shapes,),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _halve(model)
    for axis, name in free.items():
        model.graph.input[0].type.tensor_type.shape.dim[axis].dim_param = name
    del model.metadata_props[:]
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]  # the exporter's paths
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString())


def _halve(model: onnx.ModelProto) -> None:
    """Keep large weights in 16 bits; ONNX Runtime widens them once, when it loads the file."""
    casts = []
    for weight in model.graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < LARGE:
            continue
        name = weight.name
        weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_16"))
        casts.append(helper.make_node("Cast", [f"{name}_16"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
