"""Metadata, inputs and output layouts of keypoint networks, and their decoding.

Metadata of a keypoint network: keys and values of `metadata_props` in the ONNX file.

- `keypoint_names`: names in the order of the output, separated by commas; without the key, the user must give them.
- `mean`, `std`: one or three numbers of 0–255, separated by commas, in the network's colour order; default:
  see `read_input`.
- `colour`: `rgb` or `bgr`, the colour order of the input; default `rgb`.
- `input_size`: `width,height`, for an input of variable size; default `256,256`.
- `activation`: `none`, `sigmoid` or `softmax`, the function that turns the output into confidences; default `none`.
- `alignment`: position of the cells of a heatmap, see below; default `centres`, with offsets `deeplabcut`.
- `locref_std`: length in pixels of an offset of 1; default 7.2801, DeepLabCut's.
- `pad_px`, `dilate_px`, `background`: the crops of the training, see `crop_bird`; default 40, 70 (`visible`: 14),
  `black`.

Alignment: position of the centre of cell i, in input pixels (pixel centres at i + 0.5), for w cells over W pixels:

- `centres`: (i + 0.5) · W/w; the cells divide the picture evenly;
- `deeplabcut`: (i + 0.5) · stride + 0.5; DeepLabCut's pixel centres have integer coordinates;
- `msra`: i · W/w + 0.5; MMPose's codec `MSRAHeatmap` (SimpleBaseline, HRNet);
- `udp`: i · (W − 1)/(w − 1) + 0.5; MMPose's codec `UDPHeatmap` (ViTPose): the outermost cells lie on the outermost
  pixels.

Source: `HeatmapPredictor` of DeepLabCut 3, `MSRAHeatmap` and `UDPHeatmap` of MMPose 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy
from annotated_types import Gt
from jaxtyping import Bool, Float, Int, Num, UInt8
from pydantic import (
    BaseModel,
    BeforeValidator,
    FiniteFloat,
    NonNegativeInt,
    PositiveInt,
    StringConstraints,
    ValidationError,
)

from jaxfit.config.perception import Background
from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import IMAGENET_MEAN, IMAGENET_STD, OnnxModel


def _split(text: Any) -> Any:
    return text.split(",") if isinstance(text, str) else text


def _split_colours(text: Any) -> Any:
    values = _split(text)
    return values * 3 if len(values) == 1 else values


_Name = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
_Positive = Annotated[FiniteFloat, Gt(0)]
_Pixels = Annotated[NonNegativeInt, BeforeValidator(lambda text: round(float(text)))]


class KeypointMetadata(BaseModel, frozen=True):
    """The values of the table above; None for a key that is absent and has no default."""

    keypoint_names: Annotated[tuple[_Name, ...], BeforeValidator(_split)] | None = None
    mean: Annotated[tuple[FiniteFloat, FiniteFloat, FiniteFloat], BeforeValidator(_split_colours)] | None = None
    std: Annotated[tuple[_Positive, _Positive, _Positive], BeforeValidator(_split_colours)] | None = None
    colour: Literal["rgb", "bgr"] = "rgb"
    input_size: Annotated[tuple[PositiveInt, PositiveInt], BeforeValidator(_split)] | None = None
    activation: Literal["none", "sigmoid", "softmax"] = "none"
    alignment: Literal["centres", "deeplabcut", "msra", "udp"] | None = None
    locref_std: _Positive = 7.2801
    pad_px: _Pixels | None = None
    dilate_px: _Pixels | None = None
    background: Background | None = None


def read_metadata(model: OnnxModel) -> KeypointMetadata:
    """Read the metadata of a keypoint network.

    Raises:
        InputError: a value that is not valid for its key.
    """
    try:
        return KeypointMetadata.model_validate(model.metadata)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0])
        problem = f"its metadata `{key}` is {model.metadata[key][:100]!r}"
        raise InputError(model.path, problem, f"export it with another value: {first['msg']}") from error


DEFAULT_SIZE_PX = (256, 256)
_DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class KeypointInput(NamedTuple):
    """The input that a keypoint network expects."""

    size_px: tuple[int, int]
    """Width and height of the input, pixels."""
    batch: int | None
    """Fixed number of crops in one run; None for any number."""
    channels_last: bool
    dtype: type[np.generic]
    rgb: bool
    mean: tuple[float, ...]
    std: tuple[float, ...]
    """Within 0–255, in the network's colour order; input of bytes is not normalised."""

    def array(self, pictures: UInt8[np.ndarray, "N h w 3"]) -> Num[np.ndarray, "N _ _ _"]:
        """Convert blue-green-red pictures to the input array: (N, 3, h, w), or (N, h, w, 3) if `channels_last`."""
        if self.rgb:
            pictures = pictures[..., ::-1]
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        if not self.channels_last:  # transposing bytes first is ten times as fast
            pictures, mean, std = pictures.transpose(0, 3, 1, 2), mean[:, None, None], std[:, None, None]
        pictures = np.ascontiguousarray(pictures)
        if self.dtype is np.uint8:
            return pictures
        numbers = pictures.astype(np.float32)
        numbers -= mean
        numbers /= std
        return numbers.astype(self.dtype, copy=False)


def read_input(model: OnnxModel, metadata: KeypointMetadata) -> KeypointInput:
    """Read the expected input from the network's declaration and its metadata.

    Without `mean` and `std` in the metadata, an input (N, 3, h, w) is normalised with ImageNet's values, as in MMPose
    and DeepLabCut 3. An input (N, h, w, 3), the layout of TensorFlow, stays within 0–255, because such networks
    (DeepLabCut 2) subtract the mean themselves. Bytes are never normalised.

    Raises:
        InputError: several inputs, an input without three channels, or an unknown element type.
    """
    if len(model.inputs) != 1 or len(model.inputs[0].shape) != 4 or 3 not in model.inputs[0].shape[1::2]:
        problem = f"has no input for colour pictures: {model.describe()}"
        raise InputError(model.path, problem, "supported is one input (N, 3, h, w) or (N, h, w, 3)")
    port = model.inputs[0]
    if port.kind not in _DTYPES:
        raise InputError(model.path, f"has an input of type {port.kind}", f"supported are {', '.join(_DTYPES)}")
    channels_last = port.shape[1] != 3
    height, width = port.shape[1:3] if channels_last else port.shape[2:]
    default = metadata.input_size or DEFAULT_SIZE_PX
    width, height = width or default[0], height or default[1]
    return KeypointInput(
        size_px=(width, height),
        batch=port.shape[0],
        channels_last=channels_last,
        dtype=_DTYPES[port.kind],
        rgb=metadata.colour == "rgb",
        mean=metadata.mean or ((0.0,) * 3 if channels_last else _in_bytes(IMAGENET_MEAN, metadata.colour)),
        std=metadata.std or ((1.0,) * 3 if channels_last else _in_bytes(IMAGENET_STD, metadata.colour)),
    )


def _in_bytes(rgb: tuple[float, ...], colour: str) -> tuple[float, ...]:
    """Scale red-green-blue values of [0, 1] to 0–255, in the given colour order."""
    scaled = tuple(255 * value for value in rgb)
    return scaled if colour == "rgb" else scaled[::-1]


_FLOOR = 1e-6  # lower bound before the logarithm


def apply_activation(
    values: Float[np.ndarray, "N K *B"], activation: str
) -> tuple[Float[np.ndarray, "N K *B"], Bool[np.ndarray, "N K"]]:
    """Apply the activation that turns the network's output into confidences.

    Args:
        values: one map or one vector for each keypoint.
        activation: as in `KeypointMetadata`; the softmax runs over a whole map.

    Returns:
        The confidences, and whether all values of a keypoint are finite. If not, its confidences are those of zeros.
    """
    axes = tuple(range(2, values.ndim))
    finite = np.asarray(np.isfinite(values).all(axis=axes))
    values = np.where(np.expand_dims(finite, axes), values, 0)
    if activation == "sigmoid":
        values = scipy.special.expit(values)
    elif activation == "softmax":
        values = scipy.special.softmax(values, axis=axes)
    return values, finite


def heatmap_peaks(heatmaps: Float[np.ndarray, "N K h w"]) -> tuple[Int[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]:
    """Return the cells (x, y) of the largest values, and the largest values."""
    flat = heatmaps.reshape(*heatmaps.shape[:2], -1)
    best = flat.argmax(axis=-1)
    y, x = np.divmod(best, heatmaps.shape[-1])
    return np.stack([x, y], -1), np.take_along_axis(flat, best[..., None], -1)[..., 0]


def subcell_offsets(
    heatmaps: Float[np.ndarray, "N K h w"], cells: Int[np.ndarray, "N K 2"]
) -> Float[np.ndarray, "N K 2"]:
    """Estimate the offset (x, y), in cells, from the centre of the largest cell to the peak of the heatmap.

    The offset is −H⁻¹ ∇, with the gradient ∇ and the Hessian H of ln(heatmap) from central differences at the cell. It
    is exact for a Gaussian of any width and direction. It is 0 where H is not that of a peak, is 0 across the border
    for a cell at the border, and is at most one cell.

    Source: Zhang et al. 2020 (DARK), equations 7 and 8, without the smoothing.
    """
    N, K, h, w = heatmaps.shape
    rows = _mirror(cells[..., 1, None] + np.arange(-1, 2), h)[..., :, None]
    columns = _mirror(cells[..., 0, None] + np.arange(-1, 2), w)[..., None, :]
    n, k = np.arange(N)[:, None, None, None], np.arange(K)[:, None, None]
    around = heatmaps[n, k, rows, columns].astype(np.float64)  # (N, K, 3, 3)
    log = np.log(np.maximum(around, _FLOOR))
    x = (log[..., 1, 2] - log[..., 1, 0]) / 2
    y = (log[..., 2, 1] - log[..., 0, 1]) / 2
    xx = log[..., 1, 2] - 2 * log[..., 1, 1] + log[..., 1, 0]
    yy = log[..., 2, 1] - 2 * log[..., 1, 1] + log[..., 0, 1]
    xy = (log[..., 2, 2] - log[..., 2, 0] - log[..., 0, 2] + log[..., 0, 0]) / 4
    determinant = xx * yy - xy**2
    is_peak = (xx < 0) & (determinant > 1e-9)
    scale = np.where(is_peak, -1 / np.where(is_peak, determinant, 1), 0)
    offsets = np.stack([yy * x - xy * y, xx * y - xy * x], -1) * scale[..., None]
    return np.clip(offsets, -1, 1)


def simcc_peaks(
    simcc_x: Float[np.ndarray, "N K X"], simcc_y: Float[np.ndarray, "N K Y"]
) -> tuple[Int[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]:
    """Return the bins (x, y) of the largest values, and the smaller of the two values.

    Source: `get_simcc_maximum` of MMPose 1.
    """
    bins = np.stack([simcc_x.argmax(axis=-1), simcc_y.argmax(axis=-1)], -1)
    return bins, np.minimum(simcc_x.max(axis=-1), simcc_y.max(axis=-1))


def _mirror(index: Int[np.ndarray, "*B"], length: int) -> Int[np.ndarray, "*B"]:
    """Mirror indices at the border (−1 → 1, length → length − 2), so that the slope across the border is 0."""
    return np.clip((length - 1) - np.abs((length - 1) - np.abs(index)), 0, length - 1)


KINDS = ("auto", "heatmap", "deeplabcut", "simcc")
_SUPPORTED = (
    "supported are heatmaps (N, K, h, w); heatmaps with offsets (N, 2K, h, w) as in DeepLabCut; both also with the "
    "channels last; `simcc_x` (N, K, a·width) with `simcc_y` (N, K, a·height) as in RTMPose"
)
Outputs = Mapping[str, np.ndarray]
Points = tuple[Float[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]
"""Positions (x, y in input pixels, pixel centres at i + 0.5), and confidences within [0, 1]."""


@dataclass(frozen=True)
class HeatmapLayout:
    """One heatmap for each keypoint, with or without offsets from the centres of the cells.

    The channels of the offsets are x and y of the first keypoint, x and y of the second keypoint, and so on, in units
    of `locref_std` pixels. Without offsets, `subcell_offsets` locates the peak between the cells.
    """

    heatmap: str
    """Name of the output with the heatmaps."""
    locref: str | None
    """Name of the output with the offsets; None without offsets."""
    channels_last: bool
    size_px: tuple[int, int]
    """Width and height of the network's input."""
    activation: str
    alignment: str
    locref_std: float

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that the layout reads."""
        return (self.heatmap,) if self.locref is None else (self.heatmap, self.locref)

    def __call__(self, outputs: Outputs) -> Points:
        heatmaps, finite = apply_activation(self._channels_first(outputs[self.heatmap]), self.activation)
        cells, peaks = heatmap_peaks(heatmaps)
        first, stride = self._grid(heatmaps.shape[-1], heatmaps.shape[-2])
        if self.locref is None:
            return first + stride * (cells + subcell_offsets(heatmaps, cells)), _confidence(peaks, finite)
        locref = self._channels_first(outputs[self.locref])
        locref = locref.reshape(*peaks.shape, 2, *locref.shape[2:])
        n, k = np.arange(len(cells))[:, None], np.arange(cells.shape[1])
        offsets = locref[n, k, :, cells[..., 1], cells[..., 0]] * self.locref_std
        finite &= np.isfinite(offsets).all(axis=-1)
        points = first + stride * cells + np.where(finite[..., None], offsets, 0)
        return points, _confidence(peaks, finite)

    def _channels_first(self, maps: np.ndarray) -> Float[np.ndarray, "N C h w"]:
        maps = maps.astype(np.float32, copy=False)
        return maps.transpose(0, 3, 1, 2) if self.channels_last else maps

    def _grid(self, width: int, height: int) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Return the centre of the first cell and the distance between cells, x and y in input pixels."""
        cells, pixels = np.array([width, height]), np.array(self.size_px)
        stride = pixels / cells
        if self.alignment == "msra":
            return np.full(2, 0.5), stride
        if self.alignment == "udp":
            return np.full(2, 0.5), (pixels - 1) / np.maximum(cells - 1, 1)
        if self.alignment == "deeplabcut":
            stride = np.round(stride)  # the maps extend beyond a picture whose sides are not multiples of the stride
            return stride / 2 + 0.5, stride
        return stride / 2, stride


@dataclass(frozen=True)
class SimccLayout:
    """SimCC: for each keypoint, one value for every bin along x and for every bin along y.

    MMPose's pixel centres have integer coordinates, so bin i of n lies at i · side/n + 0.5.

    Source: Li et al. 2022 (SimCC); `SimCCLabel` of MMPose 1.
    """

    x: str
    """Name of the output along x."""
    y: str
    """Name of the output along y."""
    size_px: tuple[int, int]
    """Width and height of the network's input."""
    activation: str

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that the layout reads."""
        return self.x, self.y

    def __call__(self, outputs: Outputs) -> Points:
        x, x_finite = apply_activation(outputs[self.x].astype(np.float32, copy=False), self.activation)
        y, y_finite = apply_activation(outputs[self.y].astype(np.float32, copy=False), self.activation)
        bins, values = simcc_peaks(x, y)
        points = bins * (np.array(self.size_px) / [x.shape[2], y.shape[2]]) + 0.5
        return points, _confidence(values, x_finite & y_finite)


def detect_layout(
    model: OnnxModel, outputs: Outputs, kind: str, network_input: KeypointInput, metadata: KeypointMetadata
) -> tuple[HeatmapLayout | SimccLayout, int]:
    """Determine the layout of a network's outputs from the outputs of a first run.

    Args:
        model: the network, for messages.
        outputs: outputs of one run.
        kind: one of `KINDS`; `heatmap` ignores offsets.
        network_input: the input; if an output fits both orders of axes, the order of the input decides.
        metadata: metadata of the file.

    Returns:
        The layout, and the number of keypoints.

    Raises:
        InputError: unknown kind or unknown layout.
    """
    if kind not in KINDS:
        raise InputError(kind, "is not a kind of keypoint network", f"supported are {', '.join(KINDS)}")
    size_px = network_input.size_px
    if kind in ("auto", "simcc") and (pair := _simcc_pair(outputs, size_px)):
        return SimccLayout(*pair, size_px, metadata.activation), outputs[pair[0]].shape[1]
    if kind != "simcc" and (names := _heatmaps(outputs, size_px, network_input.channels_last)):
        heatmap, locref, last = names
        if kind == "heatmap":
            locref = None
        if locref or kind != "deeplabcut":
            alignment = metadata.alignment or ("deeplabcut" if locref else "centres")
            layout = HeatmapLayout(heatmap, locref, last, size_px, metadata.activation, alignment, metadata.locref_std)
            return layout, outputs[heatmap].shape[3 if last else 1]
    required = "" if kind == "auto" else f" of kind `{kind}`"
    raise InputError(model.path, f"is not a supported keypoint network{required}: {model.describe()}", _SUPPORTED)


def _simcc_pair(outputs: Outputs, size_px: tuple[int, int]) -> tuple[str, str] | None:
    """Return the names of the outputs along x and y."""
    named = ("simcc_x", "simcc_y")
    pair = named if set(named) <= set(outputs) else tuple(outputs)
    if len(pair) != 2 or any(np.ndim(outputs[name]) != 3 for name in pair):
        return None
    x, y = (outputs[name].shape for name in pair)
    same_ratio = x[2] * size_px[1] == y[2] * size_px[0]
    return pair if x[:2] == y[:2] and same_ratio and min(*x, *y) >= 1 else None


def _heatmaps(outputs: Outputs, size_px: tuple[int, int], channels_last: bool) -> tuple[str, str | None, bool] | None:
    """Return the name of the heatmaps, the name of the offsets, and whether the channels come last."""
    maps = {name: np.shape(value) for name, value in outputs.items() if np.ndim(value) == 4}
    for heatmap, locref in permutations(maps, 2):
        n, a, b, c = maps[heatmap]
        for last, expected in ((False, (n, 2 * a, b, c)), (True, (n, a, b, 2 * c))):
            if maps[locref] == expected and _covers(maps[heatmap], last, size_px):
                return heatmap, locref, last
    if len(maps) == 1:
        ((heatmap, shape),) = maps.items()
        for last in (channels_last, not channels_last):
            if _covers(shape, last, size_px):
                return heatmap, None, last
    return None


def _covers(shape: tuple[int, ...], channels_last: bool, size_px: tuple[int, int]) -> bool:
    """Whether the cells over the input are square, up to the rounding of their number."""
    height, width = shape[1:3] if channels_last else shape[2:]
    if not height or not width:
        return False
    return abs(size_px[0] / width - size_px[1] / height) <= 0.1 * size_px[0] / width


def _confidence(values: Float[np.ndarray, "N K"], finite: Bool[np.ndarray, "N K"]) -> Float[np.ndarray, "N K"]:
    return np.where(finite, np.clip(values, 0, 1), 0)
