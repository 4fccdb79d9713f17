"""What a fit, and a reconstruction as a whole, can be told; YAML files hold overrides only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from jaxfit.config.checks import check_config
from jaxfit.config.perception import TrackConfig
from jaxfit.config.yaml_file import OWN_FILE, config_to_yaml, read_config, require, shipped_files
from jaxfit.errors import InputError
from jaxfit.objective.registry import find_term

__all__ = [
    "CropConfig",
    "FitConfig",
    "InitialiseConfig",
    "OverlayConfig",
    "ReconstructConfig",
    "StageConfig",
    "config_to_yaml",
    "load_config",
    "load_reconstruct_config",
    "shipped_configs",
]


@dataclass(frozen=True)
class CropConfig:
    """How a bird is cut from its frames; every fit works on square crops."""

    mode: Literal["box", "image"] = "box"
    """`box`: a square around the bird, of one size for the window, its centre following the bird.
    `image`: the whole image, which must then be square."""
    padding: float = 0.15
    """Margin on each side of the largest box of the window, as a share of its longer side."""
    size_px: int = 256
    """Side of the crop that the fit works on."""
    focal_px: float = 2167.0
    """Focal length of the crop camera; its centre is the middle of the crop."""


@dataclass(frozen=True)
class InitialiseConfig:
    """Where the fit starts when no starting point is given."""

    method: Literal["viewing_axis", "so3"] = "viewing_axis"
    """`viewing_axis`: seen from above, turned about the viewing axis (the paper's).
    `so3`: from any direction, for cameras that do not look down."""
    turns: int = 30
    """Equal turns about the viewing axis (30 turns of 12°)."""
    directions: int = 100
    """`so3` only: viewing directions spread over the sphere."""
    candidates: int = 64
    """Best orientations of each frame that enter the choice for the window as a whole."""
    smoothness: float = 400.0
    """Cost (squared pixels) of one radian of turning between consecutive frames in that choice."""
    hypotheses: int = 1
    """Distinct starts that are fitted side by side until a stage keeps the best of them."""


@dataclass(frozen=True)
class StageConfig:
    """One stretch of the fit: what is free, what pulls, for how many steps."""

    name: str
    """Shown in progress and results."""
    steps: int
    """The solver's steps."""
    terms: tuple[str, ...]
    """Active terms, by name; their weights and settings stand in `terms` of the whole config."""
    optimised: tuple[str, ...] = ("global_orient", "body_pose", "transl", "scale")
    """Parameters that move: global_orient, body_pose, transl, scale, bone_length, betas."""
    solver: Literal["adam", "levenberg_marquardt"] = "adam"
    """`adam`: for any terms. `levenberg_marquardt`: a few steps instead of hundreds, for terms whose curvature is
    known (keypoints, pose_prior, velocity, acceleration) and fixed bone lengths and shape; 10 to 20 steps will do."""
    learning_rate: float = 0.01
    """Adam's step size, in each parameter's own unit."""
    step_scale: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """Factor on the step size of single parameters; three numbers for `transl` (x, y, z). 0 keeps a parameter fixed,
    whatever the solver."""
    blur: float = 1.0
    """Softness of the silhouette's edge relative to the usual one; below 1 is sharper."""
    keypoints_off: tuple[str, ...] = ()
    """Keypoints (by name) that this stage ignores; names that the model lacks are allowed."""
    override: Mapping[str, Any] = field(default_factory=dict)
    """Weights and settings of terms that differ in this stage: as in `terms` of the whole config."""
    carry_moments: bool = False
    """Whether Adam goes on with the moments of the stage before, instead of starting at zero."""
    keep_best: bool = False
    """Whether only the best hypothesis of each bird goes on after this stage."""


@dataclass(frozen=True)
class FitConfig:
    """Everything about a fit; the defaults are the paper's best setting."""

    stages: tuple[StageConfig, ...]
    """What is done, in this order."""
    terms: Mapping[str, Any]
    """Weight of each term, as a number, or `{weight: …, setting: …}` (sigma_px, beta_global, …)."""
    window: int = 100
    """Frames fitted at once; longer tracks are cut into windows, 1 fits every frame by itself."""
    common_size: bool = True
    """One scale for the whole window instead of one a frame."""
    filter_window: int = 5
    """Frames of the weighted median filter over detected keypoints; 1 switches it off."""
    min_keypoints: int = 4
    """Confident keypoints a frame needs to be fitted."""
    crop: CropConfig = CropConfig()
    initialise: InitialiseConfig = InitialiseConfig()
    backend: Literal["auto", "native", "reference"] = "auto"
    """Raster core: the compiled kernel, the pure-JAX reference, or whichever is there."""
    memory_gb: float = 3.0
    """Memory that one batch may take; more birds or frames are fitted in several batches."""

    def __post_init__(self):
        check_config(self)

    def stage_settings(self, stage: StageConfig) -> dict[str, dict[str, float]]:
        """Weight and settings of each of a stage's terms: defaults, `terms`, then the stage's `override`."""
        settings = {}
        for name in stage.terms:
            values = {"weight": 1.0, **find_term(name).settings}
            for source in (self.terms, stage.override):
                if name in source:
                    values |= _as_settings(source[name])
            settings[name] = values
        return settings


@dataclass(frozen=True)
class OverlayConfig:
    """How a reconstruction is drawn over its video."""

    write: bool = True
    """Whether to write the overlay and its contact sheet at all."""
    side_views: bool = True
    """A strip below the picture that shows every bird from its left."""
    detections: bool = True
    """Rings around the detected keypoints beside the fitted ones."""
    max_width_px: int | None = 1920
    """Wider footage is drawn smaller; null keeps its size."""
    codec: Literal["auto", "h264", "vp9", "mpeg4"] = "auto"
    """Of the overlay; `auto` takes H.264 where this installation has it."""

    def __post_init__(self):
        narrow = self.max_width_px is not None and self.max_width_px < 16
        require(not narrow, "max_width_px", f"is {self.max_width_px}", "16 or more, or null")


@dataclass(frozen=True)
class ReconstructConfig:
    """Everything about a reconstruction from video; `configs/reconstruct.yaml` spells it out."""

    fit: FitConfig = field(metadata=OWN_FILE)
    """How birds are posed: the name of a config of a fit, or its keys over a `base`."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """How birds are found and followed."""
    overlay: OverlayConfig = OverlayConfig()


def load_config(source: str | Path) -> FitConfig:
    """Read a fit's config by the name of a shipped one (`paper`) or the path of a YAML file.

    A file may name another as its `base`; what it then says is laid over it, key by key.

    Raises:
        InputError: as `read_config`.
    """
    return read_config(FitConfig, source, "paper")


def load_reconstruct_config(source: str | Path = "reconstruct") -> ReconstructConfig:
    """Read the config of a reconstruction, or of tracking alone: a shipped one's name or a YAML file's path.

    Raises:
        InputError: as `read_config`; the name of a fit's config.
    """
    if source in shipped_configs():
        remedy = f"write a file of `base: reconstruct` and `fit: {source}`, and give that"
        raise InputError(source, "says how to fit, but not how to track", remedy)
    return read_config(ReconstructConfig, source, "reconstruct")


def shipped_configs() -> list[str]:
    """Names of the configs of fits that come with jaxfit."""
    return [name for name in shipped_files() if name not in ("ablation", "reconstruct")]


def _as_settings(value: Any) -> dict[str, float]:
    return {k: float(v) for k, v in (value if isinstance(value, dict) else {"weight": value}).items()}
