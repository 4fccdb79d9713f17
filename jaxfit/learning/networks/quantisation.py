"""Networks with integers of 8 bits, which run faster: static quantisation, calibrated on inputs as in use.

Every feature map becomes integers of 8 bits with one scale and one zero point, every weight becomes an integer of
7 bits with one scale for each output channel. With 7 bits, results are equal on processors with and without VNNI,
because sums of products do not exceed 16 bits. The convolutions after the last feature map stay floats: their outputs
are the results.

A quantised network is no base of a further training, so keep the file of the floats. The module needs the package
`onnx`, but not PyTorch.

    python -m jaxfit.learning.networks.quantisation segmenter.onnx quantised.onnx footage.mp4
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from jaxtyping import UInt8
from onnx import helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.learning.networks.calibration import set_metadata
from jaxfit.learning.networks.familiarity import keypoint_inputs, segmenter_inputs
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import BottomUp, load_segmenter
from jaxfit.video.reader import read_frames

# pyright: reportMissingImports=false


QUANTISED = ["Conv", "Add", "Relu", "Clip", "Resize"]
"""Types of the nodes that compute with integers."""


def quantise(path: str | Path, out: str | Path, inputs: Sequence[np.ndarray]) -> None:
    """Write a network with integers of 8 bits; its metadata do not change.

    Statistics of activations in the metadata belong to the floats; `store_activations` replaces them.

    Args:
        path: the ONNX file of a network that `jaxfit train` wrote.
        out: the ONNX file to write; an existing file is replaced.
        inputs: arrays (N, 3, h, w) as tracking passes them to the network. Ten frames suffice.

    Raises:
        InputError: there are no inputs, or the file is no network of `jaxfit train`.
    """
    if not inputs:
        raise InputError(path, "has no inputs for the quantisation", "give frames with birds")
    network = OnnxModel(path)
    model = onnx.load(str(path))
    convert_to_floats(model)
    last = max((i for i, node in enumerate(model.graph.node) if node.op_type == "Relu"), default=None)
    if last is None:
        raise InputError(path, "has no feature map after a Relu", "give a network that `jaxfit train` wrote")
    merge_heads(model)
    results = [node.name for node in model.graph.node[last + 1 :] if node.op_type == "Conv"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "quantised.onnx"
        quantize_static(
            model,
            str(file),
            _Inputs(network.inputs[0].name, inputs),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=QUANTISED,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=results,
            extra_options={"CalibMovingAverage": True},
        )
        write_whole(out, file.read_bytes())
    set_metadata(out, network.metadata)


class _Inputs(CalibrationDataReader):
    """The inputs of the calibration, one after another."""

    def __init__(self, name: str, inputs: Sequence[np.ndarray]):
        self._feeds = iter([{name: array} for array in inputs])

    def get_next(self) -> dict[str, np.ndarray] | None:
        return next(self._feeds, None)


def convert_to_floats(model: onnx.ModelProto) -> None:
    """Replace the weights in 16 bits and their casts by weights in 32 bits."""
    graph = model.graph
    stored = {weight.name: weight for weight in graph.initializer}
    casts = [node for node in graph.node if node.op_type == "Cast" and node.input[0] in stored]
    for cast in casts:
        values = numpy_helper.to_array(stored[cast.input[0]])
        data_type = helper.get_node_attr_value(cast, "to")
        graph.initializer.append(
            numpy_helper.from_array(values.astype(helper.tensor_dtype_to_np_dtype(data_type)), cast.output[0])
        )
        graph.node.remove(cast)
    for name in {cast.input[0] for cast in casts}:
        graph.initializer.remove(stored[name])


def merge_heads(model: onnx.ModelProto) -> None:
    """Replace the convolutions `network.heads` by one convolution and a split, which is faster; results are equal.

    ONNX Runtime computes at least eight channels, so that three convolutions of one or two channels take three times
    as long as one convolution.
    """
    graph = model.graph
    weights = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    heads = [node for node in graph.node if node.op_type == "Conv" and node.input[1].startswith("network.heads.")]
    if len(heads) < 2:
        return
    kernels, biases = ([weights[head.input[i]] for head in heads] for i in (1, 2))
    sizes = np.array([len(bias) for bias in biases], np.int64)
    for name, values in (("weight", np.concatenate(kernels)), ("bias", np.concatenate(biases)), ("sizes", sizes)):
        graph.initializer.append(numpy_helper.from_array(values, f"heads.{name}"))
    place = list(graph.node).index(heads[0])
    merged = onnx.NodeProto()
    merged.CopyFrom(heads[0])
    merged.name = "heads"
    merged.input[1:] = ["heads.weight", "heads.bias"]
    merged.output[:] = ["heads.maps"]
    outputs = [head.output[0] for head in heads]
    graph.node.insert(place, merged)
    graph.node.insert(place + 1, helper.make_node("Split", ["heads.maps", "heads.sizes"], outputs, "split", axis=1))
    for head in heads:
        graph.node.remove(head)
    unused = {name for head in heads for name in head.input[1:]}
    for weight in [weight for weight in graph.initializer if weight.name in unused]:
        graph.initializer.remove(weight)


def calibration_inputs(path: Path, pictures: Sequence[UInt8[np.ndarray, "H W 3"]]) -> Iterator[np.ndarray]:
    """Yield the inputs of a segmenter or of a keypoint network for whole frames.

    The built-in segmenter detects the birds for a keypoint network.

    Raises:
        InputError: the file is no network of these two kinds.
    """
    if BottomUp.fits(OnnxModel(path)):
        return segmenter_inputs(path, pictures)
    segmenter = load_segmenter("builtin")
    return keypoint_inputs(path, ((picture, segmenter(picture)) for picture in pictures))


def main() -> None:
    """Quantise a network on frames of a video."""
    parser = argparse.ArgumentParser(description="Write a network with integers of 8 bits.")
    parser.add_argument("network", type=Path, help="ONNX file of jaxfit train")
    parser.add_argument("out", type=Path, help="ONNX file to write")
    parser.add_argument("videos", type=Path, nargs="+", help="footage that resembles the footage in use")
    parser.add_argument("--frames", type=int, default=10, help="number of frames of all videos")
    options = parser.parse_args()
    count = -(-options.frames // len(options.videos))
    pictures = [frame.picture for video in options.videos for frame in read_frames(video, 0, count)]
    quantise(options.network, options.out, list(calibration_inputs(options.network, pictures)))


if __name__ == "__main__":
    main()
