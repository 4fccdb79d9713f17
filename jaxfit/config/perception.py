"""What tracking can be told, from frames to tracks of keypoints and masks."""

from __future__ import annotations

from dataclasses import dataclass

from jaxfit.config.yaml_file import require

__all__ = ["FramesConfig", "KeypointsConfig", "SegmenterConfig", "TrackConfig", "TrackerConfig"]


def _require_share(key: str, value: float | None, remedy: str) -> None:
    require(value is None or 0 <= value <= 1, key, f"is {value}", remedy)


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
    """Layout of its output (bottom_up, rf_detr, mask_rcnn, yolo, yolox+saliency); `auto` tells it from the file."""
    names: tuple[str, ...] = ()
    """All its classes in their order, where the file does not say them."""
    classes: tuple[str, ...] = ()
    """Classes to look for, by name; none stands for `bird`, or the only class there is."""
    min_score: float | None = None
    """Instances that the network trusts less are left out, within [0, 1]; null takes what suits its layout."""
    tile_px: int | None = None
    """Side of the tiles that large frames are cut into, so that birds stay large enough; null takes frames whole."""
    tile_overlap: float = 0.25
    """Share of a tile that it has in common with the next one; wider than a bird is best."""

    def __post_init__(self):
        _require_share("min_score", self.min_score, "a number within 0 and 1, or null")
        require(self.tile_px is None or self.tile_px >= 32, "tile_px", f"is {self.tile_px}", "32 or more, or null")
        require(0 <= self.tile_overlap < 1, "tile_overlap", f"is {self.tile_overlap}", "0 or more and below 1")


@dataclass(frozen=True)
class KeypointsConfig:
    """The network that finds the keypoints of each bird."""

    file: str = "builtin"
    """`builtin` (the murre's, trained on simulated footage) or an ONNX file."""
    kind: str = "auto"
    """Layout of its output (heatmap, deeplabcut, simcc); `auto` tells it from the file's inputs and outputs."""
    names: str | tuple[str, ...] = ()
    """Its keypoints in the order of its output, or `murre`, `aves`, `avian-mesh`; none takes those the file says."""
    pad_px: int | None = None
    """Margin around a bird's mask that its crop shows, image pixels; null takes the file's, or the paper's 40."""
    dilate_px: int | None = None
    """Side of the square that the mask is dilated by before all else is blanked, image pixels; null takes the file's,
    or the paper's 70."""
    batch: int = 16
    """Crops that the network is given at once, where it leaves that open."""

    def __post_init__(self):
        for name in ("pad_px", "dilate_px"):
            value = getattr(self, name)
            require(value is None or value >= 0, name, f"is {value}", "0 or more, or null")
        require(self.batch >= 1, "batch", f"is {self.batch}", "1 or more")


@dataclass(frozen=True)
class TrackerConfig:
    """What tells which bird of one frame is which of the next."""

    name: str = "iou"
    """`iou` (the paper's); `bytetrack`, `ocsort` or `botsort` of the optional `trackers` package."""
    memory: int = 5
    """Frames for which a bird may be missed without losing its identity."""
    min_iou: float = 0.1
    """Boxes of the same bird overlap by more than this from frame to frame."""
    min_score: float = 0.6
    """Instances that the network trusts less begin no track; `iou` takes all."""

    def __post_init__(self):
        require(self.memory >= 0, "memory", f"is {self.memory}", "0 or more frames")
        for name in ("min_iou", "min_score"):
            _require_share(name, getattr(self, name), "a number within 0 and 1")


@dataclass(frozen=True)
class TrackConfig:
    """Everything about tracking; the defaults are the paper's setting with the built-in networks."""

    frames: FramesConfig = FramesConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    keypoints: KeypointsConfig = KeypointsConfig()
    tracker: TrackerConfig = TrackerConfig()
    min_track_frames: int = 10
    """Birds seen in fewer frames are left out."""
    repair_left_right_flips: bool = False
    """Exchange left and right keypoints back where a network mixed them up for some frames."""
    threads: int | None = None
    """Cores that the networks use; null takes all."""

    def __post_init__(self):
        require(self.min_track_frames >= 1, "min_track_frames", f"is {self.min_track_frames}", "1 or more")
        require(self.threads is None or self.threads >= 1, "threads", f"is {self.threads}", "1 or more, or null")
