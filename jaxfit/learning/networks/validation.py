"""Accuracy of a network on held-out pictures, measured as `jaxfit track` and `jaxfit evaluate` use the network."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from jaxfit.data.observations import Observations
from jaxfit.evaluation.detection import assign, average_precision, overlap
from jaxfit.learning.networks.keypoints import SIDE_PX, STRIDE
from jaxfit.learning.networks.label_data import Scale, owner_of
from jaxfit.learning.networks.labels import LabelledPicture, StoredPicture
from jaxfit.perception.keypoint_layouts import HeatmapLayout, KeypointInput
from jaxfit.perception.keypoints import OnnxKeypoints
from jaxfit.perception.network import Instance, KeypointDetector, OnnxModel, Port, Segmenter, instance_of
from jaxfit.perception.segmentation import BottomUp

CROPS = 16
"""Number of crops in one run of a keypoint network."""


class _TorchModel(OnnxModel):
    """A PyTorch network with the interface of an ONNX file, so that the same code reads its outputs."""

    def __init__(
        self,
        run: Callable[[Tensor], Sequence[Tensor]],
        device: torch.device,
        outputs: Sequence[str],
        metadata: Mapping[str, str],
    ):
        self.path, self.metadata = Path("network in training"), metadata
        self.inputs = (Port("pictures", (1, 3, None, None), "tensor(float)"),)
        self.outputs = tuple(Port(name, (None,) * 4, "tensor(float)") for name in outputs)
        self._run = run
        self._device = device

    def __call__(self, *inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Run the network once, as `OnnxModel`."""
        with torch.inference_mode():
            values = self._run(torch.from_numpy(inputs[0]).to(self._device))
        return {port.name: value.cpu().numpy() for port, value in zip(self.outputs, values, strict=True)}


def _device(network: nn.Module) -> torch.device:
    return next(network.parameters()).device


def torch_segmenter(network: nn.Module, longer_side_px: int) -> BottomUp:
    """Return the segmenter of a network in training; `network` returns the exported outputs."""
    model = _TorchModel(
        network, _device(network), ("foreground", "centre", "offset"), {"longer_side": str(longer_side_px)}
    )
    return BottomUp(model, names=["bird"])


def keypoint_detector(network: nn.Module, names: Sequence[str], scale: Scale) -> OnnxKeypoints:
    """Return the keypoint detector of a network in training; `network` returns the exported maps."""
    size = (SIDE_PX, SIDE_PX)
    model = _TorchModel(lambda pictures: [network(pictures)], _device(network), ("heatmaps",), {})
    model_input = KeypointInput(size, None, False, np.float32, False, (0.0,) * 3, (255.0,) * 3)
    layout = HeatmapLayout("heatmaps", None, False, size, "none", "centres", 1.0)
    shape = {"heatmaps": (len(names), SIDE_PX // STRIDE, SIDE_PX // STRIDE)}
    return OnnxKeypoints(model, model_input, layout, names, scale.crops, CROPS, shape)


def segmenter_accuracy(segmenter: Segmenter, pictures: Sequence[StoredPicture]) -> dict[str, float]:
    """Measure a segmenter on held-out pictures.

    Returns:
        `mean_iou`: mean IoU of the masks over the labelled birds, 0 for a bird without a detection; one-to-one
        matches with the greatest sum of IoUs. `ap50`: average precision at an IoU of 0.5.
    """
    true = _observations(pictures, [_true_instances(picture.labels) for picture in pictures])
    detected = _observations(pictures, [segmenter(picture.pixels()) for picture in pictures])
    both = overlap(detected, true)
    ious = [iou[assign(iou, 1e-9)].sum() for iou in both.iou]
    ap50, _ = average_precision(detected, true, both)
    return {"mean_iou": float(np.sum(ious) / max(int(both.true.sum()), 1)), "ap50": ap50}


def keypoint_accuracy(
    detector: KeypointDetector, pictures: Sequence[StoredPicture], names: Mapping[str, str]
) -> dict[str, float]:
    """Measure a keypoint detector on held-out pictures, with the labelled masks or boxes.

    Args:
        detector: the detector.
        pictures: held-out pictures.
        names: name of a labelled keypoint → name of the detector, for all labelled keypoints in their order; an empty
            text for a keypoint that the detector lacks.

    Returns:
        `pck_05` and `pck_10`: share of the visible labelled keypoints with an error below 5 and 10 % of the longer side
        of the bird; a keypoint that the detector lacks is wrong. `error`: mean error in per cent of the longer side,
        over the keypoints that the detector has.
    """
    own = [detector.keypoint_names.index(name) if name else -1 for name in names.values()]
    errors = []
    for picture in pictures:
        instances = _true_instances(picture.labels)
        birds = [(bird, instance) for bird, instance in zip(picture.labels.birds, instances, strict=True) if instance]
        points_px, _ = detector(picture.pixels(), [instance for _, instance in birds])
        for (bird, instance), found_px in zip(birds, points_px, strict=True):
            error = np.linalg.norm(found_px[own] - bird.keypoints_px, axis=-1) / max(instance.mask.shape)
            errors.append(np.where(np.array(own) < 0, np.inf, error)[bird.visibility == 2])
    values = np.concatenate([*errors, np.zeros(0)])
    if not len(values):
        return {"pck_05": float("nan"), "pck_10": float("nan"), "error": float("nan")}
    known = values[np.isfinite(values)]
    error = 100 * float(known.mean()) if len(known) else float("nan")
    return {"pck_05": float((values < 0.05).mean()), "pck_10": float((values < 0.10).mean()), "error": error}


def single_score(accuracy: Mapping[str, float]) -> float:
    """Return the figure that compares networks: the mean of mean IoU and AP50, or of PCK@0.05 and PCK@0.10."""
    names = ("mean_iou", "ap50") if "ap50" in accuracy else ("pck_05", "pck_10")
    return sum(accuracy[name] for name in names) / 2


def _true_instances(picture: LabelledPicture) -> list[Instance | None]:
    """Return the labelled birds; None for a bird that other birds hide."""
    owner = owner_of(picture.birds, picture.size_px)
    return [instance_of(owner == n, 1.0, "bird") for n in range(1, len(picture.birds) + 1)]


def _observations(pictures: Sequence[StoredPicture], instances: Sequence[Sequence[Instance | None]]) -> Observations:
    """Return the birds of every picture as observations without keypoints; bird n of a picture is track n."""
    T, N = len(pictures), max(1, *map(len, instances))
    present, score = np.zeros((N, T), bool), np.zeros((N, T), np.float32)
    box, masks = np.zeros((N, T, 4), np.float32), {}
    for t, (picture, birds) in enumerate(zip(pictures, instances, strict=True)):
        width, height = picture.labels.size_px
        for n, bird in enumerate(birds):
            if bird is None:
                continue
            present[n, t], score[n, t], box[n, t] = True, bird.score, bird.box_px
            masks[n, t] = bird.encode(width, height)
    return Observations(
        track_id=np.arange(N),
        frame_index=np.arange(T),
        present=present,
        keypoints_px=np.zeros((N, T, 1, 2), np.float32),
        confidence=np.zeros((N, T, 1), np.float32),
        box_px=box,
        image_size_px=np.array([picture.labels.size_px for picture in pictures]),
        file_name=np.array([picture.labels.name for picture in pictures]),
        keypoint_names=("centre",),
        masks=masks,
        score=score,
    )
