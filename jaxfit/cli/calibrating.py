"""The command that estimates the errors of detections and writes a config of a fit."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

from jaxfit.cli.observation_files import image_size, keypoint_map
from jaxfit.cli.tables import EscapedTable, counted, right_aligned, show, show_facts
from jaxfit.config.yaml_values import rounded
from jaxfit.progress import terminal

__all__ = ["calibrate"]


def calibrate(options: argparse.Namespace) -> None:
    """Estimate the errors of detections from labelled frames, and write a config that holds them."""
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.keypoint_names import map_keypoints
    from jaxfit.evaluation.detection_noise import estimate_noise
    from jaxfit.evaluation.noise_config import facts, noise_yaml
    from jaxfit.evaluation.truth import read_truth
    from jaxfit.storage.files import check_new_file, check_writable, write_whole

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    truth = read_truth(options.truth, options.video, image_size(options))
    detected = read_observations(options.detections, options.video, image_size(options))
    true_names, names = truth.observations.keypoint_names, detected.keypoint_names
    if true_names != names:
        mapped = keypoint_map(true_names, options.truth, names, options.names)
        truth = replace(truth, observations=map_keypoints(truth.observations, mapped, names))
    noise = estimate_noise(detected, truth, options.detections, terminal)
    check_new_file(options.out, options.overwrite)  # again, because the estimate may have taken minutes
    write_whole(options.out, noise_yaml(noise, options.detections, options.truth).encode())
    table = right_aligned("setting", "value", "from", "to")
    table.columns[0].justify = "left"
    for path, value in noise.settings.items():
        ends = ("–" if math.isnan(end) else rounded(end) for end in noise.intervals[path])
        table.add_row(path, rounded(value), *ends)
    table.caption = (
        "in pixels of a 256-pixel crop; from, to: 95 % bootstrap interval over birds (none for a single bird)"
    )
    show(table)
    show_facts(facts(noise))
    scales = EscapedTable()
    scales.add_column("keypoint")
    scales.add_column("scale", justify="right")
    for name, factor in noise.factors.items():
        scales.add_row(name, f"{factor:.2f}")
    scales.caption = "scale: relative to the scale of all keypoints"
    show(scales)
    if noise.outline is None:
        show("the labels hold no masks of the matched birds: the config leaves out mask and grow_masks_px")
    counts = (counted(noise.frames, "frame"), counted(noise.birds, "bird"), counted(noise.keypoints, "keypoint"))
    show(f"{', '.join(counts)}, {counted(noise.masks, 'mask')} → {options.out}")
    show(f"next: jaxfit fit {options.detections} --config {options.out} --out result")
