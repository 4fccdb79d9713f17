"""Data of a fine-tuning: labels are read and checked, pictures are stored, and a part is held out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.errors import InputError
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import new_folder
from jaxfit.training.fine_tuning.filming import Filming
from jaxfit.training.fine_tuning.holdout import Split, split_pictures
from jaxfit.training.fine_tuning.label_checks import LeftOut, check_picture, check_sides
from jaxfit.training.fine_tuning.label_pictures import StoredPicture, images_of, read_pictures
from jaxfit.training.fine_tuning.labels import LabelSet, read_labels
from jaxfit.training.fine_tuning.prepare import Scale, choose_scale, prepare_frames
from jaxfit.training.labelled_frames import LabelledFrames

__all__ = [
    "ALL_FRAMES",
    "FRAMES",
    "PICTURES",
    "FineTuningData",
    "LabelFiles",
    "fingerprint",
    "prepare_data",
]

PICTURES, FRAMES, ALL_FRAMES = "pictures", "frames", "all_frames"
"""Folders of the stored pictures, of the training part and of all labelled frames, in the folder of a training."""
_PICTURES_MARKER = "pictures.txt"


class LabelFiles(NamedTuple):
    """The files of the labels."""

    labels: tuple[Path, ...]
    """Files of any format of `read_observations`; for a segmenter also folders of pictures of masks."""
    images: tuple[Path, ...] = ()
    """Videos or folders of pictures: one for all files, or one for each file; empty if they lie beside the files."""
    masks: Path | None = None
    """Folder of pictures of masks, or COCO file, for labels without masks."""


class FineTuningData(NamedTuple):
    """The data of a fine-tuning."""

    keypoint_names: tuple[str, ...]
    frames: LabelledFrames
    """The training part."""
    pictures: list[StoredPicture]
    """All labelled pictures that can be used, also those of the held-out part."""
    holdout: list[StoredPicture]
    left_out: list[LeftOut]
    """Labels that are not used."""
    split: Split
    scale: Scale


def prepare_data(
    network: str,
    files: LabelFiles,
    share: float,
    references: LabelledFrames | None,
    folder: Path,
    labels: LabelSet | None = None,
    progress: ProgressTask = silent,
) -> FineTuningData:
    """Read and check labels, store their pictures in a folder, and hold out a part.

    Args:
        network: `segmenter` or `keypoints`.
        files: files of the labels.
        share: share of the pictures to hold out; 0 holds out nothing.
        references: simulated birds for the check of left and right, if any.
        folder: folder of the training.
        labels: the labels, if they are read already.
        progress: reports progress.

    Raises:
        InputError: labels or pictures cannot be read, or too few labels can be used.
    """
    labels = labels or read_label_files(network, files, progress)
    left_out: list[LeftOut] = []
    stored: list[StoredPicture] = []
    sources = dict(zip(files.labels, images_of(files.labels, files.images) or [None] * len(files.labels), strict=True))
    with new_folder(folder / PICTURES, overwrite=True, marker=_PICTURES_MARKER) as part:
        (part / _PICTURES_MARKER).write_text("pictures of a training in progress\n")
        for source, group in groupby(labels.pictures, key=lambda picture: picture.source):
            for picture, pixels in read_pictures(list(group), sources[source], progress):
                usable, problems = check_picture(picture, pixels, network)
                left_out += problems
                if usable is not None and pixels is not None:
                    name = f"{len(stored):06d}.npy"
                    np.save(part / name, pixels)
                    stored.append(StoredPicture(usable, folder / PICTURES / name))
    if network == "keypoints":
        checked, mixed_up = check_sides([picture.labels for picture in stored], labels.keypoint_names, references)
        left_out += mixed_up
        pairs = zip(stored, checked, strict=True)
        stored = [StoredPicture(own, picture.file) for picture, own in pairs if own.birds]
    stored.sort(key=lambda picture: (files.labels.index(picture.labels.source), picture.labels.frame))
    _check_count(stored, left_out, files, network)
    split = split_pictures([picture.labels for picture in stored], share)
    training, holdout = ([stored[i] for i in part] for part in (split.training, split.holdout))
    scale = choose_scale(picture.labels for picture in training)
    frames = prepare_frames(folder / FRAMES, training, labels.keypoint_names, scale, network)
    return FineTuningData(labels.keypoint_names, frames, stored, holdout, left_out, split, scale)


def read_label_files(network: str, files: LabelFiles, progress: ProgressTask = silent) -> LabelSet:
    """Read the labels for a network; errors as `prepare_data`."""
    images = images_of(files.labels, files.images)
    labels = read_labels(files.labels, images, files.masks, network == "keypoints", progress)
    if not any(picture.birds for picture in labels.pictures):
        raise InputError(files.labels[0], "holds no labelled bird", "label birds, or choose another file")
    return labels


def _check_count(stored: list[StoredPicture], left_out: list[LeftOut], files: LabelFiles, network: str) -> None:
    if any(picture.labels.birds for picture in stored):
        return
    problem = f"holds no usable label: {left_out[0] if left_out else 'no bird'}"
    remedy = "correct the labels" if network == "keypoints" else "correct the labels; a segmenter needs masks (--masks)"
    raise InputError(files.labels[0], problem, remedy)


def fingerprint(data: FineTuningData, simulated: Filming | None, base: Path, settings: Sequence[object]) -> str:
    """Return a hash of everything that determines a training, so that only the same training is resumed."""
    content = hashlib.blake2b(digest_size=16)
    content.update(repr((tuple(settings), data.keypoint_names, data.scale, data.split)).encode())
    content.update(base.read_bytes())
    content.update(b"" if simulated is None else simulated.identity)
    for array in (data.frames.keypoints_px, data.frames.visibility, data.frames.pixels_per_unit):
        content.update(np.ascontiguousarray(array).tobytes())
    for pictures, owner in zip(data.frames.pictures, data.frames.owner, strict=True):
        content.update(np.ascontiguousarray(pictures).tobytes())
        content.update(np.ascontiguousarray(owner).tobytes())
    return content.hexdigest()
