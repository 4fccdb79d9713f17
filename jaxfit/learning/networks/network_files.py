"""Networks ↔ ONNX files: export with outputs and metadata, weights as a start.

The export folds every batch normalisation into its convolution. So the convolution takes the folded weights, and the
normalisation becomes the addition of the bias: mean 0, variance 1. The normalisations must stay in evaluation mode
during the training; their scales and biases are trained.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from jaxfit.data.keypoint_names import propose_names
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.learning.networks import keypoints
from jaxfit.learning.networks.keypoints import CROPS, keypoint_network
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.segmenter import segmenter_network
from jaxfit.perception.keypoints import BUILTIN_PATH, CropSettings
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import BUILTIN, LONGER_SIDE_PX, BottomUp

# pyright: reportMissingImports=false


OPSET = 18
MIN_HALF_SIZE = 256
"""Arrays with fewer elements stay in 32 bits."""


def export_onnx(
    network: nn.Module,
    example: torch.Tensor,
    variable_axes: Mapping[int, str],
    outputs: tuple[str, ...],
    metadata: Mapping[str, str],
    path: str | Path,
) -> None:
    """Write a network to an ONNX file, with weights in 16 bits: the file is half as large, with equivalent results.

    Args:
        network: a module in evaluation mode that maps one tensor to tensors, without operations that depend on the
            lengths of the variable axes. The exporter needs five times as long if it has to derive these lengths.
        example: an input.
        variable_axes: axis → name of the input's axes of variable length.
        outputs: names of the outputs, in their order.
        metadata: metadata of the file, which describes input and output.
        path: an `.onnx` file; an existing file is replaced.
    """
    with _quiet_exporter():
        program = torch.onnx.export(
            network,
            (example,),
            input_names=["pictures"],
            output_names=list(outputs),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _convert_weights(model)
    for axis, name in variable_axes.items():
        model.graph.input[0].type.tensor_type.shape.dim[axis].dim_param = name
    for output in model.graph.output:
        output.type.tensor_type.ClearField("shape")  # that of the example
    del model.graph.value_info[:]
    model = onnx.shape_inference.infer_shapes(model)
    del model.metadata_props[:]
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]  # the exporter writes local paths into it
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString())


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Hide the warnings of the exporter itself, for example that torchvision is not installed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _convert_weights(model: onnx.ModelProto) -> None:
    """Convert large weights to 16 bits; ONNX Runtime converts them back once, when it loads the file."""
    casts = []
    for weight in model.graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size < MIN_HALF_SIZE:
            continue
        name = weight.name
        weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_16"))
        casts.append(helper.make_node("Cast", [f"{name}_16"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


# pyright: reportMissingImports=false


class Probabilities(nn.Module):
    """The exported segmenter: probabilities, centres and offsets."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute foreground, centre and offset from pictures (B, 3, H, W)."""
        maps = self.network(pictures)
        return torch.sigmoid(maps["foreground"]), maps["centre"], maps["offset"]


def write_segmenter(
    network: nn.Module, facts: Mapping[str, str], path: str | Path, longer_side_px: int = LONGER_SIDE_PX
) -> None:
    """Write a segmenter to an ONNX file.

    Args:
        network: the trained network.
        facts: metadata about the training.
        path: the `.onnx` file; an existing file is replaced.
        longer_side_px: longer side of the pictures that the network expects.
    """
    metadata = {"names": repr({0: "bird"}), "longer_side": str(longer_side_px), **facts}
    outputs = ("foreground", "centre", "offset")
    example, axes = torch.rand(1, 3, 256, 320), {2: "height", 3: "width"}
    export_onnx(Probabilities(network).eval(), example, axes, outputs, metadata, path)


def write_keypoints(
    network: nn.Module,
    names: Sequence[str],
    facts: Mapping[str, str],
    path: str | Path,
    crops: CropSettings = CROPS,
) -> None:
    """Write a keypoint network to an ONNX file.

    Args:
        network: the trained network.
        names: names of the keypoints, without commas.
        facts: metadata about the training.
        path: the `.onnx` file; an existing file is replaced.
        crops: the crops of the training.
    """
    side = keypoints.SIDE_PX
    metadata = {
        "keypoint_names": ",".join(names),
        "mean": "0",
        "std": "255",
        "colour": "bgr",
        "input_size": f"{side},{side}",
        **{key: str(value) for key, value in crops._asdict().items()},
        **facts,
    }
    exported = keypoints.KeypointMaps(network, len(names)).eval()
    export_onnx(exported, torch.rand(2, 3, side, side), {0: "birds"}, ("heatmaps",), metadata, path)


# pyright: reportMissingImports=false


_REMEDY = "give `builtin`, or a network that this version of `jaxfit train` wrote"
_OTHER_LAYOUT = "is a network of another layout than that of `jaxfit train"


def base_file(which: str, base: str | Path) -> Path:
    """Return the file of a base network: `builtin`, or an ONNX file."""
    builtin = {"segmenter": BUILTIN, "keypoints": BUILTIN_PATH}[which]
    return builtin if str(base) == "builtin" else Path(base)


def load_segmenter_base(path: Path) -> FeaturePyramid:
    """Load a segmenter that `jaxfit train segmenter` wrote.

    Raises:
        InputError: the file cannot be read, or is a network of another layout.
    """
    if not BottomUp.fits(OnnxModel(path)):
        raise InputError(path, f"{_OTHER_LAYOUT} segmenter`", _REMEDY)
    network = segmenter_network()
    _load_weights(network, _weights(path), path, "segmenter")
    return network


def load_keypoint_base(path: Path, names: Sequence[str]) -> tuple[FeaturePyramid, tuple[str, ...]]:
    """Load a keypoint network that `jaxfit train keypoints` wrote, for keypoints of other names and number.

    The last layer of a keypoint is copied from the keypoint of the same name in the file, by `propose_names`. Without a
    counterpart, a keypoint gets a new last layer with random initial weights.

    Args:
        path: the ONNX file.
        names: names of the K keypoints of the new network.

    Returns:
        The network, and for each of the K keypoints the name in the file, or an empty text.

    Raises:
        InputError: the file cannot be read, or is a network of another layout.
    """
    own = tuple(OnnxModel(path).metadata.get("keypoint_names", "").split(","))
    weights = _weights(path)
    head = "network.heads.logits"
    shapes = {name: weights[name].shape for name in (f"{head}.weight", f"{head}.bias") if name in weights}
    if set(shapes.values()) != {(len(own), 64, 3, 3), (len(own),)}:
        raise InputError(path, f"{_OTHER_LAYOUT} keypoints`", _REMEDY)
    network = keypoint_network(len(names))
    found = propose_names(names, own).mapped
    for key in (f"{head}.weight", f"{head}.bias"):
        values = network.state_dict()[key.removeprefix("network.")].numpy().copy()
        for k, name in enumerate(names):
            if name in found:
                values[k] = weights[key][own.index(found[name])]
        weights[key] = values
    _load_weights(network, weights, path, "keypoints")
    return network, tuple(found.get(name, "") for name in names)


def freeze_normalisation(network: nn.Module) -> None:
    """Put all batch normalisations into evaluation mode; call this after every `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def _weights(path: Path) -> dict[str, np.ndarray]:
    """Return the weights of an ONNX file by name; weights in 16 bits lose the suffix of their name."""
    try:
        graph = onnx.load(str(path), load_external_data=False).graph
        stored = [weight for weight in graph.initializer if weight.data_location != TensorProto.EXTERNAL]
        return {weight.name.removesuffix("_16"): numpy_helper.to_array(weight) for weight in stored}
    except (ValueError, TypeError, OSError) as error:  # the errors of a damaged array
        raise InputError(path, "holds weights that cannot be read", _REMEDY) from error


def _load_weights(network: nn.Module, weights: dict[str, np.ndarray], path: Path, which: str) -> None:
    """Fill a network with folded weights."""
    state = network.state_dict()
    for convolution, norm in _layers(network):
        bias = f"{convolution}.bias" if norm is None else f"{convolution}.weight_bias"
        for name, target in ((f"{convolution}.weight", f"{convolution}.weight"), (bias, f"{norm or convolution}.bias")):
            value = weights.get(f"network.{name}")
            if value is None or value.shape != tuple(state[target].shape) or not np.isfinite(value).all():
                raise InputError(path, f"{_OTHER_LAYOUT} {which}`: it lacks fitting weights {name}", _REMEDY)
            state[target] = torch.from_numpy(value.astype(np.float32))
        if norm is not None:
            layer = network.get_submodule(norm)
            assert isinstance(layer, nn.BatchNorm2d)
            state[f"{norm}.weight"] = torch.full_like(state[f"{norm}.weight"], math.sqrt(1 + layer.eps))
            state[f"{norm}.running_mean"] = torch.zeros_like(state[f"{norm}.running_mean"])
            state[f"{norm}.running_var"] = torch.ones_like(state[f"{norm}.running_var"])
    network.load_state_dict(state)
    network.eval()


def _layers(network: nn.Module) -> Iterator[tuple[str, str | None]]:
    """Yield every convolution with the batch normalisation that follows it, or None: the order of the modules."""
    before: str | None = None
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            if before is not None:
                yield before, None
            before = name
        elif isinstance(module, nn.BatchNorm2d) and before is not None:
            yield before, name
            before = None
    if before is not None:
        yield before, None
