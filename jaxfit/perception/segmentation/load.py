"""Loading of a segmenter from one or two ONNX files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxfit.errors import InputError
from jaxfit.perception.instances import Segmenter
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.bottom_up import BottomUp
from jaxfit.perception.segmentation.mask_rcnn import MaskRcnn
from jaxfit.perception.segmentation.rf_detr import RfDetrSeg
from jaxfit.perception.segmentation.saliency import DetectorAndSaliency, Saliency
from jaxfit.perception.segmentation.tiles import Tiled
from jaxfit.perception.segmentation.yolo import YoloSeg
from jaxfit.perception.segmentation.yolox import Yolox

__all__ = ["BUILTIN", "KINDS", "load_segmenter", "segmenter_files"]

BUILTIN = Path(__file__).parents[1] / "networks" / "segmenter.onnx"
"""The built-in segmenter."""


_NETWORKS = {"bottom_up": BottomUp, "rf_detr": RfDetrSeg, "mask_rcnn": MaskRcnn, "yolo": YoloSeg}
KINDS = ("auto", *_NETWORKS, "yolox+saliency")
"""The values that `load_segmenter` accepts as `kind`."""


def load_segmenter(
    spec: str | Path,
    *,
    kind: str = "auto",
    classes: Sequence[str] | None = None,
    min_score: float | None = None,
    names: Sequence[str] | None = None,
    tile_px: int | None = None,
    tile_overlap: float = 0.25,
    threads: int | None = None,
) -> Segmenter:
    """Load a segmenter from one or two ONNX files; the inputs and outputs determine its layout.

    Args:
        spec: `builtin`; or a file; or two files as `detector.onnx+saliency.onnx`: a YOLOX detector, and a network such
            as U²-Net that segments the salient object in each box.
        kind: one of `KINDS`; a name requires this layout, `auto` uses the layout that fits.
        classes: names of the classes to keep; None keeps `bird`, or the only class.
        min_score: least score of an instance, within [0, 1]; None uses the default of the layout.
        names: names of all classes in their order; None uses the names in the file.
        tile_px: side of the square tiles of a frame, pixels; None uses no tiles. Small birds in large frames need
            tiles: a reduction from 2592 x 1520 to 640 x 640 keeps a sixteenth of the pixels.
        tile_overlap: share of a tile that lies in the next tile, within [0, 1); best wider than a bird.
        threads: number of cores for a network; None uses all cores.

    Raises:
        ValueError: unknown kind, or an invalid size of tiles, overlap or score.
        InputError: a file does not exist, cannot be loaded, has an unknown layout (the message lists the outputs
            and names the supported layouts), has not three channels, or lacks a class.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if min_score is not None and not 0 <= min_score <= 1:
        raise ValueError(f"min_score must be within 0 and 1, not {min_score}")
    segmenter = _load(str(spec), kind, classes, min_score, names, threads)
    return segmenter if tile_px is None else Tiled(segmenter, tile_px, tile_overlap)


def segmenter_files(spec: str) -> list[Path]:
    """Return the one or two files of a `spec` of `load_segmenter`."""
    first, plus, second = spec.partition(".onnx+")
    if plus and not Path(spec).is_file():
        return [Path(first + ".onnx"), Path(second)]
    return [BUILTIN if spec == "builtin" else Path(spec)]


def _load(
    spec: str,
    kind: str,
    classes: Sequence[str] | None,
    min_score: float | None,
    names: Sequence[str] | None,
    threads: int | None,
) -> Segmenter:
    path, *second = segmenter_files(spec)
    if second:
        if kind not in ("auto", "yolox+saliency"):
            raise InputError(spec, f"is two files, but kind {kind} needs one file", "give one file, or kind auto")
        detector, saliency = OnnxModel(path, threads), OnnxModel(second[0], threads)
        if not Yolox.fits(detector):
            raise _unknown_layout(detector, f"YOLOX detector: {Yolox.layout}")
        if not Saliency.fits(saliency):
            raise _unknown_layout(saliency, "saliency: first output (1, 1, h, w)")
        return DetectorAndSaliency(Yolox(detector, classes, min_score, names), Saliency(saliency))
    if kind == "yolox+saliency":
        raise InputError(spec, f"is one file, but kind {kind} needs two files", "give detector.onnx+saliency.onnx")
    model = OnnxModel(path, threads)
    candidates = {name: network for name, network in _NETWORKS.items() if kind in ("auto", name)}
    for network in candidates.values():
        if network.fits(model):
            return network(model, classes, min_score, names)
    if Yolox.fits(model):
        problem = f"detects boxes, but no masks: {model.describe()}"
        raise InputError(model.path, problem, f"add a network for the masks: {model.path.name}+u2netp.onnx")
    if kind != "auto":
        raise _unknown_layout(model, f"{kind}: {candidates[kind].layout}")
    raise _unknown_layout(model, f"{', '.join(_NETWORKS)}; docs/usage.md lists their outputs")


def _unknown_layout(model: OnnxModel, supported: str) -> InputError:
    return InputError(model.path, f"has an unknown layout: {model.describe()}", f"supported are {supported}")
