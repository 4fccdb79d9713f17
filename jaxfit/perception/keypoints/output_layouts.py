"""Output layouts of keypoint networks, and their decoding into input pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.errors import InputError
from jaxfit.perception.keypoints.heatmaps import apply_activation, heatmap_peaks, simcc_peaks, subcell_offsets
from jaxfit.perception.keypoints.inputs import KeypointInput
from jaxfit.perception.keypoints.metadata import KeypointMetadata
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["KINDS", "HeatmapLayout", "SimccLayout", "detect_layout"]

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
