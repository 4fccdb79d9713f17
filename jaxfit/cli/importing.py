"""The command that converts files of other tracking programs to COCO."""

from __future__ import annotations

import argparse

from jaxfit.cli.observation_files import observations_for
from jaxfit.cli.tables import counted, show, track_table
from jaxfit.progress import terminal

__all__ = ["import_observations"]


def import_observations(options: argparse.Namespace) -> None:
    """Convert a file of DeepLabCut, SLEAP, Lightning Pose or an annotation program to a COCO file."""
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.data.formats.mask_files import add_masks
    from jaxfit.model.files import find_bird
    from jaxfit.storage.files import check_new_file, check_writable

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    bird = find_bird(options.model)
    observations, names = observations_for(options.file, bird.keypoint_names, options)
    if options.masks is not None:
        observations = add_masks(observations, options.masks, terminal)
    write_coco(observations, options.out, {"description": f"imported from {options.file.name}"})
    show(track_table(observations))
    total = int(observations.present.sum())
    mapped = f"{len(names.mapped)} of {counted(bird.num_keypoints, 'keypoint')} of the model"
    masks = f"{len(observations.masks):,} of {total:,} with a mask" if observations.masks else "no masks"
    tracks, frames = counted(observations.num_tracks, "track"), counted(observations.num_frames, "frame")
    if observations.photographs:  # every bird has a photograph of its own
        tracks = counted(observations.num_tracks, "bird")
        frames = counted(observations.photographs, "photograph")
    show(f"{tracks}, {frames}, {mapped}, {masks} → {options.out}")
    if not observations.masks:
        show("without masks, `jaxfit fit` compares keypoints only; --masks adds masks")
