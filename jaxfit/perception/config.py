"""What tracking can be told, from frames to tracks of keypoints and masks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxfit.config_file import require

__all__ = ["FramesConfig", "KeypointsConfig", "SegmenterConfig", "TrackConfig", "TrackerConfig"]


@dataclass(frozen=True)
class FramesConfig:
    """Which frames of a video are looked at, counted from 0."""

    start: int = 0
    """The first one."""
    stop: int | None = None
    """The one to stop before; null goes on to the end."""
    step: int = 1
    """Every how many-th."""

    def __post_init__(self):
        require(self.start >= 0, "start", f"is {self.start}", "0 or more")
        require(self.step >= 1, "step", f"is {self.step}", "1 or more")
        ends = self.stop is None or self.stop > self.start
        require(ends, "stop", f"is {self.stop}, and `start` {self.start}", "a frame after the first one, or null")


@dataclass(frozen=True)
class SegmenterConfig:
    """The network that finds birds in a frame."""

    file: str = "builtin"
    """`builtin` (murres, trained on simulated footage), an ONNX file, or `detector.onnx+saliency.onnx`."""
    kind: str = "auto"
    """Layout of its output; `auto` tells it from the file's inputs and outputs."""
    classes: tuple[str, ...] = ()
    """Classes to look for, by name; none stands for the birds among them."""
    min_score: float = 0.5
    """Instances that the network trusts less are left out."""
    tile_px: int | None = None
    """Side of the tiles that a large frame is cut into, so that small birds stay large enough; null takes it whole."""
    tile_overlap: float = 0.2
    """Share of a tile that it has in common with the next one."""

    def __post_init__(self):
        require(0 <= self.min_score <= 1, "min_score", f"is {self.min_score}", "a number within 0 and 1")
        require(self.tile_px is None or self.tile_px >= 32, "tile_px", f"is {self.tile_px}", "32 or more, or null")
        require(0 <= self.tile_overlap < 1, "tile_overlap", f"is {self.tile_overlap}", "0 or more and below 1")


@dataclass(frozen=True)
class KeypointsConfig:
    """The network that finds the keypoints of each bird."""

    file: str = "builtin"
    """`builtin` (the murre's, trained on simulated footage) or an ONNX file."""
    kind: str = "auto"
    """Layout of its output; `auto` tells it from the file's inputs and outputs."""
    names: tuple[str, ...] = ()
    """Its keypoints in the order of its output; none takes those that the file says, or the murre's."""
    pad_px: float = 40.0
    """Margin around a bird's mask that its crop shows, image pixels."""
    dilate_px: int = 70
    """Side of the square by which the mask is dilated before all else is blanked, image pixels."""
    batch: int = 8
    """Crops that the network is given at once."""

    def __post_init__(self):
        require(0 <= self.pad_px < math.inf, "pad_px", f"is {self.pad_px}", "0 or more")
        require(self.dilate_px >= 0, "dilate_px", f"is {self.dilate_px}", "0 or more")
        require(self.batch >= 1, "batch", f"is {self.batch}", "1 or more")


@dataclass(frozen=True)
class TrackerConfig:
    """What tells which bird of one frame is which of the next."""

    name: str = "iou"
    """`iou` (the paper's), or `bytetrack` or `ocsort` of the optional `trackers` package."""
    memory: int = 5
    """Frames for which a bird may be missed without losing its identity."""
    min_iou: float = 0.1
    """Least overlap of two boxes of the same bird in consecutive frames."""

    def __post_init__(self):
        require(self.memory >= 0, "memory", f"is {self.memory}", "0 or more frames")
        require(0 <= self.min_iou <= 1, "min_iou", f"is {self.min_iou}", "a number within 0 and 1")


@dataclass(frozen=True)
class TrackConfig:
    """Everything about tracking; the defaults are the paper's setting with the built-in networks."""

    frames: FramesConfig = FramesConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    keypoints: KeypointsConfig = KeypointsConfig()
    tracker: TrackerConfig = TrackerConfig()
    min_track_frames: int = 10
    """Birds seen in fewer frames are left out."""
    repair_swaps: bool = False
    """Exchange left and right keypoints back where a network mixed them up for some frames."""
    threads: int | None = None
    """Cores that the networks use; null takes all."""

    def __post_init__(self):
        require(self.min_track_frames >= 1, "min_track_frames", f"is {self.min_track_frames}", "1 or more")
        require(self.threads is None or self.threads >= 1, "threads", f"is {self.threads}", "1 or more, or null")
