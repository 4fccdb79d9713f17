"""Labels of a user, of any format, and their pictures."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import UInt8

from jaxfit.data.formats.coco import coco_observations
from jaxfit.data.formats.coco_records import complete_export
from jaxfit.data.formats.fields import Field, read_json
from jaxfit.data.formats.mask_files import add_masks, masks_of_picture
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.array_files import load_npy
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.video.pictures import image_files, read_picture
from jaxfit.video.reader import read_frames

_logger = logging.getLogger(__name__)

CENTRE = "centre"
"""The only keypoint of labels that have masks but no keypoints: the centre of the box."""


class LabelledBird(NamedTuple):
    """One bird of a picture; positions in pixels of the picture."""

    name: str
    """Name for messages, such as `bird 3`."""
    box_px: np.ndarray
    """(4,) x, y, width, height."""
    keypoints_px: np.ndarray
    """(K, 2) x, y; 0 where the keypoint has no label."""
    visibility: np.ndarray
    """(K,) 2 visible, 1 occluded, 0 without a label."""
    mask: Mapping[str, Any] | None
    """Run lengths, in the format of pycocotools."""


class LabelledPicture(NamedTuple):
    """One picture and all of its birds."""

    source: Path
    """The file of the labels."""
    name: str
    """Name of the picture in the labels."""
    frame: int
    """Number of the frame in its video; the position in the labels for photographs."""
    size_px: tuple[int, int]
    """Width and height, as the labels say."""
    birds: tuple[LabelledBird, ...]
    unknown: Mapping[str, Any] | None = None
    """Pixels that may be bird or background, as a mask; only in the labels of a teacher."""


class LabelSet(NamedTuple):
    """The labelled pictures of all files."""

    keypoint_names: tuple[str, ...]
    pictures: tuple[LabelledPicture, ...]
    """By file, then in the order of time."""


def read_labels(
    files: Sequence[Path],
    images: Sequence[Path],
    masks: Path | None = None,
    needs_keypoints: bool = True,
    progress: ProgressTask = silent,
) -> LabelSet:
    """Read the labels of several files.

    Args:
        files: label files of any format of `read_observations`; without `needs_keypoints` also COCO files without
            keypoints, and folders of pictures of masks, in which every grey value except 0 is one bird.
        images: the video or folder of pictures of each file; empty if the pictures lie beside the labels.
        masks: masks for labels without masks, as in `add_masks`.
        needs_keypoints: whether labels without keypoints are rejected.
        progress: reports progress.

    Raises:
        InputError: a file cannot be read, or two files name other keypoints.
    """
    names: tuple[str, ...] = ()
    pictures: list[LabelledPicture] = []
    for i, file in enumerate(files):
        if file.is_dir():
            if needs_keypoints:
                raise InputError(file, "is a folder of masks, without keypoints", "give a file of labelled keypoints")
            found, own_names = list(_mask_pictures(file, progress)), (CENTRE,)
        else:
            observations = _observations(file, images[i] if images else None, needs_keypoints)
            if masks is not None:
                observations = add_masks(observations, masks, progress, images[i] if images else None)
            found, own_names = list(_pictures(observations, file)), observations.keypoint_names
        if not needs_keypoints:
            found, own_names = [_with_centres(picture) for picture in found], (CENTRE,)
        if names and sorted(own_names) != sorted(names):
            different = sorted(set(own_names) ^ set(names))
            problem = f"names other keypoints than {files[0].name}: {', '.join(different)} only in one of the two"
            raise InputError(file, problem, "label the same keypoints in all files")
        names = names or own_names
        order = [own_names.index(name) for name in names]
        pictures += [_reordered(picture, order) for picture in found]
    commas = [name for name in names if "," in name]
    if commas:  # the network file separates the names by commas
        raise InputError(files[0], f"has a keypoint with a comma in its name: {commas[0]}", "rename the keypoint")
    return LabelSet(names, tuple(pictures))


def _observations(file: Path, images: Path | None, needs_keypoints: bool) -> Observations:
    if file.suffix.lower() != ".json":
        return read_observations(file, images)
    root = read_json(file)
    if not isinstance(root.value, dict):
        return read_observations(file)  # the pictures are compared with the labels one by one, later
    return coco_observations(complete_export(root if needs_keypoints else _with_keypoints(root), untracked="labels"))


def _with_keypoints(root: Field) -> Field:
    """Return the content of a COCO file; if no category has keypoints, every bird gets the centre of its box."""
    categories: Any = root.value.get("categories")
    annotations: Any = root.value.get("annotations")
    for table in (categories, annotations):
        if not (isinstance(table, list) and all(isinstance(entry, dict) for entry in table)):
            return root
    if any(category.get("keypoints") for category in categories):
        return root
    birds = [category for category in categories if str(category.get("name")).lower() == "bird"] or categories
    categories = [category | ({"keypoints": [CENTRE]} if category in birds else {}) for category in categories]
    marked = [annotation | {"keypoints": _centre(annotation.get("bbox"))} for annotation in annotations]
    return Field(root.source, root.path, root.value | {"categories": categories, "annotations": marked})


def _centre(box: Any) -> list[float]:
    if not (isinstance(box, list) and len(box) == 4 and all(type(side) in (int, float) for side in box)):
        return [0, 0, 0]  # the reader of annotations reports the box
    return [box[0] + box[2] / 2, box[1] + box[3] / 2, 2]


def _pictures(observations: Observations, file: Path) -> Iterator[LabelledPicture]:
    """Yield the pictures of observations, photographs in the order of their names."""
    groups: dict[tuple[int, str], list[int]] = {}
    for t in range(observations.num_frames):
        if not observations.own_images:
            groups[t, str(observations.file_name[t])] = []
        for n in np.flatnonzero(observations.present[:, t]).tolist():
            groups.setdefault((t, observations.image_file(n, t)), []).append(n)
    occluded = cast(np.ndarray, observations.occluded)
    for i, ((t, name), birds) in enumerate(sorted(groups.items())):
        frame_size = int(observations.image_size_px[t, 0]), int(observations.image_size_px[t, 1])
        size = observations.image_size(birds[0], t) if birds else frame_size
        labelled = tuple(
            LabelledBird(
                f"bird {observations.track_id[n]}",
                observations.box_px[n, t],
                observations.keypoints_px[n, t],
                np.where(observations.confidence[n, t] > 0, 2 - occluded[n, t], 0).astype(np.uint8),
                observations.masks.get((n, t)),
            )
            for n in birds
        )
        yield LabelledPicture(
            file, name, i if observations.own_images else int(observations.frame_index[t]), size, labelled
        )


def _mask_pictures(folder: Path, progress: ProgressTask) -> Iterator[LabelledPicture]:
    """Yield the pictures of a folder of masks; one grey value for several birds is one bird here."""
    files = image_files(folder)
    numbers = frame_numbers([file.name for file in files]) or range(len(files))
    with progress("Reading masks", len(files)) as report_progress:
        for file, frame in zip(files, numbers, strict=True):
            report_progress(1, "")
            picture = read_picture(file, grey=True)
            if picture is None:
                raise InputError(file, "is no readable picture", "write the picture again, or remove it")
            masks = [mask for mask in masks_of_picture(picture, file, several_birds=False) if mask.any()]
            birds = tuple(mask_bird(i, mask) for i, mask in enumerate(masks, 1))
            yield LabelledPicture(folder, file.name, frame, (picture.shape[1], picture.shape[0]), birds)


def mask_bird(number: int, mask: np.ndarray) -> LabelledBird:
    """Return the bird of a mask, with the centre of its box as keypoint."""
    box = np.array(box_of_mask(mask), np.float32)
    centre = (box[:2] + box[2:] / 2)[None]
    return LabelledBird(f"bird {number}", box, centre, np.full(1, 2, np.uint8), encode_mask(mask))


def _with_centres(picture: LabelledPicture) -> LabelledPicture:
    """Return a picture whose birds have one keypoint, the centre of the box."""
    return picture._replace(
        birds=tuple(
            bird._replace(
                keypoints_px=(bird.box_px[:2] + bird.box_px[2:] / 2)[None].astype(np.float32),
                visibility=np.full(1, 2, np.uint8),
            )
            for bird in picture.birds
        )
    )


def _reordered(picture: LabelledPicture, order: Sequence[int]) -> LabelledPicture:
    birds = (
        bird._replace(keypoints_px=bird.keypoints_px[order], visibility=bird.visibility[order])
        for bird in picture.birds
    )
    return picture._replace(birds=tuple(birds))


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
    files = _files_of(pictures, images, [] if images is None else image_files(images))
    first, file = next((pair for pair in zip(pictures, files, strict=True) if pair[1]), (pictures[0], None))
    if file is not None and file.stem != Path(first.name.replace("\\", "/")).stem and "#" not in first.name:
        text = "%s: %s has no picture of these names, so the pictures are read by their frame numbers: %s is %s"
        _logger.warning(text, first.source, images, first.name, file.name)
    if not any(files):
        place = "beside the labels" if images is None else f"in {images}, by its name or its frame number"
        problem = f"no picture of the labels is {place}, for example {pictures[0].name}"
        raise InputError(pictures[0].source, problem, "give the video, or the folder of the pictures, by --images")
    with progress("Reading labelled pictures", len(pictures)) as report_progress:
        for picture, file in zip(pictures, files, strict=True):
            yield picture, None if file is None else read_picture(file)
            report_progress(1, "")


def numbered_by_film(pictures: Sequence[StoredPicture], film: Path) -> dict[int, LabelledPicture]:
    """Return the labels of one label file by the numbers of their frames in a video or folder of frames."""
    if not film.is_dir():
        return {picture.labels.frame: picture.labels for picture in pictures}
    listed = image_files(film)
    files = _files_of([picture.labels for picture in pictures], film, listed)
    return {listed.index(file): own.labels for own, file in zip(pictures, files, strict=True) if file in listed}


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


def _files_of(pictures: Sequence[LabelledPicture], folder: Path | None, listed: Sequence[Path]) -> list[Path | None]:
    """Return the files of pictures as `_file_of`; by frame number as in a video if the folder has no such names."""
    files = [_file_of(picture, folder, listed) for picture in pictures]
    frames = [picture.frame for picture in pictures]
    if any(files) or not 0 <= min(frames, default=-1) <= max(frames, default=0) < len(listed):
        return files
    numbered = frame_numbers([picture.name for picture in pictures]) is not None
    return [listed[frame] for frame in frames] if numbered else files


def _file_of(picture: LabelledPicture, folder: Path | None, listed: Sequence[Path]) -> Path | None:
    """Return the file of a picture: by its path, by its name, by the name without suffix, or by its frame number.

    Args:
        picture: the labels.
        folder: the folder of the pictures; None searches beside the file of the labels.
        listed: the pictures of the folder, in their order.
    """
    name = picture.name.replace("\\", "/")
    if picture.source.is_dir():  # of masks, which have the names of the pictures
        beside = [picture.source / "images", *picture.source.absolute().parents[:_LEVELS]]
    else:
        source = picture.source.parent
        beside = [source, source / "images", *source.absolute().parents[: _LEVELS - 1]]
    roots = [folder] if folder is not None else beside
    for root in roots:
        for candidate in (root / name, root / Path(name).name):
            if os.path.isfile(candidate):  # noqa: PTH113  (False for names that no file can have)
                return candidate
    if "#" in name:  # `jaxfit track` names the frames of a video or of a folder `NAME#NUMBER`
        return listed[picture.frame] if 0 <= picture.frame < len(listed) else None
    return next((file for file in listed if file.stem == Path(name).stem), None)
