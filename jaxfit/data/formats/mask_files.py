"""Masks from a folder of pictures or from a COCO file, for observations that have keypoints only, or alone.

A mask belongs to the bird whose keypoints it covers best. A picture of masks has the size of its image. Every grey
value except 0 is one mask; a picture with one value holds one mask for every connected region if its frame has several
birds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxfit.data.formats.coco_records import complete_export, errors_of, read_images
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.rle import first_invalid, read_segmentation
from jaxfit.data.masks import box_of_mask, decode_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.video.pictures import IMAGE_SUFFIXES, image_files, read_picture

_COVERED = 0.3
"""Least fraction of a bird's keypoints that its mask covers, weighted by confidence; another bird may hide the rest."""
_NEAR = 0.05
"""A keypoint outside a mask counts in part up to this distance, as a share of the longer side of the mask: the tips of
bill, tail and wings lie on the outline, and many masks are a little too small."""
_MAX_VALUES = 64
"""A picture with more grey values is no picture of labels: masks are where the grey value is 128 or more."""
_MAX_REGIONS = 100
"""A picture with more connected regions is no picture of one mask for every bird."""
_NUMBER = re.compile(r"\d{1,15}", re.ASCII)

_Masks = Callable[[int, int], Sequence[np.ndarray]]


def add_masks(
    observations: Observations, source: Path, progress: ProgressTask = silent, video: Path | None = None
) -> Observations:
    """Return the observations with masks from a folder of pictures or from a COCO file.

    The pictures belong to the images of the same name, or else to the frames of the numbers in their names, or else to
    the frames in their order. The birds of a COCO file belong to the frames of the same number, or to photographs of
    the same name. A keypoint near the outline of a mask is covered in part. Birds without a mask that covers three
    tenths of their keypoints keep the mask that they had.

    Args:
        observations: birds with keypoints.
        source: the folder or the COCO file.
        progress: shows progress, and how many birds have a mask.
        video: the video or folder of the images. In a folder, frames are numbered by the positions of the pictures, and
            masks with the names of the pictures belong to them, whatever the numbers in the names.

    Raises:
        InputError: the source cannot be read, holds no mask for any image or a mask of another size, or its pictures
            belong to no frames by name, number or order.
    """
    names = _image_names(observations, video)
    masks_of = (_folder_masks if source.is_dir() else _coco_masks)(observations, source, names)
    masks = dict(observations.masks)
    given = labelled = 0
    images = list(_images(observations))
    with progress("Reading masks", len(images)) as report_progress:
        for n, t, birds in images:
            candidates = masks_of(n, t)
            given += len(candidates)
            width, height = observations.image_size(n, t)
            for mask in candidates:
                if mask.shape != (height, width):
                    problem = f"has masks of {mask.shape[1]}×{mask.shape[0]}, but the image is {width}×{height}"
                    raise InputError(source, problem, "give masks in the size of the images")
            for bird, j in assign_masks(observations, birds, t, candidates):
                masks[bird, t] = encode_mask(candidates[j])
            labelled += len(birds)
            report_progress(1, f"{len(masks)} of {labelled} labelled birds have a mask")
    if not given:
        remedy = "name the pictures by frame numbers or as the images, or give a COCO file with segmentation"
        raise InputError(source, "holds no mask for any image of the birds", remedy)
    return replace(observations, masks=masks)


def mask_observations(folder: Path, progress: ProgressTask = silent) -> Observations:
    """Return the birds of a folder of pictures of masks, without keypoints.

    Every grey value except 0 is one bird, and one track in all pictures. The frame numbers are the numbers at the ends
    of the names, or else the positions of the pictures.

    Raises:
        InputError: a picture cannot be read, or no picture holds a mask.
    """
    files = image_files(folder)
    numbers = np.array(frame_numbers([file.name for file in files]) or range(len(files)), np.int64)
    order = np.argsort(numbers)
    sizes = np.zeros((len(files), 2), np.int64)
    found: dict[tuple[int, int], np.ndarray] = {}
    masks: dict[tuple[int, int], Any] = {}
    with progress("Reading masks", len(files)) as report_progress:
        for t, i in enumerate(order.tolist()):
            report_progress(1, "")
            picture = _read_mask_picture(files[i])
            sizes[t] = picture.shape[::-1]
            for mask in masks_of_picture(picture, files[i], several_birds=False):
                box = box_of_mask(mask)
                if box is not None:
                    value = int(picture[mask].max())
                    found[value, t], masks[value, t] = np.array(box, np.float32), encode_mask(mask)
    if not found:
        raise InputError(folder, "holds no mask", "give pictures in which every bird has a grey value above 0")
    track_id = np.unique([value for value, _ in found])
    row = {value: n for n, value in enumerate(track_id.tolist())}
    present = np.zeros((len(track_id), len(files)), bool)
    box_px = np.zeros((*present.shape, 4), np.float32)
    for (value, t), box in found.items():
        present[row[value], t], box_px[row[value], t] = True, box
    return Observations(
        track_id=track_id,
        frame_index=numbers[order],
        present=present,
        keypoints_px=np.zeros((*present.shape, 0, 2), np.float32),
        confidence=np.zeros((*present.shape, 0), np.float32),
        box_px=box_px,
        image_size_px=sizes,
        file_name=np.array([files[i].name for i in order]),
        keypoint_names=(),
        masks={(row[value], t): rle for (value, t), rle in masks.items()},
    )


def _images(observations: Observations) -> Iterator[tuple[int, int, list[int]]]:
    """Yield one bird, the frame and all birds of every image."""
    for t in range(observations.num_frames):
        groups: dict[str, list[int]] = {}
        for n in np.flatnonzero(observations.present[:, t]).tolist():
            groups.setdefault(observations.image_file(n, t), []).append(n)
        for birds in groups.values():
            yield birds[0], t, birds


def assign_masks(
    observations: Observations, birds: list[int], t: int, masks: Sequence[np.ndarray]
) -> Iterator[tuple[int, int]]:
    """Yield pairs of a bird and the position of its mask; the masks cover as many keypoints as possible."""
    covered = np.zeros((len(birds), len(masks)))
    for j, mask in enumerate(masks):
        _, _, *sides = box_of_mask(mask) or (0, 0, 0)
        near_px = max(_NEAR * max(sides), 1)
        share = 1 - cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 5) / near_px
        for i, n in enumerate(birds):
            confidence = observations.confidence[n, t]
            x, y = np.floor(observations.keypoints_px[n, t][confidence > 0]).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
            hit = np.maximum(share[y[inside], x[inside]], 0) * confidence[confidence > 0][inside]
            covered[i, j] = hit.sum() / max(confidence.sum(), 1e-6)
    for i, j in zip(*linear_sum_assignment(-covered), strict=True):
        if covered[i, j] >= _COVERED:
            yield birds[i], int(j)


def _image_names(observations: Observations, video: Path | None) -> dict[tuple[int, int], str]:
    """Return bird and frame → name of the image, for one bird of every image."""
    listed = image_files(video) if video is not None and video.is_dir() and not observations.own_images else []
    known, names = {_stem(file.name) for file in listed}, {}
    for n, t, _ in _images(observations):
        name, number = Path(observations.image_file(n, t).replace("\\", "/")).name, int(observations.frame_index[t])
        names[n, t] = name if _stem(name) in known or not 0 <= number < len(listed) else listed[number].name
    return names


def _stem(name: str) -> str:
    """Return the name of a picture without its suffix; `film.mp4#12`, which names a frame of a video, stays."""
    return Path(name).stem if Path(name).suffix.lower() in IMAGE_SUFFIXES else name


def _coco_masks(observations: Observations, source: Path, names: dict[tuple[int, int], str]) -> _Masks:
    """Return a function of bird and frame that returns the masks of the image in a COCO file."""
    root = complete_export(read_json(source))
    images = read_images(root)
    pictures = {Path(image.file_name).name for image in images.values()}
    key_of = str if pictures & set(names.values()) else _stem  # pictures of masks may be of another type
    keys = {at: key_of(name) for at, name in names.items()}
    shared = {key_of(name) for name in pictures} & set(keys.values())
    by_name = bool(observations.own_images) or (bool(shared) and len(set(keys.values())) == len(keys))
    masks: dict[Any, list[dict[str, Any]]] = {}
    for i, annotation in enumerate(root["annotations"].value):
        with errors_of(root, f"annotations[{i}]"):
            image = images.get(annotation["image_id"])
            if image is None or annotation.get("iscrowd") == 1:
                continue
            rle = read_segmentation(annotation.get("segmentation"), image.height, image.width)
            if rle is None:
                continue
            if first_invalid([rle]) is not None:
                raise ValueError("segmentation.counts is corrupt: its runs do not cover the image")
            masks.setdefault(key_of(Path(image.file_name).name) if by_name else image.frame_index, []).append(rle)

    def masks_of(n: int, t: int) -> list[np.ndarray]:
        key = keys[n, t] if by_name else int(observations.frame_index[t])
        return [decode_mask(rle) for rle in masks.get(key, ())]

    return masks_of


def _folder_masks(observations: Observations, source: Path, names: dict[tuple[int, int], str]) -> _Masks:
    """Return a function of bird and frame that returns the masks of a picture of a folder."""
    files = image_files(source)
    by_stem = {file.stem: file for file in files}
    last = [int(found[-1]) for found in (_NUMBER.findall(file.stem) for file in files) if found]
    unique = len(last) == len(files) == len(set(last))
    named = any(_stem(name) in by_stem for name in names.values())
    if not (named or unique or len(files) == observations.num_frames):
        problem = f"has {len(files)} pictures without frame numbers of their own, for {observations.num_frames} frames"
        raise InputError(source, problem, "name the pictures by frame numbers or as the images")
    numbers = last if unique else observations.frame_index.tolist()
    by_number = {} if named else dict(zip(numbers, files, strict=True))

    def masks_of(n: int, t: int) -> list[np.ndarray]:
        file = by_stem.get(_stem(names[n, t])) if named else by_number.get(int(observations.frame_index[t]))
        if file is None:
            return []
        return masks_of_picture(_read_mask_picture(file), file, int(observations.present[:, t].sum()) > 1)

    return masks_of


def _read_mask_picture(file: Path) -> np.ndarray:
    """Return the (H, W) grey values of a picture of masks."""
    picture = read_picture(file, grey=True)
    if picture is None:
        raise InputError(file, "is no readable picture", "write the picture again, or remove it")
    return picture


def masks_of_picture(picture: np.ndarray, file: Path, several_birds: bool) -> list[np.ndarray]:
    """Return the masks of a picture of masks: one for every grey value except 0.

    Args:
        picture: (H, W) grey values of 8 or 16 bits.
        file: the file of the picture.
        several_birds: whether a picture with one value holds one mask for every connected region.

    Raises:
        InputError: the picture holds too many connected regions.
    """
    values = np.flatnonzero(np.bincount(picture.reshape(-1), minlength=1)[1:]) + 1
    if len(values) > _MAX_VALUES or file.suffix.lower() in (".jpg", ".jpeg", ".webp"):
        half = 2**15 if picture.dtype == np.uint16 else 2**7
        picture, values = np.where(picture >= half, 255, 0).astype(np.uint8), np.array([255])
    if len(values) == 1 and several_birds:
        count, regions = cv2.connectedComponents((picture == values[0]).astype(np.uint8))
        if count - 1 > _MAX_REGIONS:
            problem = f"holds {count - 1:,} connected regions, more than {_MAX_REGIONS:,}"
            raise InputError(file, problem, "give one grey value to every bird")
        return [regions == i for i in range(1, count)]
    return [picture == value for value in values]
