"""The segmenter that a file holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

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
"""The network that the package brings along."""


class _Kind(NamedTuple):
    layout: str
    """What its networks look like, for messages."""
    fits: Callable[[OnnxModel], bool]
    load: Callable[[OnnxModel, Sequence[str] | None, float | None, Sequence[str] | None], Segmenter]


_KINDS = {
    "bottom_up": _Kind("outputs foreground, centre, offset", BottomUp.fits, BottomUp),
    "rf_detr": _Kind(
        "outputs dets (1, queries, 4), labels (1, queries, slots), masks (1, queries, h, w)", RfDetrSeg.fits, RfDetrSeg
    ),
    "mask_rcnn": _Kind("outputs boxes (N, 4), labels (N), scores (N), masks (N, 1, H, W)", MaskRcnn.fits, MaskRcnn),
    "yolo": _Kind(
        "outputs (1, 4 + classes + 32, anchors) or (1, rows, 6 + 32), and (1, 32, h, w)", YoloSeg.fits, YoloSeg
    ),
}
KINDS = ("auto", *_KINDS, "yolox+saliency")
"""What `load_segmenter` takes as `kind`."""


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
    """A segmenter from one or two ONNX files, whose inputs and outputs tell its layout.

    Args:
        spec: `builtin`; or a file; or two as `detector.onnx+saliency.onnx`, a YOLOX detector and a network such
            as U²-Net that masks what stands out in each of its boxes.
        kind: one of `KINDS`; a name demands that layout, `auto` takes whichever fits.
        classes: names of the classes to keep; None takes `bird`, or the only class there is.
        min_score: least score of an instance, within [0, 1]; None takes the layout's own.
        names: all classes of the network in their order, where the file does not hold them.
        tile_px: side of the square tiles that frames are cut into, pixels; None takes frames whole. Small birds
            in large frames need it: 2592 x 1520 shrunk to 640 x 640 keeps a sixteenth of their pixels.
        tile_overlap: share of a tile that neighbours have in common, within [0, 1); wider than a bird is best.
        threads: cores that a network may use; None takes all.

    Raises:
        ValueError: another kind, or a tile size, an overlap or a score that is none.
        InputError: no such file, none that can be loaded, an unknown layout (with what was found and
            what is known), another number of channels, or classes that the network lacks.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if min_score is not None and not 0 <= min_score <= 1:
        raise ValueError(f"min_score must be within 0 and 1, not {min_score}")
    segmenter = _load(str(spec), kind, classes, min_score, names, threads)
    return segmenter if tile_px is None else Tiled(segmenter, tile_px, tile_overlap)


def segmenter_files(spec: str) -> list[Path]:
    """The one or two files that a `spec` of `load_segmenter` stands for."""
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
            raise InputError(spec, f"names two files, but {kind} is one", "give one file, or kind auto")
        detector, saliency = OnnxModel(path, threads), OnnxModel(second[0], threads)
        if not Yolox.fits(detector):
            raise _unknown(detector, "YOLOX detector: one output (1, cells of strides 8, 16, 32, 5 + classes)")
        if not Saliency.fits(saliency):
            raise _unknown(saliency, "saliency: first output (1, 1, h, w)")
        return DetectorAndSaliency(Yolox(detector, classes, min_score, names), Saliency(saliency))
    if kind == "yolox+saliency":
        raise InputError(spec, f"is one file, but {kind} is two", "give detector.onnx+saliency.onnx")
    model = OnnxModel(path, threads)
    wanted = {name: _KINDS[name] for name in _KINDS if kind in ("auto", name)}
    for candidate in wanted.values():
        if candidate.fits(model):
            return candidate.load(model, classes, min_score, names)
    if Yolox.fits(model):
        problem = f"finds boxes but no masks: {model.describe()}"
        raise InputError(model.path, problem, f"add a network for the masks: {model.path.name}+u2netp.onnx")
    raise _unknown(model, "; ".join(f"{name}: {known.layout}" for name, known in wanted.items()))


def _unknown(model: OnnxModel, known: str) -> InputError:
    return InputError(model.path, f"has no layout that is known here: {model.describe()}", f"known are {known}")
