"""What the video or the pictures of a file say: sizes of images, times, frame rate."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from PIL import ExifTags, Image

from jaxfit.data.footage import read_footage
from jaxfit.data.masks import MAX_IMAGE_SIDE_PX
from jaxfit.data.observations import MIN_KEYPOINTS, Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import reading
from jaxfit.video.decoding import frame_times
from jaxfit.video.reader import VideoInfo, probe_video

_log = logging.getLogger(__name__)

CERTAIN = 0.6
"""Confidence of a keypoint that is certain; DeepLabCut draws keypoints from 0.6 on."""
_OUTSIDE = 0.2
"""Largest accepted fraction of certain keypoints outside their image."""
_VIDEO_SUFFIXES = (
    ".mp4",
    ".avi",
    ".mov",
    ".mkv",
    ".webm",
    ".m4v",
    ".mpg",
    ".mpeg",
    ".mts",
    ".m2ts",
    ".ts",
    ".h264",
    ".wmv",
)


@dataclass(frozen=True, eq=False)
class ImageSizes:
    """Sizes of the images, and the video that they come from."""

    size_px: np.ndarray
    """(2,) width and height of all images, or (T, 2) of each image."""
    video: Path | None = None
    frames: int | None = None
    """Number of frames of the video; None without a video."""

    def check_frames(self, last: int, source: Path) -> None:
        """Raise InputError if the video lacks the last frame."""
        if self.frames is not None and last >= self.frames:
            problem = f"has keypoints for frame {last}, but {self.video} has {self.frames} frames, counted from 0"
            raise InputError(source, problem, "give the video of these keypoints by --video")


def image_sizes(
    stored: tuple[int, int] | None,
    pictures: Sequence[str] | None,
    stored_video: str | None,
    source: Path,
    video: Path | None,
    given: tuple[int, int] | None = None,
) -> ImageSizes:
    """Return the sizes of the images of a file of keypoints.

    Args:
        stored: width and height that the file stores.
        pictures: file names of the labelled pictures.
        stored_video: path of the video that the file stores.
        source: the file.
        video: the video or folder of pictures that the user gives.
        given: width and height that the user gives, for files that store none.

    Raises:
        InputError: no source of the size, or two sources that contradict each other.
    """
    if stored is not None and not all(1 <= side <= MAX_IMAGE_SIDE_PX for side in stored):
        raise InputError(source, f"stores images of {stored[0]}×{stored[1]} pixels", "write the file again")
    if video is not None:
        info = probe_video(video)
        if stored is not None and info.size_px != stored:
            problem = f"is {info.size_px[0]}×{info.size_px[1]}, but {source.name} was made from {stored[0]}×{stored[1]}"
            raise InputError(video, problem, "give the video of these keypoints")
        return ImageSizes(np.array(info.size_px), video, _counted(video, info))
    if pictures is not None:
        sizes = _picture_sizes(pictures, source)
        if sizes is not None:
            if stored is not None and (sizes != stored).any():
                other = sizes[(sizes != stored).any(1)][0]
                problem = f"says {stored[0]}×{stored[1]}, but a picture has {other[0]}×{other[1]} pixels"
                raise InputError(source, problem, "give the pictures in the size that was labelled")
            return ImageSizes(sizes)
    known = stored if stored is not None else given
    if known is not None:
        return ImageSizes(np.array(known), None if pictures else _video_of_size(known, source, stored_video))
    found = _video_beside(source, stored_video) if pictures is None else None
    if found is not None:
        info = probe_video(found)
        return ImageSizes(np.array(info.size_px), found, _counted(found, info))
    if stored_video:
        problem = f"stores no image size, and its video {Path(stored_video).name} is not in the same folder"
    else:
        problem = "stores no image size" + (", and its pictures are not in the same folder" if pictures else "")
    raise InputError(source, problem, "give --video VIDEO, or --size WIDTHxHEIGHT")


def _counted(video: Path, info: VideoInfo) -> int:
    """Return the number of frames; the packets are counted if the container does not store the number."""
    return len(frame_times(video, sys.maxsize)) if info.frames is None else info.frames


def check_positions(observations: Observations, source: Path) -> None:
    """Raise InputError if the certain keypoints cannot be pixels of their images.

    Raises:
        InputError: many keypoints lie outside their image, as in images of another size, or all keypoints lie within
            the first pixel, as fractions of the image do.
    """
    points, size = observations.keypoints_px, observations.image_sizes_px()[:, :, None]
    certain = observations.confidence >= CERTAIN
    outside = certain & ((points < -1) | (points > size + 1)).any(-1)
    if outside.sum() > _OUTSIDE * certain.sum():
        n, t, k = np.argwhere(outside)[0].tolist()
        problem = f"has {outside.sum():,} of {certain.sum():,} keypoints outside images of {size[n, t, 0, 0]}×"
        problem += f"{size[n, t, 0, 1]}, such as x {points[n, t, k, 0]:.0f}, y {points[n, t, k, 1]:.0f}"
        raise InputError(source, problem, "give the video or pictures in the size that was labelled, by --video")
    if certain.sum() >= MIN_KEYPOINTS and np.abs(points[certain]).max() <= 1 < size.max():
        problem = "has no keypoint beyond 1 pixel: the positions are fractions of the image, not pixels"
        raise InputError(source, problem, "multiply x by the width and y by the height of the image")


def check_video(observations: Observations, source: Path, video: Path) -> None:
    """Raise InputError if observations of a video are not those of this video: other image sizes, or more frames."""
    info = probe_video(video)
    sizes = {observations.image_size(n, t) for n, t in np.argwhere(observations.present).tolist()}
    other = sorted(sizes - {info.size_px})
    if other:
        problem = f"is {info.size_px[0]}×{info.size_px[1]}, but {source.name} says {other[0][0]}×{other[0][1]}"
        raise InputError(video, problem, "give the video or pictures in the size that was labelled")
    if observations.num_frames and not observations.own_images:
        sizes_of = ImageSizes(np.array(info.size_px), video, _counted(video, info))
        sizes_of.check_frames(int(observations.frame_index[-1]), source)


def _picture_sizes(pictures: Sequence[str], source: Path) -> np.ndarray | None:
    """Return the (T, 2) sizes of the pictures; None if no picture is beside the file.

    The project folder of DeepLabCut holds `labeled-data/VIDEO/`, which holds the pictures and the file of labels.
    Pictures may also lie in the folder `images` beside the file. A missing picture has the size of the others.
    """
    folders = [source.parent, *source.absolute().parents[1:4]]
    sizes = np.zeros((len(pictures), 2), np.int64)
    for t, picture in enumerate(pictures):
        name = picture.replace("\\", "/")
        places = [folder / name for folder in folders]
        places += [source.parent / Path(name).name, source.parent / "images" / Path(name).name]
        file = next(filter(_is_file, places), None)
        if file is not None:
            with reading(file, "a picture"), Image.open(file) as image:
                # pictures that cameras store on their side are turned, as when their pixels are read
                turned = image.getexif().get(ExifTags.Base.Orientation, 1) >= 5
                sizes[t] = image.size[::-1] if turned else image.size
    known = sizes[sizes[:, 0] > 0]
    if not len(known):
        return None
    missing = sizes[:, 0] == 0
    if missing.any() and len(np.unique(known, axis=0)) > 1:
        problem = f"lacks the picture {pictures[int(np.flatnonzero(missing)[0])]}, and its pictures have several sizes"
        raise InputError(source, problem, "put all pictures beside the file")
    sizes[missing] = known[0]
    return sizes


def _video_beside(source: Path, stored: str | None) -> Path | None:
    """Return the video that a file names, or the video beside the file whose name begins as the file's name.

    DeepLabCut writes `clipDLC_resnet50_….h5` beside `clip.mp4`, SLEAP writes `clip.predictions.slp`.
    """
    if stored:
        stored = stored.replace("\\", "/")
        places = (source.parent / Path(stored).name, source.parent / stored)
        return next((place for place in places if place.suffix.lower() in _VIDEO_SUFFIXES and _is_file(place)), None)
    videos = [
        file
        for file in source.absolute().parent.iterdir()
        if file.suffix.lower() in _VIDEO_SUFFIXES
        and source.name.startswith(file.stem)
        and not source.name[len(file.stem) :][:1].isdecimal()  # clip10.csv is not of clip1.mp4
        and _is_file(file)
    ]
    found = max(videos, key=lambda file: len(file.stem), default=None)
    if found is not None and not re.match(r"DLC|[.]|$", source.name[len(found.stem) :]):
        # DeepLabCut names tables of shortened or cropped films by words after the name of the film
        _log.warning("%s: takes %s, whose name begins its name (give another film by --video)", source, found.name)
    return found


def _video_of_size(size_px: tuple[int, int], source: Path, stored: str | None) -> Path | None:
    """Return the video beside a file if it has the size of the images; the file does not need the video."""
    found = _video_beside(source, stored)
    try:
        return found if found is not None and probe_video(found).size_px == size_px else None
    except (InputError, OSError):
        return None


def _is_file(path: Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113  (False for names that no file can have, where Path.is_file fails)


def add_times(observations: Observations, video: Path | None) -> Observations:
    """Return observations with the time stamps, the frame rate and the identity of their video, if they have no times.

    The packets of the video are read up to the last frame, and only the first picture is decoded. A folder of pictures
    has no times.

    Args:
        observations: the observations, with frame numbers of the video.
        video: the video. None or a folder of pictures returns the observations unchanged.

    Raises:
        InputError: the file is not a readable video.
    """
    known = observations.fps is not None or np.isfinite(cast(np.ndarray, observations.timestamp_s)).any()
    if known or observations.own_images or not observations.num_frames or video is None or video.is_dir():
        return observations
    numbers = observations.frame_index
    times = frame_times(video, int(numbers[-1]) + 1)
    inside = numbers < len(times)
    timestamp_s = np.full(len(numbers), np.nan)
    timestamp_s[inside] = times[numbers[inside]]
    info = probe_video(video)
    footage = read_footage(video, info.frames)
    return replace(observations, timestamp_s=timestamp_s, fps=info.fps, footage=footage)
