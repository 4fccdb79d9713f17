"""Settings of a reconstruction from video: tracking, the fit and the overlay."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge

from jaxfit.config.build import config_dataclass
from jaxfit.config.fit import FitConfig, shipped_fit_configs
from jaxfit.config.perception import TrackConfig
from jaxfit.config.yaml_file import OWN_FILE, read_config
from jaxfit.foundation.errors import InputError


@config_dataclass
class OverlayConfig:
    """The drawing of a reconstruction on its video."""

    write: bool = True
    """Whether the overlay and its contact sheet are written."""
    side_views: bool = True
    """Whether a strip below the picture shows every bird from its left side."""
    detections: bool = True
    """Whether rings mark the detected keypoints beside the fitted keypoints."""
    max_width_px: Annotated[int, Ge(16)] | None = 1920
    """Largest width of the overlay, in pixels; wider footage is scaled down, and null keeps the size."""
    codec: Literal["auto", "h264", "vp9", "mpeg4"] = "auto"
    """Codec of the overlay; `auto` uses H.264 where an H.264 encoder is installed."""


@config_dataclass
class ReconstructConfig:
    """All settings of a reconstruction from video."""

    shipped: ClassVar[str] = "reconstruct"

    fit: FitConfig = field(metadata=OWN_FILE)
    """Settings of the fit: the name of a fit's config (paper, baseline, …), or keys with a `base` of their own."""
    track: TrackConfig = field(default_factory=TrackConfig)
    overlay: OverlayConfig = OverlayConfig()


def load_reconstruct_config(source: str | Path = "reconstruct") -> ReconstructConfig:
    """Read the config of a reconstruction, or of tracking alone.

    Args:
        source: the name of a shipped config or the path of a YAML file.

    Raises:
        InputError: see `read_config`; or the name of a shipped config of a fit.
    """
    if source in shipped_fit_configs():
        remedy = f"write a file with `base: reconstruct` and `fit: {source}`, and name that file"
        raise InputError(source, "is the config of a fit and has no settings of tracking", remedy)
    return read_config(ReconstructConfig, source)
