"""Settings of tracking: from the frames of a video to tracks of keypoints and masks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Le
from pydantic import NonNegativeInt, PositiveInt

from jaxfit.config.build import Fraction, config_dataclass
from jaxfit.config.checks import require


@config_dataclass
class FramesConfig:
    """The frames of a video that are processed; frames count from 0."""

    start: NonNegativeInt = 0
    """First frame, counted from 0."""
    stop: NonNegativeInt | None = None
    """Frame to stop before; by default (null), all frames to the end are processed."""
    step: PositiveInt = 1
    """Process every N-th frame."""

    def __post_init__(self):
        problem = f"is {self.stop}, and `start` is {self.start}"
        require(self.stop is None or self.stop > self.start, "stop", problem, "expected a frame after `start`, or null")


AUTO, BUILTIN, GENERAL = "auto", "builtin", "general"
"""Names of segmenters in place of a file."""
OUTLINE = "outline"
"""Name of the keypoint network that sees outlines only, in place of a file."""


@config_dataclass
class SegmenterConfig:
    """The network that detects birds in a frame."""

    file: str = AUTO
    """Network that detects birds: `builtin` (for murres, trained on simulated footage); `general`, `general-tiny` or
    `general-s` (for all birds; two files that the user downloads); `auto` (`builtin` where trust in it is high on eight
    frames, or else a general network that is downloaded and detects a bird); an ONNX file; or
    `detector.onnx+saliency.onnx`."""
    kind: str = "auto"
    """Layout of the network's output: bottom_up, rf_detr, mask_rcnn, yolo, yolox+saliency; `auto` infers the layout
    from the file."""
    names: tuple[str, ...] = ()
    """Names of all classes in the order of the output, for a file that does not contain the names."""
    classes: tuple[str, ...] = ()
    """Names of the classes to detect; an empty list selects `bird`, or the only class of the network."""
    min_score: Fraction | None = None
    """Smallest score of a detection, within 0 and 1; null uses the default of the layout."""
    tile_px: Annotated[int, Ge(32)] | None = None
    """Side of the square tiles that large frames are cut into, for birds that are small in the frame, in pixels; null
    uses no tiles."""
    tile_overlap: Annotated[float, Ge(0), Le(0.9)] = 0.25
    """Overlap of neighbouring tiles as a fraction of the tile's side; an overlap wider than a bird works best."""


Background = Literal["black", "visible", "outline"]
"""What the crop of a bird shows around the bird; `outline` shows the masks alone."""


@config_dataclass
class KeypointsConfig:
    """The network that detects the keypoints of each bird."""

    file: str = AUTO
    """Network that detects keypoints: `builtin` (for murres, trained on simulated footage), `outline` (for all birds,
    from the masks alone), `auto` (`outline` if a general segmenter detects the birds, or else `builtin`), or an ONNX
    file."""
    kind: str = "auto"
    """Layout of the network's output: heatmap, deeplabcut, simcc; `auto` infers the layout from the file's inputs and
    outputs."""
    names: str | tuple[str, ...] = ()
    """Names of the keypoints in the order of the output, or `murre`, `aves`, `avian-mesh` for the names of that model;
    an empty list uses the names in the file."""
    pad_px: NonNegativeInt | None = None
    """Margin of a bird's crop around the bird's mask, in image pixels; null uses the value in the file, or the paper's
    40."""
    dilate_px: NonNegativeInt | None = None
    """Side of the square that dilates the masks before the blanking, in image pixels; null uses the value in the file,
    or the paper's 70 (14 for a visible background)."""
    background: Background | None = None
    """What a bird's crop shows around the bird: `black` blanks everything outside the bird's mask, as the paper does;
    `visible` blanks other birds only; null uses the value in the file, or `black`."""
    batch: PositiveInt = 16
    """Number of crops per network call, for a network that does not fix the number."""


@config_dataclass
class TrackerConfig:
    """The tracker, which links the detections of consecutive frames into tracks."""

    name: str = "iou"
    """Tracker: `iou` (the paper's), or `bytetrack`, `ocsort`, `botsort` of the optional package `trackers`."""
    memory: NonNegativeInt = 5
    """Number of consecutive frames without a detection that a track survives; the paper uses 5."""
    min_iou: Fraction = 0.1
    """Two boxes in consecutive frames belong to one bird only if their IoU is above this value."""
    min_score: Fraction = 0.6
    """Smallest score of a detection that starts a track; `iou` ignores this setting."""


@config_dataclass
class TrackConfig:
    """All settings of tracking; the defaults are the paper's settings with the built-in networks."""

    removed: ClassVar[Mapping[str, str]] = {
        "repair_left_right_flips": "remove the key: fits of repaired keypoints were not better, because the fit treats "
        "exchanged sides as outliers"
    }
    """Keys of earlier versions → what to do. Configs of earlier results hold such keys with `false`."""

    frames: FramesConfig = FramesConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    keypoints: KeypointsConfig = KeypointsConfig()
    tracker: TrackerConfig = TrackerConfig()
    min_track_frames: PositiveInt = 10
    """Tracks with fewer frames are skipped."""
    min_track_score: Fraction | None = None
    """Tracks with a lower mean score are skipped; null uses the value in the file of the segmenter (0.65 for the
    built-in segmenter), or 0."""
    threads: PositiveInt | None = None
    """Number of frames on which the networks run at the same time, at most 8; null uses the number of CPU cores."""
