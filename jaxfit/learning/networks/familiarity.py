"""Statistics of activations on inputs as in use, stored in the ONNX file.

The module needs the package `onnx`, but not PyTorch. `jaxfit.perception.network` describes the statistics and
reads them.

Inputs of networks as in use, for the statistics of their activations: whole frames, and crops of detected birds. Half
of the pictures have a random appearance, as in the training.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import onnx
from jaxtyping import Float, UInt8
from onnx import TensorProto, helper

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.limits import ACTIVATION_CHANNELS
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.augment import randomise_appearance
from jaxfit.learning.networks.calibration import set_metadata
from jaxfit.learning.networks.labelled_frames import LabelledFrames
from jaxfit.learning.priors import oas_shrinkage
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.network import OUTPUT, ActivationStatistics, Instance, OnnxModel, Segmenter, instance_of
from jaxfit.perception.segmentation import BottomUp, load_segmenter

# pyright: reportMissingImports=false


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
        InputError: fewer than 10 inputs, too many channels, or activations that are not finite or do not vary.
    """
    N, C = activations.shape
    values = activations.astype(np.float64)
    if C > ACTIVATION_CHANNELS:
        problem = f"has {C} channels in its last feature map"
        raise InputError(source, problem, f"the limit is {ACTIVATION_CHANNELS}")
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


LONGER_SIDE_PX = 864
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
    shown = chain.from_iterable(pictures_in_use(frames, count) for frames in sources)
    if which == "segmenter":
        inputs = segmenter_inputs(path, (picture for picture, _ in shown))
    else:
        inputs = keypoint_inputs(
            path, ((p, labelled_birds(owner) if segmenter is None else segmenter(p)) for p, owner in shown)
        )
    store_activations(path, inputs, count * len(sources), progress)


def pictures_in_use(
    frames: LabelledFrames, count: int, seed: int = 0
) -> Iterator[tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]]:
    """Return pictures at even distances and the bird of each pixel; every second picture has a random appearance.

    Args:
        frames: S labelled frames.
        count: number of pictures; a frame is repeated if S is smaller.
        seed: seed of the random appearance.
    """
    for i, s in enumerate(np.linspace(0, len(frames.pictures) - 1, count).round().astype(int).tolist()):
        picture, owner = np.asarray(frames.pictures[s]), np.asarray(frames.owner[s])
        if i % 2:
            zoom = LONGER_SIDE_PX / max(picture.shape[:2])
            picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
            owner = cv2.resize(owner, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            rng = np.random.default_rng((seed, i))
            picture = randomise_appearance(rng, np.asarray(picture, np.uint8), np.asarray(owner) > 0)
        yield picture, np.asarray(owner, np.uint8)


def labelled_birds(owner: UInt8[np.ndarray, "H W"]) -> list[Instance]:
    """Return the labelled birds of a picture as a segmenter would report the birds."""
    birds = (instance_of(owner == n, 1.0, "bird") for n in np.unique(owner[owner > 0]))
    return [bird for bird in birds if bird is not None]


def segmenter_inputs(path: str | Path, pictures: Iterable[UInt8[np.ndarray, "H W 3"]]) -> Iterator[np.ndarray]:
    """Return the inputs (1, 3, h, w) of a bottom-up segmenter for whole frames.

    Raises:
        InputError: the file is no bottom-up segmenter.
    """
    segmenter = load_segmenter(path, kind="bottom_up")
    assert isinstance(segmenter, BottomUp)
    for picture in pictures:
        yield segmenter.network_input(picture)[0]


def keypoint_inputs(
    path: str | Path, pictures: Iterable[tuple[UInt8[np.ndarray, "H W 3"], Sequence[Instance]]]
) -> Iterator[np.ndarray]:
    """Return the inputs (N, 3, h, w) of a keypoint network for pictures and their birds.

    Raises:
        InputError: the file is no keypoint network.
    """
    detector = load_keypoint_detector(path)
    for picture, birds in pictures:
        if birds:
            yield detector.network_input(picture, birds, range(len(birds)))[0]
