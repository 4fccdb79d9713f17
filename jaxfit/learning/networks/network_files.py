"""Networks ↔ ONNX files: export with outputs and metadata, weights as a start, statistics of activations.

The export folds every batch normalisation into its convolution. So the convolution takes the folded weights, and the
normalisation becomes the addition of the bias: mean 0, variance 1. The normalisations must stay in evaluation mode
during the training; their scales and biases are trained.

`jaxfit.perception.network` describes the statistics of activations and reads them. They are measured on inputs as in
use: whole frames, and crops of detected birds. Half of the pictures have a random appearance, as in the training.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from jaxtyping import Float
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from jaxfit.data.keypoint_names import propose_names
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints, outlines
from jaxfit.learning.networks.augment import randomise_appearance
from jaxfit.learning.networks.keypoints import CROPS, keypoint_network
from jaxfit.learning.networks.labelled_frames import LabelledFrames
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.segmenter import segmenter_network
from jaxfit.learning.priors import oas_shrinkage
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception.keypoints import CropSettings, load_keypoint_detector
from jaxfit.perception.network import OUTPUT, ActivationStatistics, OnnxModel, Segmenter, instance_of
from jaxfit.perception.segmentation import BUILTIN, LONGER_SIDE_PX, BottomUp, load_segmenter

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
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
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


class Probabilities(nn.Module):
    """The exported segmenter: probabilities, centres and offsets."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute foreground, centre and offset from pictures (B, 3, H, W)."""
        maps = self.network(pictures)
        return torch.sigmoid(maps["foreground"]), maps["centre"], maps["offset"]


def write_network(
    which: str,
    network: nn.Module,
    facts: Mapping[str, str],
    path: str | Path,
    names: Sequence[str] = MURRE_KEYPOINTS,
    longer_side_px: int = LONGER_SIDE_PX,
    crops: CropSettings = CROPS,
) -> None:
    """Write a trained network to an ONNX file.

    Args:
        which: `segmenter`, `keypoints` or `outline`.
        network: the trained network.
        facts: metadata about the training.
        path: the `.onnx` file; an existing file is replaced.
        names: names of the keypoints of a keypoint network, without commas.
        longer_side_px: longer side of the pictures that a segmenter expects.
        crops: the crops of the training of a keypoint network.
    """
    if which == "segmenter":
        metadata = {"names": repr({0: "bird"}), "longer_side": str(longer_side_px), **facts}
        outputs = ("foreground", "centre", "offset")
        example, axes = torch.rand(1, 3, 256, 320), {2: "height", 3: "width"}
        export_onnx(Probabilities(network).eval(), example, axes, outputs, metadata, path)
        return
    is_outline = which == "outline"
    side = outlines.SIDE_PX if is_outline else keypoints.SIDE_PX
    metadata = {
        "keypoint_names": ",".join(names),
        "mean": "0",
        "std": "255",
        "colour": "bgr",
        "input_size": f"{side},{side}",
        **{key: str(value) for key, value in crops._asdict().items()},
        **facts,
    }
    exported = outlines.OutlineMaps(network) if is_outline else keypoints.KeypointMaps(network, len(names))
    export_onnx(exported.eval(), torch.rand(2, 3, side, side), {0: "birds"}, ("heatmaps",), metadata, path)


_REMEDY = "give `builtin`, or a network that this version of `jaxfit train` wrote"
_OTHER_LAYOUT = "is a network of another layout than that of `jaxfit train"


def base_file(which: str, base: str | Path) -> Path:
    """Return the file in floats of a base network: `builtin`, or an ONNX file."""
    return BUILTIN.with_name(f"{which}.onnx") if str(base) == "builtin" else Path(base)


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
    stored_names = tuple(OnnxModel(path).metadata.get("keypoint_names", "").split(","))
    weights = _weights(path)
    head = "network.heads.logits"
    shapes = {name: weights[name].shape for name in (f"{head}.weight", f"{head}.bias") if name in weights}
    if set(shapes.values()) != {(len(stored_names), 64, 3, 3), (len(stored_names),)}:
        raise InputError(path, f"{_OTHER_LAYOUT} keypoints`", _REMEDY)
    network = keypoint_network(len(names))
    counterparts = propose_names(names, stored_names).mapped
    for key in (f"{head}.weight", f"{head}.bias"):
        values = network.state_dict()[key.removeprefix("network.")].numpy().copy()
        for k, name in enumerate(names):
            if name in counterparts:
                values[k] = weights[key][stored_names.index(counterparts[name])]
        weights[key] = values
    _load_weights(network, weights, path, "keypoints")
    return network, tuple(counterparts.get(name, "") for name in names)


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


def set_metadata(path: str | Path, entries: Mapping[str, str]) -> None:
    """Set entries of the metadata of an ONNX file; other entries and the network do not change."""
    model = onnx.load(str(path))
    kept = {entry.key: entry.value for entry in model.metadata_props}
    helper.set_model_props(model, kept | dict(entries))
    write_whole(path, model.SerializeToString())


INSIDE = 0.99
"""Share of the training inputs whose distance is below 1."""
MIN_VARIANCE = 1e-3
"""Least variance of a direction of the activations, as a share of the mean variance."""
MIN_INPUTS = 10
"""Least number of training inputs."""


def store_activations(
    path: str | Path, inputs: Iterable[np.ndarray], count: int | None = None, progress: ProgressTask = silent
) -> ActivationStatistics:
    """Add the output `activations` to a network, run the network over training inputs, and store the statistics.

    The other outputs do not change. Statistics that the file already holds are replaced.

    Args:
        path: the ONNX file of a network with one input; it is replaced.
        inputs: arrays (N, 3, h, w) as tracking passes them to the network: whole frames for a segmenter, crops of
            single birds for a keypoint network.
        count: number of arrays, for the progress.
        progress: reports every array.

    Returns:
        The stored statistics.

    Raises:
        InputError: the file is no usable network, or there are fewer than 10 inputs.
    """
    arrays = iter(inputs)
    first = next(arrays, None)
    if first is None:
        raise InputError(path, "has no training inputs for the statistics of activations", "give at least 10 inputs")
    add_activation_output(path)
    network = OnnxModel(path)
    activations = [network(first)[OUTPUT]]
    with progress("Measuring activations", count) as report_progress:
        report_progress(1, "")
        for array in arrays:
            activations.append(network(array)[OUTPUT])
            report_progress(1, "")
    statistics = activation_statistics(np.concatenate(activations), path)
    set_metadata(path, statistics.metadata())
    return statistics


def activation_statistics(activations: Float[np.ndarray, "N C"], source: object = "inputs") -> ActivationStatistics:
    """Compute the mean and the whitening matrix of activations.

    The covariance is shrunk towards a multiple of the identity (`oas_shrinkage`), so that a few inputs suffice.

    Args:
        activations: one row for each training input.
        source: the network, for messages.

    Raises:
        InputError: fewer than 10 inputs, or activations that are not finite or do not vary.
    """
    N, C = activations.shape
    values = activations.astype(np.float64)
    if N < MIN_INPUTS or not np.isfinite(values).all() or not values.var(0).any():
        problem = f"has no usable activations in {N} inputs"
        raise InputError(source, problem, f"give at least {MIN_INPUTS} different inputs with finite numbers")
    mean = values.mean(0)
    covariance = np.atleast_2d(np.cov(values, rowvar=False, bias=True))
    variance = np.trace(covariance) / C
    shrinkage = oas_shrinkage(covariance, N) if C > 1 else 0.0
    covariance = (1 - shrinkage) * covariance + shrinkage * variance * np.eye(C)
    eigenvalues, directions = np.linalg.eigh(covariance)
    whitening = directions.T / np.sqrt(np.maximum(eigenvalues, MIN_VARIANCE * variance))[:, None]
    unscaled = ActivationStatistics(mean, whitening)
    return ActivationStatistics(mean, whitening / np.quantile(unscaled.distance(values), INSIDE))


def add_activation_output(path: str | Path) -> None:
    """Add the output `activations` (N, C) to a network: its last feature map, averaged over the cells.

    The last feature map is the result of the last Relu of the graph. A network of `jaxfit train` computes its outputs
    from this map. On simulated footage and on pictures without birds, this map separated known from unknown pictures
    better than the map with the coarsest resolution. A network that has the output does not change.

    Raises:
        InputError: the network has no Relu.
    """
    model = onnx.load(str(path))
    if OUTPUT in {output.name for output in model.graph.output}:
        return
    maps = [node.output[0] for node in model.graph.node if node.op_type == "Relu"]
    if not maps:
        raise InputError(path, "has no feature map after a Relu", "give a network of convolutions with Relu")
    model.graph.node.append(helper.make_node("GlobalAveragePool", [maps[-1]], [f"{OUTPUT}_map"]))
    model.graph.node.append(helper.make_node("Flatten", [f"{OUTPUT}_map"], [OUTPUT], axis=1))
    model.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [None, None]))
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString())


APPEARANCE_SIDE_PX = 864
"""Longer side of the pictures with a random appearance; blur and noise have the scale of the training there."""
MAX_PICTURES = 200
"""Number of pictures; more pictures hardly change the statistics."""


def store_training_activations(
    which: str,
    path: str | Path,
    sources: Sequence[LabelledFrames],
    segmenter: Segmenter | None = None,
    progress: ProgressTask = silent,
) -> None:
    """Store the statistics of the activations of a trained network over its training pictures.

    The pictures lie at even distances, and every second picture has a random appearance.

    Args:
        which: `segmenter` or `keypoints`.
        path: the ONNX file; it is replaced.
        sources: the training frames; every source gives the same number of pictures.
        segmenter: detects the birds for a keypoint network; None takes the labelled birds.
        progress: reports every picture.

    Raises:
        InputError: the file is no such network, or the pictures show fewer than 10 birds.
    """
    count = MAX_PICTURES // len(sources)
    store_activations(path, training_inputs(which, path, sources, segmenter, count), count * len(sources), progress)


def training_inputs(
    which: str, path: str | Path, sources: Sequence[LabelledFrames], segmenter: Segmenter | None, count: int
) -> Iterator[np.ndarray]:
    """Yield the inputs of a network for some pictures: whole frames, or the crops of all birds of a frame."""
    whole = load_segmenter(path, kind="bottom_up") if which == "segmenter" else None
    detector = load_keypoint_detector(path) if which == "keypoints" else None
    for frames in sources:
        for i, s in enumerate(np.linspace(0, len(frames.pictures) - 1, count).round().astype(int).tolist()):
            picture, owner = np.asarray(frames.pictures[s]), np.asarray(frames.owner[s])
            if i % 2:
                zoom = APPEARANCE_SIDE_PX / max(picture.shape[:2])
                picture = np.asarray(cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA))
                owner = np.asarray(cv2.resize(owner, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST))
                picture = randomise_appearance(np.random.default_rng((0, i)), picture, owner > 0)
            if isinstance(whole, BottomUp):
                yield whole.network_input(picture)[0]
            elif detector is not None:
                labelled = (instance_of(owner == n, 1.0, "bird") for n in np.unique(owner[owner > 0]))
                birds = [bird for bird in labelled if bird] if segmenter is None else segmenter(picture)
                if birds:
                    yield detector.network_input(picture, birds, range(len(birds)))[0]
