"""Segmentation networks: the built-in layout, the choice of a layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import find_objects

from jaxfit.foundation.errors import InputError
from jaxfit.perception.general_networks import DETECTORS, check_general_files, general_files
from jaxfit.perception.merging import Tiled, length_px, replace_parts
from jaxfit.perception.network import Instance, OnnxModel, Segmenter, activation_monitor
from jaxfit.perception.saliency import DOUBTFUL_SCORE, DetectorAndSaliency, Saliency
from jaxfit.perception.segmentation_inputs import Placement, SegmentationNetwork
from jaxfit.perception.segmentation_layouts import MaskRcnn, RfDetrSeg, YoloSeg, Yolox

LONGER_SIDE_PX = 864
"""Default of the metadata `longer_side`, the longer side of the input: 6.9 pixels for 2 cm of a ledge 2.5 m wide."""
MULTIPLE = 32
OFFSET_UNIT_PX = 32.0
MIN_PEAK = 0.2
"""Lower peaks of the centre map are noise."""
PEAK_WINDOW = 7
"""Side, in cells, of the square in which a peak must be the maximum."""
MIN_FOREGROUND = 0.1
"""Cells with a lower foreground belong to no bird. Masks are cut at 0.5, between cells."""
MAX_DISTANCE_PX = 60.0
"""Cells whose offset ends at least this far from every centre belong to no bird; pixels of the input."""
OFFSET_STEPS = 3
"""Largest number of offsets that are followed from a cell, one after the other."""
ARRIVED_PX = 16.0
"""An offset that ends at most this far from a peak is not followed further; half the unit of the offsets."""
LARGE_BIRD_PX = 200.0
"""Birds that are longer in the input are detected in parts, so an input of half the size detects them."""
SMALLER_INPUTS = 2
"""Number of smaller inputs: half and a quarter of the size."""
MIN_CELLS = 12
"""Instances with fewer cells are dropped."""


class BottomUp(SegmentationNetwork):
    """Instances as groups of foreground cells whose offsets point to the same centre (Cheng et al. 2020).

    Outputs over cells of equal size: `foreground` (1, 1, h, w), probabilities; `centre` (1, 1, h, w), with a peak of 1
    for each bird; `offset` (1, 2, h, w), x and y from a cell to the centre of its bird in units of 32 pixels. Input:
    blue-green-red within 0 and 1, sides multiples of 32; the frame in the upper left corner, the rest black. The score
    is the peak of the centre times the mean foreground.

    Where the input has a variable size, birds that are long in the input are detected in smaller inputs.

    Raises:
        InputError: an unsupported input, more than one class, or invalid metadata.

    Source: Cheng et al. 2020, Panoptic-DeepLab.
    """

    layout = "outputs foreground, centre, offset"
    default_min_score = 0.4

    def _set_up(self) -> None:
        (self._label,) = self.class_names
        self._longer_side_px = int(self._metadata_number("longer_side", LONGER_SIDE_PX, multiple_of=MULTIPLE))
        self.min_track_score = self._metadata_number("min_track_score", 0.0, largest=1.0)
        self.activations = activation_monitor(self._model)

    def _metadata_number(
        self, key: str, default: float, largest: float = np.inf, multiple_of: float | None = None
    ) -> float:
        """Return a number of the metadata, 0 or more; more than 0 for a multiple."""
        text = self._model.metadata.get(key, str(default))
        try:
            number = float(text)
            if not 0 <= number <= largest or (multiple_of and (number < 1 or number % multiple_of)):
                raise ValueError("out of range")
        except ValueError as error:
            expected = f"a multiple of {multiple_of}" if multiple_of else f"a number within 0 and {largest:g}"
            problem = f"its metadata `{key}` is {text[:40]!r}"
            raise InputError(self._model.path, problem, f"export it with {expected}") from error
        return number

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        names_by_index = super()._all_classes(names)
        if len(names_by_index) != 1:
            raise InputError(self._model.path, f"names {len(names_by_index)} classes", "give a network of one class")
        return names_by_index

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        return {"foreground", "centre", "offset"} <= {port.name for port in model.outputs}

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        array, placement = self.network_input(frame)
        outputs = self._model(array)
        found = self._instances(outputs, placement)
        if self.activations is not None:
            self.activations.add(outputs, 1)
        if self._input.size_px is None:
            found = self._with_large_birds(frame, found)
        return sorted(found, key=lambda instance: -instance.score)

    def _with_large_birds(self, frame: UInt8[np.ndarray, "H W 3"], found: list[Instance]) -> list[Instance]:
        """Replace the parts of large birds; a smaller input is used only if a detection could be half a large bird."""
        min_px = LARGE_BIRD_PX * max(frame.shape[:2]) / self._longer_side_px
        for n in range(1, SMALLER_INPUTS + 1):
            if not any(2 * length_px(bird) >= min_px for bird in found):
                break
            array, placement = self.network_input(frame, self._longer_side_px / 2**n)
            found = replace_parts(found, self._instances(self._model(array), placement), min_px)
            min_px *= 2
        return found

    def _instances(self, outputs: dict[str, np.ndarray], placement: Placement) -> list[Instance]:
        """Return the instances of the outputs of the network."""
        shape = (1, 1, "h", "w")
        self._model.check_outputs(outputs, {"foreground": shape, "centre": shape, "offset": (1, 2, "h", "w")})
        foreground, centre = (outputs[name][0, 0].astype(np.float32, copy=False) for name in ("foreground", "centre"))
        cell_px = placement.input_px[0] / foreground.shape[1]
        peaks = _find_peaks(centre)
        assignment = _assign_cells(foreground, outputs["offset"][0] * OFFSET_UNIT_PX, peaks, cell_px)
        places = find_objects(assignment + 1, len(peaks))
        instances = (
            self._instance(foreground, assignment[place] == n, place, float(centre[row, column]), placement)
            for n, ((row, column), place) in enumerate(zip(peaks, places, strict=True))
            if place is not None
        )
        return [instance for instance in instances if instance is not None]

    def network_input(
        self, frame: UInt8[np.ndarray, "H W 3"], longer_side_px: float | None = None
    ) -> tuple[Float[np.ndarray, "1 3 h w"], Placement]:
        """Return the input of the network for a frame, and the place of the frame in the input.

        Args:
            frame: blue, green, red.
            longer_side_px: longer side of an input of variable size; None for the size of the metadata.
        """
        frame_px = frame.shape[1], frame.shape[0]
        input_px = self._input_px(frame_px, longer_side_px or self._longer_side_px)
        placement = Placement.letterboxed(frame_px, input_px, centred=False)
        return self._input.array(_network_picture(frame, placement)), placement

    def _input_px(self, frame_px: tuple[int, int], longer_side_px: float) -> tuple[int, int]:
        """Return width and height of the input; a variable size has the frame's proportions, in multiples of 32."""
        if self._input.size_px is not None:
            return self._input.size_px
        zoom = longer_side_px / max(frame_px)
        width, height = (MULTIPLE * max(1, int(np.ceil(round(side * zoom) / MULTIPLE))) for side in frame_px)
        return width, height

    def _instance(
        self,
        foreground: Float[np.ndarray, "h w"],
        own: Bool[np.ndarray, "h2 w2"],
        place: tuple[slice, slice],
        peak: float,
        placement: Placement,
    ) -> Instance | None:
        """Create the instance of the cells `own` of a part of the map; None if it is too small or its score too low."""
        part = foreground[place]
        certain = own & (part > 0.5)
        if np.count_nonzero(certain) < MIN_CELLS:
            return None
        score = float(np.clip(peak, 0, 1) * part[certain].mean())
        if score < self._min_score:
            return None
        rows, columns = place
        corners = np.array([columns.start, rows.start, columns.stop, rows.stop], np.float32)
        cells = np.array(foreground.shape[::-1], np.float32)
        corners_px = placement.to_frame(corners[None] * np.tile(placement.input_px / cells, 2))[0]
        alone = np.zeros_like(foreground)
        alone[place] = np.where(own, part, 0)
        return placement.instance(alone, corners_px, 0.5, score, self._label)


def _network_picture(frame: UInt8[np.ndarray, "H W 3"], placement: Placement) -> Float[np.ndarray, "h w 3"]:
    """Resize the frame into the upper left corner of a black picture within 0 and 1."""
    inner = [round(side * scale) for side, scale in zip(placement.frame_px, placement.scale, strict=True)]
    is_reduction = inner[0] < frame.shape[1]
    resized = cv2.resize(frame, inner, interpolation=cv2.INTER_AREA if is_reduction else cv2.INTER_LINEAR)
    width, height = placement.input_px
    planes = np.zeros((3, height, width), np.float32)  # the order of the network, so no other copy is necessary
    for plane, channel in zip(planes, cv2.split(resized), strict=True):
        np.divide(channel, np.float32(255), out=plane[: inner[1], : inner[0]])
    return planes.transpose(1, 2, 0)


def _find_peaks(centre: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "M 2"]:
    """Return rows and columns of the local maxima."""
    maximum = cv2.dilate(centre, np.ones((PEAK_WINDOW, PEAK_WINDOW), np.uint8))
    return np.argwhere((centre >= maximum) & (centre > MIN_PEAK))


def _assign_cells(
    foreground: Float[np.ndarray, "h w"],
    offset_px: Float[np.ndarray, "2 h w"],
    peaks: Int[np.ndarray, "M 2"],
    cell_px: float,
) -> Int[np.ndarray, "h w"]:
    """Assign each cell to the peak nearest to the end of its offsets; −1 for no peak.

    The offset of the tip of a wing is too short, but it ends nearer to the centre, where offsets are exact. So, as long
    as the end lies in the foreground and far from every peak, the offset at the end is added.
    """
    assignment = np.full(foreground.shape, -1)
    rows, columns = np.nonzero(foreground > MIN_FOREGROUND)
    if not len(peaks) or not len(rows):
        return assignment
    peaks_px = (peaks[:, ::-1] + 0.5) * cell_px
    ends = (np.stack([columns, rows]) + 0.5) * cell_px + offset_px[:, rows, columns]
    nearest, distance = _nearest_peaks(ends, peaks_px)
    last = np.array(foreground.shape[::-1])[:, None] - 1
    for _ in range(OFFSET_STEPS - 1):
        column, row = np.clip(np.nan_to_num(ends / cell_px).astype(int), 0, last)
        moves = np.flatnonzero((distance > ARRIVED_PX) & (foreground[row, column] > MIN_FOREGROUND))
        ends[:, moves] += offset_px[:, row[moves], column[moves]]
        nearest[moves], distance[moves] = _nearest_peaks(ends[:, moves], peaks_px)
    assignment[rows, columns] = nearest
    return assignment


def _nearest_peaks(
    ends: Float[np.ndarray, "2 n"], peaks_px: Float[np.ndarray, "M 2"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the nearest peak of each end and its distance; −1 and `MAX_DISTANCE_PX` if all are farther."""
    nearest, best = np.full(ends.shape[1], -1), np.full(ends.shape[1], MAX_DISTANCE_PX**2)
    for n, (x, y) in enumerate(peaks_px):
        squared = (ends[0] - x) ** 2 + (ends[1] - y) ** 2
        nearest[squared < best] = n
        np.minimum(best, squared, out=best)
    return nearest, np.sqrt(best)


BUILTIN = Path(__file__).parent / "networks" / "segmenter_8bit.onnx"
"""The built-in segmenter; `segmenter.onnx` has its weights in floats, for further training."""


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
        spec: `builtin`; a general segmenter (`general`, `general-tiny`, `general-s`), whose files
            `jaxfit.perception.general_networks` describes; or a file; or two files as `detector.onnx+saliency.onnx`: a
            YOLOX detector, and a network such as U²-Net that segments the salient object in each box.
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
        InputError: a file does not exist, cannot be loaded, has an unknown layout (the message lists the outputs and
            names the supported layouts), has not three channels, or lacks a class; a file of `general` has another
            content than the published file.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if min_score is not None and not 0 <= min_score <= 1:
        raise ValueError(f"min_score must be within 0 and 1, not {min_score}")
    segmenter = _load(str(spec), kind, classes, min_score, names, threads)
    return segmenter if tile_px is None else Tiled(segmenter, tile_px, tile_overlap)


def segmenter_files(spec: str) -> list[Path]:
    """Return the one or two files of a `spec` of `load_segmenter`; those of general segmenters are not checked."""
    if spec in DETECTORS:
        return general_files(spec)
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
    path, *second = check_general_files(spec) if spec in DETECTORS else segmenter_files(spec)
    if second:
        if kind not in ("auto", "yolox+saliency"):
            raise InputError(spec, f"is two files, but kind {kind} needs one file", "give one file, or kind auto")
        detector, saliency = OnnxModel(path, threads), OnnxModel(second[0], threads)
        if not Yolox.fits(detector):
            raise _unknown_layout(detector, f"YOLOX detector: {Yolox.layout}")
        if not Saliency.fits(saliency):
            raise _unknown_layout(saliency, "saliency: first output (1, 1, h, w)")
        boxes = Yolox(detector, classes, DOUBTFUL_SCORE if min_score is None else min_score, names)
        return DetectorAndSaliency(
            boxes, Saliency(saliency), Yolox.default_min_score if min_score is None else min_score
        )
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
    raise _unknown_layout(model, f"{', '.join(_NETWORKS)}; docs/guide/networks.md lists their outputs")


def _unknown_layout(model: OnnxModel, supported: str) -> InputError:
    return InputError(model.path, f"has an unknown layout: {model.describe()}", f"supported are {supported}")
