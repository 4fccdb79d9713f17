"""The pictures of labels: frames of a video, pictures of a folder, or pictures beside the file of the labels."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.npy import load_npy
from jaxfit.training.fine_tuning.labels import LabelledPicture
from jaxfit.video.pictures import image_files, read_picture
from jaxfit.video.reader import read_frames

__all__ = ["StoredPicture", "images_of", "read_pictures"]

_LEVELS = 4
"""Number of folders above a label file that are searched: DeepLabCut stores names that begin at its project folder."""


class StoredPicture(NamedTuple):
    """A labelled picture and the file of its pixels."""

    labels: LabelledPicture
    file: Path
    """An `.npy` file."""

    def pixels(self) -> UInt8[np.ndarray, "H W 3"]:
        """Return the pixels: blue, green, red."""
        return load_npy(self.file, "H W 3")


def images_of(files: Sequence[Path], images: Sequence[Path]) -> list[Path]:
    """Return the video or folder of each label file; empty without `images`.

    Raises:
        InputError: another number than one for all, or one for each file.
    """
    if images and len(images) not in (1, len(files)):
        problem = f"names {len(images)} videos or folders for {len(files)} files of labels"
        raise InputError("--images", problem, "give one for all files, or one for each file in the same order")
    return [images[0]] * len(files) if len(images) == 1 else list(images)


def read_pictures(
    pictures: Sequence[LabelledPicture], images: Path | None, progress: ProgressTask = silent
) -> Iterator[tuple[LabelledPicture, np.ndarray | None]]:
    """Yield the labelled pictures of one label file with their pixels; None where the picture cannot be read.

    Args:
        pictures: pictures of one label file.
        images: the video or folder of the pictures; None searches beside the file.
        progress: reports the pictures.

    Raises:
        InputError: the video or folder cannot be read, or no picture is found.
    """
    if images is not None and not images.is_dir():
        yield from _video_pictures(pictures, images, progress)
        return
    listed = [] if images is None else image_files(images)
    files = [_file_of(picture, images, listed) for picture in pictures]
    if not any(files):
        place = "beside the labels" if images is None else f"in {images}"
        problem = f"no picture of the labels is {place}, for example {pictures[0].name}"
        raise InputError(pictures[0].source, problem, "give the video, or the folder of the pictures, by --images")
    with progress("Reading labelled pictures", len(pictures)) as report_progress:
        for picture, file in zip(pictures, files, strict=True):
            yield picture, None if file is None else read_picture(file)
            report_progress(1, "")


def _video_pictures(
    pictures: Sequence[LabelledPicture], video: Path, progress: ProgressTask
) -> Iterator[tuple[LabelledPicture, np.ndarray | None]]:
    """Yield frames of a video, in the order of time; frames that the video lacks come last."""
    missing = {picture.frame: picture for picture in pictures}
    first, last = min(missing), max(missing)
    with progress("Reading the video", last + 1 - first) as report_progress:
        for frame in read_frames(video, first, last + 1):
            report_progress(1, "")
            if frame.index in missing:
                yield missing.pop(frame.index), frame.picture
    for picture in missing.values():
        yield picture, None


def _file_of(picture: LabelledPicture, folder: Path | None, listed: Sequence[Path]) -> Path | None:
    """Return the file of a picture: by its path, by its name, by the name without suffix, or by its frame number.

    Args:
        picture: the labels.
        folder: the folder of the pictures; None searches beside the file of the labels.
        listed: the pictures of the folder, in their order.
    """
    name = picture.name.replace("\\", "/")
    source = picture.source if picture.source.is_dir() else picture.source.parent
    roots = [folder] if folder is not None else [source, source / "images", *source.absolute().parents[: _LEVELS - 1]]
    for root in roots:
        for candidate in (root / name, root / Path(name).name):
            if os.path.isfile(candidate):  # noqa: PTH113  (False for names that no file can have)
                return candidate
    if "#" in name:  # `jaxfit track` names the frames of a video or of a folder `NAME#NUMBER`
        return listed[picture.frame] if 0 <= picture.frame < len(listed) else None
    return next((file for file in listed if file.stem == Path(name).stem), None)
