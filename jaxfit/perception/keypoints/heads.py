"""Which outputs of a keypoint network mean what, and their way to pixels of its input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.errors import InputError
from jaxfit.perception.keypoints.decode import activated, heatmap_peaks, simcc_peaks, subcell_offsets
from jaxfit.perception.keypoints.notes import Notes
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["KINDS", "HeatmapHead", "SimccHead", "find_head"]

KINDS = ("auto", "heatmap", "deeplabcut", "simcc")
KNOWN = (
    "known are heatmaps (N, K, h, w), the same with offsets (N, 2K, h, w) as DeepLabCut has them, both also with the "
    "channels last, and `simcc_x` (N, K, a·width) with `simcc_y` (N, K, a·height) as RTMPose is exported"
)
Outputs = Mapping[str, np.ndarray]
Points = tuple[Float[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]
"""x, y in input pixels, centres at i + 0.5, and confidences within [0, 1]."""


@dataclass(frozen=True)
class HeatmapHead:
    """One heatmap for each keypoint, with or without offsets from the cells' centres.

    Offsets come as x and y of the first keypoint, x and y of the second, … in units of `locref_std` pixels. Without
    them, the peak is found between the cells (`subcell_offsets`).
    """

    heatmap: str
    """Name of the output."""
    locref: str | None
    """Name of the output with the offsets."""
    channels_last: bool
    size_px: tuple[int, int]
    """Of the network's input."""
    activation: str
    alignment: str
    locref_std: float

    def __call__(self, outputs: Outputs) -> Points:
        heatmaps, finite = activated(self._channels_first(outputs[self.heatmap]), self.activation)
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
        """Centre of the first cell and distance of the cells, input pixels, x and y."""
        cells, pixels = np.array([width, height]), np.array(self.size_px)
        stride = pixels / cells
        if self.alignment == "msra":
            return np.full(2, 0.5), stride
        if self.alignment == "udp":
            return np.full(2, 0.5), (pixels - 1) / np.maximum(cells - 1, 1)
        if self.alignment == "deeplabcut":
            stride = np.round(stride)  # its maps may reach over a picture whose sides are no multiples of it
            return stride / 2 + 0.5, stride
        return stride / 2, stride


@dataclass(frozen=True)
class SimccHead:
    """Classes of coordinates: for each keypoint, a value for every bin along x and every bin along y.

    MMPose counts pixel centres at whole numbers, so bin i of n lies at i · side/n + 0.5.

    Source: Li et al. 2022 (SimCC); `SimCCLabel` of MMPose 1.
    """

    x: str
    """Name of the output along x."""
    y: str
    """Name of the output along y."""
    size_px: tuple[int, int]
    """Of the network's input."""
    activation: str

    def __call__(self, outputs: Outputs) -> Points:
        x, x_finite = activated(outputs[self.x].astype(np.float32, copy=False), self.activation)
        y, y_finite = activated(outputs[self.y].astype(np.float32, copy=False), self.activation)
        bins, values = simcc_peaks(x, y)
        points = bins * (np.array(self.size_px) / [x.shape[2], y.shape[2]]) + 0.5
        return points, _confidence(values, x_finite & y_finite)


def find_head(
    model: OnnxModel, outputs: Outputs, kind: str, size_px: tuple[int, int], channels_last: bool, notes: Notes
) -> tuple[HeatmapHead | SimccHead, int]:
    """The head of a network, told from the outputs of a first run.

    Args:
        model: named in messages.
        outputs: of one run.
        kind: one of `KINDS`; `heatmap` overlooks offsets.
        size_px: width and height of the input.
        channels_last: of the input; decides where the output fits both orders.
        notes: what the file says.

    Returns:
        The head, and the number of its keypoints.

    Raises:
        InputError: a kind that does not exist, or a layout that is not known.
    """
    if kind not in KINDS:
        raise InputError(kind, "is no kind of keypoint network", f"known are {', '.join(KINDS)}")
    if kind in ("auto", "simcc") and (pair := _simcc_pair(outputs, size_px)):
        return SimccHead(*pair, size_px, notes.activation), outputs[pair[0]].shape[1]
    if kind != "simcc" and (found := _heatmaps(outputs, size_px, channels_last)):
        heatmap, locref, last = found
        if kind == "heatmap":
            locref = None
        if locref or kind != "deeplabcut":
            alignment = notes.alignment or ("deeplabcut" if locref else "centres")
            head = HeatmapHead(heatmap, locref, last, size_px, notes.activation, alignment, notes.locref_std)
            return head, outputs[heatmap].shape[3 if last else 1]
    what = "" if kind == "auto" else f" of kind `{kind}`"
    raise InputError(model.path, f"is no keypoint network{what} that is known: {model.describe()}", KNOWN)


def _simcc_pair(outputs: Outputs, size_px: tuple[int, int]) -> tuple[str, str] | None:
    named = ("simcc_x", "simcc_y")
    pair = named if set(named) <= set(outputs) else tuple(outputs)
    if len(pair) != 2 or any(np.ndim(outputs[name]) != 3 for name in pair):
        return None
    x, y = (outputs[name].shape for name in pair)
    same_ratio = x[2] * size_px[1] == y[2] * size_px[0]
    return pair if x[:2] == y[:2] and same_ratio else None


def _heatmaps(outputs: Outputs, size_px: tuple[int, int], channels_last: bool) -> tuple[str, str | None, bool] | None:
    """Name of the heatmaps, name of the offsets, whether channels come last."""
    maps = {name: np.shape(value) for name, value in outputs.items() if np.ndim(value) == 4}
    for heatmap, locref in permutations(maps, 2):
        n, a, b, c = maps[heatmap]
        for last, wanted in ((False, (n, 2 * a, b, c)), (True, (n, a, b, 2 * c))):
            if maps[locref] == wanted and _covers(maps[heatmap], last, size_px):
                return heatmap, locref, last
    if len(maps) == 1:
        ((heatmap, shape),) = maps.items()
        for last in (channels_last, not channels_last):
            if _covers(shape, last, size_px):
                return heatmap, None, last
    return None


def _covers(shape: tuple[int, ...], channels_last: bool, size_px: tuple[int, int]) -> bool:
    """Whether square cells make up the picture, to the rounding of their number."""
    height, width = shape[1:3] if channels_last else shape[2:]
    if not height or not width:
        return False
    return abs(size_px[0] / width - size_px[1] / height) <= 0.1 * size_px[0] / width


def _confidence(values: Float[np.ndarray, "N K"], finite: Bool[np.ndarray, "N K"]) -> Float[np.ndarray, "N K"]:
    return np.where(finite, np.clip(values, 0, 1), 0)
