"""A keypoint network applied to crops of the birds of a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, cast

import cv2
import numpy as np
from jaxtyping import Float, Num, UInt8

from jaxfit.config.perception import BUILTIN, OUTLINE
from jaxfit.data.keypoint_names import map_keypoints, propose_names
from jaxfit.data.masks import decode_mask
from jaxfit.data.observations import FROM_OUTLINE, MIN_KEYPOINTS, Observations
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import AVES_KEYPOINTS, AVIAN_MESH_KEYPOINTS, MURRE_KEYPOINTS
from jaxfit.perception.keypoint_layouts import (
    HeatmapLayout,
    KeypointInput,
    KeypointMetadata,
    SimccLayout,
    detect_layout,
    read_input,
    read_metadata,
)
from jaxfit.perception.network import (
    CONFIDENCE_KEY,
    OUTPUT,
    Instance,
    OnnxModel,
    activation_monitor,
    instance_of,
    read_curve,
)

PAD_PX = 40
OUTLINE_MARGIN = 0.15
"""Margin around the box of an outline, as a share of its longer side: room for parts that the mask lacks."""
DILATE_PX = {"black": 70, "visible": 14, "outline": 0}
"""Defaults of `crop_bird` for each background, for footage in which birds are about 250 pixels long; 40 and 70 are the
paper's."""


class Crop(NamedTuple):
    """A box of the frame and the size of the resampled picture; pixel centres at i + 0.5 in both."""

    x0: int
    """Left border, image pixels; negative if the box extends beyond the frame."""
    y0: int
    """Upper border, image pixels."""
    width: int
    """Width of the box, image pixels."""
    height: int
    """Height of the box, image pixels."""
    size_px: tuple[int, int]
    """Width and height of the resampled picture, crop pixels."""

    @property
    def scale(self) -> Float[np.ndarray, "2"]:
        """Image pixels per crop pixel, along x and y. The two differ because the box is rounded to whole pixels."""
        return np.array([self.width, self.height]) / np.array(self.size_px)

    def to_image(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert points from crop pixels to image pixels."""
        return points_px * self.scale + (self.x0, self.y0)

    def to_crop(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert points from image pixels to crop pixels; the inverse of `to_image`."""
        return (points_px - (self.x0, self.y0)) / self.scale


def crop_bird(
    frame: UInt8[np.ndarray, "H W 3"],
    instance: Instance,
    size_px: tuple[int, int],
    pad_px: int = PAD_PX,
    dilate_px: int = DILATE_PX["black"],
    neighbours: Sequence[Instance] | None = None,
) -> tuple[UInt8[np.ndarray, "h w 3"], Crop]:
    """Crop one bird, and set other birds to black.

    The background is black or visible. If the background is black, every pixel outside the dilated mask of the bird is
    black, so parts that the mask lacks are lost. If the background is visible, only the dilated masks of the neighbours
    are black, except where the bird's own mask is.

    The tight box of the mask is padded, then enlarged about its centre (to half a pixel) to the aspect ratio of the
    picture. Reduction averages over areas, which avoids aliasing.

    Args:
        frame: any colour order; only pixels within the box are read.
        instance: its mask lies within the frame.
        size_px: width and height of the picture.
        pad_px: margin on every side of the box, image pixels; 0 or more.
        dilate_px: side of the square that dilates the mask, or the masks of the neighbours, image pixels; 0 does not
            dilate.
        neighbours: the other birds of the frame, for a visible background; None for a black background.

    Returns:
        The picture, black where the box extends beyond the frame, and the crop that converts to image pixels.

    Source: Hägerlind et al. 2024, the crops of its keypoint network (black background, 40 and 70 pixels).
    """
    crop = _padded_box(instance, size_px, pad_px)
    own = _mask_in(crop, [instance])
    if neighbours is None:
        visible = _dilated(own, dilate_px)
    else:
        visible = own | (_dilated(_mask_in(crop, neighbours), dilate_px) == 0)
    rows = slice(max(crop.y0, 0), min(crop.y0 + crop.height, frame.shape[0]))
    columns = slice(max(crop.x0, 0), min(crop.x0 + crop.width, frame.shape[1]))
    inside = slice(rows.start - crop.y0, rows.stop - crop.y0), slice(columns.start - crop.x0, columns.stop - crop.x0)
    part = frame[rows, columns]
    picture = np.zeros((crop.height, crop.width, 3), np.uint8)
    picture[inside] = cv2.bitwise_and(part, part, mask=visible[inside])
    return _resized(picture, size_px), crop


def crop_outline(
    shape: tuple[int, ...], birds: Sequence[Instance], n: int, size_px: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h w 3"], Crop]:
    """Draw the masks around one bird, without the picture; the margin is `OUTLINE_MARGIN`.

    Args:
        shape: height and width of the frame.
        birds: all birds of the frame.
        n: position of the bird.
        size_px: width and height of the result.

    Returns:
        Three channels, 255 in the bird, in other birds and outside the frame, and the crop as in `crop_bird`.
    """
    crop = _padded_box(birds[n], size_px, round(OUTLINE_MARGIN * max(birds[n].mask.shape)))
    own, others = _mask_in(crop, [birds[n]]), _mask_in(crop, [*birds[:n], *birds[n + 1 :]])
    outside = np.ones_like(own)
    outside[max(-crop.y0, 0) : max(shape[0] - crop.y0, 0), max(-crop.x0, 0) : max(shape[1] - crop.x0, 0)] = 0
    picture = 255 * np.stack([own, others, outside], axis=-1)
    return _resized(picture, size_px), crop


def _resized(picture: UInt8[np.ndarray, "H W 3"], size_px: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture in another width and height."""
    is_reduction = picture.shape[1] >= size_px[0] and picture.shape[0] >= size_px[1]
    # when it enlarges, OpenCV's area mode shifts the pixel centres
    return cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA if is_reduction else cv2.INTER_LINEAR)


def _mask_in(crop: Crop, birds: Sequence[Instance]) -> UInt8[np.ndarray, "h w"]:
    """Return 1 where the box of a crop shows one of the birds, else 0."""
    mask = np.zeros((crop.height, crop.width), np.uint8)
    for bird in birds:
        low = np.array([bird.y0 - crop.y0, bird.x0 - crop.x0])
        top, left = np.maximum(low, 0)
        bottom, right = np.minimum(low + bird.mask.shape, mask.shape)
        if top < bottom and left < right:
            part = bird.mask[top - low[0] : bottom - low[0], left - low[1] : right - low[1]]
            mask[top:bottom, left:right] |= part.astype(np.uint8)
    return mask


def _dilated(mask: UInt8[np.ndarray, "h w"], side_px: int) -> UInt8[np.ndarray, "h w"]:
    return np.asarray(cv2.dilate(mask, np.ones((side_px, side_px), np.uint8)), np.uint8) if side_px > 1 else mask


def _padded_box(instance: Instance, size_px: tuple[int, int], pad_px: int) -> Crop:
    h, w = instance.mask.shape
    padded_w, padded_h = w + 2 * pad_px, h + 2 * pad_px
    width = max(padded_w, round(padded_h * size_px[0] / size_px[1]))
    height = max(padded_h, round(padded_w * size_px[1] / size_px[0]))
    x0 = instance.x0 - pad_px - (width - padded_w) // 2
    y0 = instance.y0 - pad_px - (height - padded_h) // 2
    return Crop(x0, y0, width, height, size_px)


class CropSettings(NamedTuple):
    """The crops that a keypoint network expects; the fields are those of `crop_bird`."""

    pad_px: int = PAD_PX
    dilate_px: int = DILATE_PX["black"]
    background: str = "black"
    """`black` outside the dilated mask of the bird, or `visible` except other birds (`crop_bird`); `outline` for masks
    in place of the picture (`crop_outline`)."""

    def crop(
        self, frame: UInt8[np.ndarray, "H W 3"], birds: Sequence[Instance], n: int, size_px: tuple[int, int]
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Crop]:
        """Crop bird n of all birds of a frame, as `crop_bird` or `crop_outline` describes."""
        if self.background == "outline":
            return crop_outline(frame.shape[:2], birds, n, size_px)
        neighbours = None if self.background == "black" else [*birds[:n], *birds[n + 1 :]]
        return crop_bird(frame, birds[n], size_px, self.pad_px, self.dilate_px, neighbours)


def crop_settings(
    metadata: KeypointMetadata, pad_px: int | None = None, dilate_px: int | None = None, background: str | None = None
) -> CropSettings:
    """Return the crops of a network: the given values, else those of its file, else the defaults of `CropSettings`."""
    background = background or metadata.background or "black"
    return CropSettings(
        _first_given(pad_px, metadata.pad_px, PAD_PX),
        _first_given(dilate_px, metadata.dilate_px, DILATE_PX[background]),
        background,
    )


def _first_given(*values: int | None) -> int:
    return next(value for value in values if value is not None)


BUILTIN_PATH, OUTLINE_PATH = (
    Path(__file__).parent / "networks" / name for name in ("keypoints_8bit.onnx", "outline.onnx")
)
_PATHS = {BUILTIN: BUILTIN_PATH, OUTLINE: OUTLINE_PATH}
NAME_SETS = {"murre": MURRE_KEYPOINTS, "aves": AVES_KEYPOINTS, "avian-mesh": AVIAN_MESH_KEYPOINTS}


class OnnxKeypoints:
    """A `KeypointDetector`: crops the birds, runs the network on batches of crops, and converts to image pixels."""

    keypoint_names: tuple[str, ...]

    def __init__(
        self,
        model: OnnxModel,
        network_input: KeypointInput,
        layout: HeatmapLayout | SimccLayout,
        keypoint_names: Sequence[str],
        crops: CropSettings,
        batch: int,
        shapes: Mapping[str, tuple[int, ...]],
    ):
        self.keypoint_names = tuple(keypoint_names)
        self._model, self._input, self._layout = model, network_input, layout
        self._crops = crops
        self.sees_outlines = crops.background == "outline"
        self._batch = network_input.batch or batch
        self._shapes = shapes
        self.activations = activation_monitor(model)
        self.curve = read_curve(model, CONFIDENCE_KEY)

    def __call__(
        self, frame: UInt8[np.ndarray, "H W 3"], instances: Sequence[Instance]
    ) -> tuple[Float[np.ndarray, "M K 2"], Float[np.ndarray, "M K"]]:
        """Detect keypoints, as `KeypointDetector` describes."""
        K = len(self.keypoint_names)
        points_px, confidence = np.zeros((len(instances), K, 2), np.float32), np.zeros((len(instances), K), np.float32)
        for start in range(0, len(instances), self._batch):
            array, crops = self.network_input(frame, instances, range(len(instances))[start : start + self._batch])
            outputs = self._model(array)
            self._model.check_outputs(outputs, {name: (len(array), *shape) for name, shape in self._shapes.items()})
            if self.activations is not None:
                self.activations.add(outputs, len(crops))
            crop_points_px, crop_confidence = self._layout(outputs)
            if self.curve is not None:
                crop_confidence = self.curve(crop_confidence)
            for i, crop in enumerate(crops):
                points_px[start + i] = crop.to_image(crop_points_px[i])
                confidence[start + i] = crop_confidence[i]
        return points_px, confidence

    def network_input(
        self, frame: UInt8[np.ndarray, "H W 3"], birds: Sequence[Instance], some: Sequence[int]
    ) -> tuple[Num[np.ndarray, "N _ _ _"], list[Crop]]:
        """Return the input of the network for some birds of a frame, and their crops; a fixed batch is filled with 0.

        Args:
            frame: blue, green, red.
            birds: all birds of the frame.
            some: positions of the N birds of the input.
        """
        width, height = self._input.size_px
        batch = np.zeros((self._input.batch or len(some), height, width, 3), np.uint8)
        crops = []
        for i, n in enumerate(some):
            batch[i], crop = self._crops.crop(frame, birds, n, (width, height))
            crops.append(crop)
        return self._input.array(batch), crops


def keypoint_file(spec: str | Path) -> Path:
    """Return the file of a keypoint network: `builtin`, `outline`, or an ONNX file."""
    return _PATHS.get(str(spec), Path(spec))


def load_keypoint_detector(
    spec: str | Path = BUILTIN,
    *,
    kind: str = "auto",
    names: Sequence[str] | str | None = None,
    pad_px: int | None = None,
    dilate_px: int | None = None,
    background: str | None = None,
    batch: int = 16,
    threads: int | None = None,
) -> OnnxKeypoints:
    """Load a keypoint network; its inputs and outputs determine its layout.

    Args:
        spec: `builtin`, `outline`, or an ONNX file, whose optional metadata `jaxfit.perception.keypoint_layouts`
            describes.
        kind: one of `KINDS`; `auto` uses the layout that fits.
        names: names of the keypoints in the order of the output, or a key of `NAME_SETS`; None or empty uses the
            names in the file.
        pad_px, dilate_px, background: parameters of the crops (`CropSettings`), image pixels; None uses the values in
            the file, or a black background and the defaults of the background.
        batch: number of crops in one run, if the network does not fix it.
        threads: number of cores for one run; None uses all cores.

    Raises:
        InputError: the file does not exist, is not a keypoint network, has an unknown layout or not three channels,
            or the names are missing or of the wrong number.
    """
    model = OnnxModel(keypoint_file(spec), threads)
    metadata = read_metadata(model)
    network_input = read_input(model, metadata)
    width, height = network_input.size_px
    outputs = model(network_input.array(np.zeros((network_input.batch or 1, height, width, 3), np.uint8)))
    outputs = {
        name: value for name, value in outputs.items() if name != OUTPUT and np.asarray(value).dtype.kind in "fiub"
    }
    layout, count = detect_layout(model, outputs, kind, network_input, metadata)
    return OnnxKeypoints(
        model,
        network_input,
        layout,
        _choose_names(model, count, names or metadata.keypoint_names),
        crop_settings(metadata, pad_px, dilate_px, background),
        batch,
        {name: outputs[name].shape[1:] for name in layout.outputs},
    )


def _choose_names(model: OnnxModel, count: int, given: Sequence[str] | str | None) -> Sequence[str]:
    sets = ", ".join(f"`{name}` ({len(keypoints)})" for name, keypoints in NAME_SETS.items())
    if not given:
        remedy = f"give the names in the order of the output, or one of {sets}"
        raise InputError(model.path, f"does not name its {count} keypoints", remedy)
    if isinstance(given, str) and given not in NAME_SETS:
        raise InputError(given, "is not a set of keypoint names", f"supported are {sets}; or give the {count} names")
    names = NAME_SETS[given] if isinstance(given, str) else given
    if len(names) != count:
        problem = f"has {count} keypoints, but {len(names)} names are given"
        remedy = f"give one name for each keypoint in the order of the output: {model.describe()}"
        raise InputError(model.path, problem, remedy)
    return names


def with_outline_keypoints(observations: Observations) -> Observations:
    """Return the observations with the keypoints of the network `outline` where a bird has a mask and no keypoint.

    Args:
        observations: masks of birds; keypoints that a model with three or more keypoints of the network has. Other
            observations do not change.
    """
    alone = observations.present & ~observations.confidence.any(-1)
    if not alone.any():
        return observations
    detector = load_keypoint_detector(OUTLINE)
    names = propose_names(detector.keypoint_names, observations.keypoint_names)
    if len(names.mapped) < MIN_KEYPOINTS:
        return observations
    shape = (*observations.present.shape, len(detector.keypoint_names))
    points_px, confidence = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32)
    for t in np.flatnonzero(alone.any(0)).tolist():
        pictures: dict[str, list[int]] = {}
        for n in np.flatnonzero(observations.present[:, t]).tolist():
            if observations.masks.get((n, t)) is not None:
                pictures.setdefault(observations.image_file(n, t), []).append(n)
        for rows in pictures.values():
            masks = [instance_of(decode_mask(observations.masks[n, t]), 1.0, "") for n in rows]
            seen = [n for n, mask in zip(rows, masks, strict=True) if mask is not None]
            width, height = observations.image_size(rows[0], t)
            blank = np.broadcast_to(np.zeros(3, np.uint8), (height, width, 3))
            points_px[seen, t], confidence[seen, t] = detector(blank, [mask for mask in masks if mask is not None])
    own = replace(
        observations,
        keypoint_names=detector.keypoint_names,
        keypoints_px=points_px,
        confidence=confidence * alone[..., None],
        occluded=None,
        skeleton=(),
    )
    own = map_keypoints(own, names, observations.keypoint_names)
    added = alone & own.confidence.any(-1)
    return replace(
        observations,
        keypoints_px=np.where(added[..., None, None], own.keypoints_px, observations.keypoints_px),
        confidence=np.where(added[..., None], own.confidence, observations.confidence),
        keypoint_origin=np.where(added, FROM_OUTLINE, cast(np.ndarray, observations.keypoint_origin)),
    )
