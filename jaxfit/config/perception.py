"""Settings of tracking: from the frames of a video to tracks of keypoints and masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxfit.config.checks import require, require_fraction, require_within
from jaxfit.foundation import limits


@dataclass(frozen=True)
class FramesConfig:
    """The frames of a video that are processed; frames count from 0."""

    start: int = 0
    """First frame, counted from 0."""
    stop: int | None = None
    """Frame to stop before; by default (null), all frames to the end are processed."""
    step: int = 1
    """Process every N-th frame."""

    def __post_init__(self):
        require_within(self, 0, limits.FRAME_NUMBER, "start", "stop")
        require_within(self, 1, limits.FRAME_NUMBER, "step")
        problem = f"is {self.stop}, and `start` is {self.start}"
        require(self.stop is None or self.stop > self.start, "stop", problem, "expected a frame after `start`, or null")


AUTO, BUILTIN, GENERAL = "auto", "builtin", "general"
"""Names of segmenters in place of a file."""


@dataclass(frozen=True)
class SegmenterConfig:
    """The network that detects birds in a frame."""

    file: str = AUTO
    """Network that detects birds: `builtin` (for murres, trained on simulated footage), `general` (for all birds; two
    files that the user downloads), `auto` (one of both, by eight frames; without the two files, `builtin`), an ONNX
    file, or `detector.onnx+saliency.onnx`."""
    kind: str = "auto"
    """Layout of the network's output: bottom_up, rf_detr, mask_rcnn, yolo, yolox+saliency; `auto` infers the layout
    from the file."""
    names: tuple[str, ...] = ()
    """Names of all classes in the order of the output, for a file that does not contain the names."""
    classes: tuple[str, ...] = ()
    """Names of the classes to detect; an empty list selects `bird`, or the only class of the network."""
    min_score: float | None = None
    """Smallest score of a detection, within 0 and 1; null uses the default of the layout."""
    tile_px: int | None = None
    """Side of the square tiles that large frames are cut into, for birds that are small in the frame, in pixels; null
    uses no tiles."""
    tile_overlap: float = 0.25
    """Overlap of neighbouring tiles as a fraction of the tile's side; an overlap wider than a bird works best."""

    def __post_init__(self):
        require_fraction(self, "min_score")
        require_within(self, 32, limits.IMAGE_SIDE_PX, "tile_px")
        require_within(self, 0, limits.TILE_OVERLAP, "tile_overlap")


Background = Literal["black", "visible"]
"""What the crop of a bird shows around the bird."""


@dataclass(frozen=True)
class KeypointsConfig:
    """The network that detects the keypoints of each bird."""

    file: str = "builtin"
    """Network that detects keypoints: `builtin` (for murres, trained on simulated footage) or an ONNX file."""
    kind: str = "auto"
    """Layout of the network's output: heatmap, deeplabcut, simcc; `auto` infers the layout from the file's inputs and
    outputs."""
    names: str | tuple[str, ...] = ()
    """Names of the keypoints in the order of the output, or `murre`, `aves`, `avian-mesh` for the names of that model;
    an empty list uses the names in the file."""
    pad_px: int | None = None
    """Margin of a bird's crop around the bird's mask, in image pixels; null uses the value in the file, or the paper's
    40."""
    dilate_px: int | None = None
    """Side of the square that dilates the masks before the blanking, in image pixels; null uses the value in the file,
    or the paper's 70 (14 for a visible background)."""
    background: Background | None = None
    """What a bird's crop shows around the bird: `black` blanks everything outside the bird's mask, as the paper does;
    `visible` blanks other birds only; null uses the value in the file, or `black`."""
    batch: int = 16
    """Number of crops per network call, for a network that does not fix the number."""

    def __post_init__(self):
        require_within(self, 0, limits.CROP_MARGIN_PX, "pad_px", "dilate_px")
        require_within(self, 1, limits.CROPS_PER_CALL, "batch")


@dataclass(frozen=True)
class TrackerConfig:
    """The tracker, which links the detections of consecutive frames into tracks."""

    name: str = "iou"
    """Tracker: `iou` (the paper's), or `bytetrack`, `ocsort`, `botsort` of the optional package `trackers`."""
    memory: int = 5
    """Number of consecutive frames without a detection that a track survives; the paper uses 5."""
    min_iou: float = 0.1
    """Two boxes in consecutive frames belong to one bird only if their IoU is above this value."""
    min_score: float = 0.6
    """Smallest score of a detection that starts a track; `iou` ignores this setting."""

    def __post_init__(self):
        require_within(self, 0, limits.TRACKER_MEMORY, "memory")
        require_fraction(self, "min_iou", "min_score")


@dataclass(frozen=True)
class TrackConfig:
    """All settings of tracking; the defaults are the paper's settings with the built-in networks."""

    frames: FramesConfig = FramesConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    keypoints: KeypointsConfig = KeypointsConfig()
    tracker: TrackerConfig = TrackerConfig()
    min_track_frames: int = 10
    """Tracks with fewer frames are skipped."""
    min_track_score: float | None = None
    """Tracks with a lower mean score are skipped; null uses the value in the file of the segmenter (0.65 for the
    built-in segmenter), or 0."""
    repair_left_right_flips: bool = False
    """Exchange left and right keypoints in frames where the network confuses the two sides; the paper does not."""
    threads: int | None = None
    """Number of CPU cores for each of the two networks, which run at the same time; null uses all cores."""

    def __post_init__(self):
        require_within(self, 1, limits.FRAME_NUMBER, "min_track_frames")
        require_fraction(self, "min_track_score")
        require_within(self, 1, limits.THREADS, "threads")
