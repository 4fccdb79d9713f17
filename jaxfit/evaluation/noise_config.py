"""The config of a fit that holds estimated statistics of detection errors, as YAML text with comments."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator

from jaxfit.config.yaml_values import rounded
from jaxfit.errors import one_line
from jaxfit.evaluation.bootstrap import Interval
from jaxfit.evaluation.detection_noise import BASE, DetectionNoise
from jaxfit.evaluation.keypoint_noise import OUTLIER_SCALES

__all__ = ["facts", "noise_yaml"]

_MEANINGS = {
    "grow_masks_px": "enlargement of the masks, so that the fitted size is right on average",
    "terms.keypoint_likelihood.sd_sure_px": "scale of keypoint errors at confidence 1",
    "terms.keypoint_likelihood.sd_unsure_px": "scale of keypoint errors at confidence 0",
    "terms.keypoint_likelihood.dof": "degrees of freedom: small numbers mean heavy tails",
    "terms.mask": "nats per pixel: 1 / (mean absolute deviation of the outline × its correlation length)",
}


def noise_yaml(noise: DetectionNoise, detections: object, labels: object) -> str:
    """Return a config with the base `map` and the estimated settings; its comments say what was measured.

    Args:
        noise: the estimate.
        detections: the file of the detections, for the comments.
        labels: the file of the labels, for the comments.
    """
    own = noise.settings
    term = ", ".join(f"{name}: {rounded(own[f'terms.keypoint_likelihood.{name}'])}" for name in noise.keypoint._fields)
    lines = [*_comments(noise, detections, labels), f"base: {BASE}"]
    if "grow_masks_px" in own:
        lines.append(f"grow_masks_px: {rounded(own['grow_masks_px'])}")
    lines += ["terms:", f"  keypoint_likelihood: {{weight: 1, {term}}}"]
    if "terms.mask" in own:
        lines.append(f"  mask: {rounded(own['terms.mask'])}")
    return "\n".join(lines) + "\n"


def facts(noise: DetectionNoise) -> dict[str, str]:
    """Return name → value of everything that was measured beside the settings."""
    swapped, sides = noise.exchanged
    found = {}
    if noise.outline is not None:
        found["mean offset of the outline"] = f"{noise.outline.offset_px:+.2f} px (negative: masks are small)"
        found["mean absolute deviation of the outline"] = f"{noise.outline.deviation_px:.2f} px"
        found["correlation length of the outline"] = f"{noise.outline.length_px:.1f} px"
        found["whole masks too large or small"] = f"± {noise.outline.whole_px:.2f} px (standard deviation)"
    for lag, value in noise.correlations.items():
        frames = "1 frame" if lag == 1 else f"{lag} frames"
        name = f"correlation of keypoint errors after {frames}"
        found[name] = "not measured: no labels at this distance" if value is None else f"{value:.2f}"
    found[f"outliers, more than {OUTLIER_SCALES:g} scales"] = f"{noise.outlier_share:.1%}"
    share = f" ({swapped / sides:.1%})" if sides else ""
    found["exchanged left and right keypoints"] = f"{swapped} of {sides} pairs{share}"
    if noise.unmoved_share > 0.01:
        text = f"{noise.unmoved_share:.0%}: correct pre-filled labels, or the scales are too small"
        found["labels exactly on the detection"] = text
    return found


def _comments(noise: DetectionNoise, detections: object, labels: object) -> Iterator[str]:
    """Yield the lines of the comments at the top of the config."""
    masks = f" and {noise.masks} masks" if noise.masks else "; no masks were labelled, so the mask settings are absent"
    text = (
        f"Errors of the detections {one_line(detections)}, estimated by `jaxfit calibrate` from the labels "
        f"{one_line(labels)}: {noise.frames} frames, {noise.birds} birds, {noise.keypoints} keypoints{masks}. "
        "All pixels are pixels of a 256-pixel crop. In parentheses: 95 % bootstrap interval over birds."
    )
    yield from _wrapped(text)
    yield "#"
    for path, value in noise.settings.items():
        yield from _wrapped(f"{path} = {rounded(value)}{_interval(noise.intervals[path])}: {_MEANINGS[path]}", "  ")
    yield "#"
    yield "# Measured, but not part of the config:"
    for name, value in facts(noise).items():
        yield from _wrapped(f"{name}: {value}", "  ")
    factors = ", ".join(f"{one_line(name)} {value:.2f}" for name, value in noise.factors.items())
    yield from _wrapped(f"scale of each keypoint, relative to the scale of all: {factors}", "  ")


def _interval(interval: Interval) -> str:
    return "" if math.isnan(interval.low) else f" ({rounded(interval.low)} to {rounded(interval.high)})"


def _wrapped(text: str, indent: str = "") -> list[str]:
    start = f"# {indent}"
    return textwrap.wrap(
        text, 118, initial_indent=start, subsequent_indent=start, break_long_words=False, break_on_hyphens=False
    )
