"""Masks of unlabelled frames of a film, from a teacher: a segmenter that knows birds in general.

The masks begin in seeds, which are frames with known birds. Seeds are labelled frames (`track_labels`), or frames in
which two runs of the teacher agree (`teach`): one run on the frame and one run on the mirrored frame at a smaller
scale. From every seed, the masks are tracked to later and earlier frames, up to the middle between two seeds. In every
frame, optical flow moves the mask of the frame before, and the teacher segments the bird at the place of the moved
mask. The tracked mask counts if its IoU with the moved mask is above ½, or if two runs of the teacher agree. So a bird
needs no detection: the detector of `general` misses many birds that fly or turn, but its saliency network segments a
bird in a box that is known.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.data.masks import box_of_mask, decode_mask, encode_mask
from jaxfit.evaluation.metrics import iou
from jaxfit.foundation.array_files import load_npy
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.labels import (
    LabelledPicture,
    StoredPicture,
    mask_bird,
    numbered_by_film,
)
from jaxfit.perception.detections import single_opencv_thread
from jaxfit.perception.general_networks import installed_general
from jaxfit.perception.merging import MIN_SAME_IOU
from jaxfit.perception.network import Segmenter
from jaxfit.perception.saliency import CONTEXT, DetectorAndSaliency
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.video.reader import probe_video, read_frames

SEEDS = 24
"""Number of frames, spread over the film, in which the teacher searches birds without labels."""
EXAMINED = 48
"""Largest number of frames to which masks are tracked."""
FLOW_FRAMES = 240
"""Number of frames through which masks are tracked: the nearest frames to the seeds."""
FLOW_SIDE_PX = 480
"""Longer side of the pictures of the optical flow."""
SMALLER = 2 / 3
"""Scale of the mirrored frame in the second run of the teacher."""
MAX_MISSES = 3
"""Number of consecutive examined frames without a mask that counts, after which the moved masks are of no use: the
tracking of a seed continues in a frame in which two runs of the teacher detect its birds."""
SEED_IOU = 0.7
"""Least IoU of a label and the mask of the teacher at its place. With fewer than half of the labels above this value,
the teacher does not know the birds of the labels, and nothing is tracked."""

SHOWN = 10
"""Largest number of doubtful labels that a message names."""

_logger = logging.getLogger(__name__)

Mask = Bool[np.ndarray, "H W"]


class Film(NamedTuple):
    """The frames of a film through which masks are tracked."""

    source: Path
    grey: dict[int, UInt8[np.ndarray, "h w"]]
    """Reduced grey pictures by frame number, in the order of time."""
    files: dict[int, Path]
    """`.npy` files of the pictures of the examined frames."""
    size_px: tuple[int, int]
    """Width and height of the pictures."""

    def picture(self, number: int) -> UInt8[np.ndarray, "H W 3"]:
        """Return the picture of an examined frame: blue, green, red."""
        return load_npy(self.files[number], "H W 3")

    def stored(self, number: int, masks: Sequence[Mask], unknown: Mask) -> StoredPicture:
        """Return the labels of a frame; empty masks are left out."""
        birds = tuple(mask_bird(n, mask) for n, mask in enumerate(masks, 1) if mask.any())
        name = f"{self.source.name}#{number}"
        hidden = encode_mask(unknown) if unknown.any() else None
        labels = LabelledPicture(self.source, name, number, self.size_px, birds, hidden)
        return StoredPicture(labels, self.files[number])


class Taught(NamedTuple):
    """Labels that a teacher made, without a person."""

    pictures: list[StoredPicture]
    confirmed: int
    """Number of frames with a bird of both runs of the teacher."""
    detected: int
    """Number of frames with a bird of the first run."""


class Tracked(NamedTuple):
    """Masks that were tracked from labels."""

    pictures: list[StoredPicture]
    """Frames without labels."""
    wrong: list[LabelledPicture]
    """Labels that differ from the masks of the teacher and from the masks that are tracked from other labels."""
    confirmed: int
    """Number of labelled frames whose birds the teacher confirms."""
    doubtful: list[str]
    """Names and least IoUs of labelled frames that the teacher does not confirm."""

    def sentence(self) -> str:
        """Return for the user how well the teacher knows the labels, and what was tracked."""
        text = f"labelled frames that the teacher confirms: {self.confirmed}"
        if self.doubtful:
            more = ", …" if len(self.doubtful) > SHOWN else ""
            names = ", ".join(self.doubtful[:SHOWN])
            text += f"; does not confirm: {len(self.doubtful)} (IoU below {SEED_IOU}: {names}{more})"
        return f"{text}; other frames with tracked masks: {len(self.pictures)}"


def teach(video: Path, teacher: Segmenter, folder: Path, progress: ProgressTask = silent) -> Taught:
    """Make labels of a film from the masks in which two runs of a teacher agree.

    Pixels of masks in which the runs differ are unknown: they are neither bird nor background. Frames without a mask of
    both runs are no labels, unless a mask is tracked to the frame.

    Args:
        video: the film, a video or a folder of frames.
        teacher: the teacher.
        folder: existing folder for the pictures of the frames.
        progress: reports every frame.

    Raises:
        InputError: the film cannot be read, or the teacher detects no bird in both runs.
    """
    total = probe_video(video).frames or sum(1 for _ in read_frames(video))
    numbers = np.unique(((np.arange(SEEDS) + 0.5) * total / SEEDS).astype(int)).tolist()
    film = read_film(video, numbers, folder, progress=progress)
    seeds: dict[int, list[Mask]] = {}
    unknown: dict[int, Mask] = {}
    detected = 0
    with single_opencv_thread(), progress("Asking the teacher", len(numbers)) as report_progress:
        for number in [number for number in numbers if number in film.files]:
            first, second = _two_runs(teacher, film.picture(number))
            pairs = _pairs(first, second)
            every = _union([*first, *second], film.size_px)
            birds = [first[i] & second[j] for i, j in pairs]
            stable = _union(birds, film.size_px)
            detected += bool(first)
            if birds:
                seeds[number], unknown[number] = birds, every & ~stable
            report_progress(1, f"frame {number}")
    if not seeds:
        what = "no bird" if not detected else "no bird that a second run on the smaller mirror image confirms"
        problem = f"the teacher detects {what} in {len(numbers)} frames"
        raise InputError(video, problem, "give a film with birds, or another --teacher, or labels by --labels")
    pictures = [film.stored(number, masks, unknown[number]) for number, masks in seeds.items()]
    pictures += [picture for picture, _ in _track(film, seeds, teacher, progress)]
    return Taught(sorted(pictures, key=lambda picture: picture.labels.frame), len(seeds), detected)


def open_teacher(name: str) -> Segmenter | None:
    """Load a teacher.

    Args:
        name: `general`; an ONNX file, or two files as `detector.onnx+saliency.onnx`; `none`; or `auto`, which is
            `general` if its files exist.

    Raises:
        InputError: a network cannot be used.
    """
    if name == "auto":
        name = installed_general() or "none"
    return None if name == "none" else load_segmenter(name)


def track_labels(
    pictures: Sequence[StoredPicture],
    sources: Mapping[Path, Path | None],
    teacher: Segmenter,
    folder: Path,
    progress: ProgressTask = silent,
) -> Tracked:
    """Track the masks of labelled pictures to the other frames of their films.

    Labels that differ from the masks of the teacher are no seeds. If these are more than half of the labels of a film,
    nothing is tracked in this film.

    Args:
        pictures: the labelled pictures, by file of labels.
        sources: file of labels → its film; None for labels without a film.
        teacher: the teacher.
        folder: existing folder for the pictures of other frames.
        progress: reports every frame.
    """
    films = [
        (source, film, numbered)
        for source, group in groupby(pictures, key=lambda picture: picture.labels.source)
        if (film := sources[source]) is not None and (numbered := numbered_by_film(list(group), film))
    ]
    result, confirmed = Tracked([], [], 0, []), 0
    for n, (source, video, labels) in enumerate(films):
        pictures_folder = folder / str(n)
        pictures_folder.mkdir(parents=True)
        try:
            film = read_film(video, sorted(labels), pictures_folder, len(films), progress)
        except InputError as error:  # pictures of several sizes
            _logger.warning("no masks are tracked: %s", error)
            continue
        if not film.files.keys() - labels.keys():  # nothing to track
            continue
        labels = {number: labels[number] for number in sorted(labels) if number in film.files}
        seeds, doubtful = _confirmed(film, labels, teacher, progress)
        num_seeds = sum(map(bool, seeds.values()))
        confirmed += num_seeds
        result.doubtful.extend(doubtful)
        if num_seeds < len(doubtful):
            continue
        for picture, is_unbroken in _track(film, seeds, teacher, progress):
            label = labels.get(picture.labels.frame)
            if label is None:
                result.pictures.append(picture._replace(labels=picture.labels._replace(source=source)))
            elif is_unbroken and _iou(_bird_pixels(label), _bird_pixels(picture.labels)) <= MIN_SAME_IOU:
                result.wrong.append(label)
    return result._replace(confirmed=confirmed)


def _confirmed(
    film: Film, labels: Mapping[int, LabelledPicture], teacher: Segmenter, progress: ProgressTask
) -> tuple[dict[int, list[Mask]], list[str]]:
    """Return the labels that can be seeds, and the names of other labels; ends when these are more than half."""
    seeds: dict[int, list[Mask]] = {}
    doubtful: list[str] = []
    with single_opencv_thread(), progress("Comparing labels with the teacher", len(labels)) as report_progress:
        for number, label in labels.items():
            masks = _masks(label)
            detected, _ = _segment(teacher, film.picture(number), masks)
            least = min((_iou(mask, bird) for mask, bird in zip(masks, detected, strict=True)), default=1.0)
            if least >= SEED_IOU:
                seeds[number] = masks
            else:
                doubtful.append(f"{label.name} {least:.2f}")
            report_progress(1, f"frame {number}")
            if 2 * len(doubtful) > len(labels):
                break
    return seeds, doubtful


def _masks(picture: LabelledPicture) -> list[Mask]:
    return [decode_mask(bird.mask) for bird in picture.birds if bird.mask is not None]


def _bird_pixels(picture: LabelledPicture) -> Mask:
    return _union(_masks(picture), picture.size_px)


def read_film(video: Path, seeds: Sequence[int], folder: Path, films: int = 1, progress: ProgressTask = silent) -> Film:
    """Read the frames around the seeds, and store the pictures of the seeds and of some other frames.

    Args:
        video: a video or a folder of frames.
        seeds: increasing frame numbers.
        folder: existing folder for the pictures.
        films: number of films that share `FLOW_FRAMES` and `EXAMINED`.
        progress: reports every frame.

    Raises:
        InputError: the film cannot be read.
    """
    reach = FLOW_FRAMES // films
    total = probe_video(video).frames
    numbers = np.arange(max(seeds[0] - reach, 0), min(seeds[-1] + reach + 1, total or seeds[-1] + reach + 1))
    after = np.searchsorted(seeds, numbers)
    distance = np.min([np.abs(numbers - np.take(seeds, after - side, mode="clip")) for side in (0, 1)], axis=0)
    near = np.sort(numbers[np.argsort(distance, kind="stable")[: reach + len(seeds)]])
    others = near[~np.isin(near, seeds)]
    step = max(1, math.ceil(films * len(others) / EXAMINED))
    wanted, kept = set(near.tolist()), {*others[step // 2 :: step].tolist(), *seeds}
    grey: dict[int, np.ndarray] = {}
    files: dict[int, Path] = {}
    size_px = 0, 0
    with progress("Reading the film", len(near)) as report_progress:
        for number, picture, _ in read_frames(video, int(near[0]), int(near[-1]) + 1):
            if number not in wanted:
                continue
            size_px = picture.shape[1], picture.shape[0]
            zoom = min(1.0, FLOW_SIDE_PX / max(size_px))
            small = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
            grey[number] = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
            if number in kept:
                files[number] = folder / f"film_{number:06d}.npy"
                np.save(files[number], picture)
            report_progress(1, f"frame {number}")
    return Film(video, grey, files, size_px)


def _track(
    film: Film, seeds: Mapping[int, Sequence[Mask]], teacher: Segmenter, progress: ProgressTask
) -> list[tuple[StoredPicture, bool]]:
    """Track the masks of all seeds, each up to the middle between two seeds; a frame without birds ends a track.

    Returns:
        The examined frames with their masks, and whether flow alone leads from the seed to the frame.
    """
    places = sorted(number for number in seeds if number in film.grey)
    numbers = list(film.grey)
    tracked: list[tuple[StoredPicture, bool]] = []
    with single_opencv_thread(), progress("Tracking masks", len(numbers)) as report_progress:
        for before, seed, after in zip([None, *places], places, [*places[1:], None], strict=False):
            low = -1 if before is None else (before + seed) // 2
            high = math.inf if after is None else (seed + after) // 2
            later = [number for number in numbers if seed < number <= high]
            earlier = [number for number in reversed(numbers) if low < number < seed]
            for way in (later, earlier) if seeds[seed] else ():
                tracked += _walk(film, seed, seeds[seed], way, teacher)
            report_progress(len(later) + len(earlier) + 1, f"frame {seed}")
    return tracked


def _walk(
    film: Film, seed: int, masks: Sequence[Mask], numbers: Sequence[int], teacher: Segmenter
) -> Iterator[tuple[StoredPicture, bool]]:
    """Yield the examined frames to which all masks of a seed are tracked; results as of `_track`."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    small_px = film.grey[seed].shape[::-1]
    y, x = np.mgrid[: small_px[1], : small_px[0]].astype(np.float32)
    carried = [_resized(mask, small_px) for mask in masks]
    last, misses, is_unbroken = seed, 0, True
    for number in numbers:
        if abs(number - last) > 2:  # beyond a damaged frame, the masks could be anywhere
            return
        back = flow.calc(film.grey[number], film.grey[last], None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        at = x + back[..., 0], y + back[..., 1]
        carried = [cv2.remap(mask, *at, cv2.INTER_LINEAR) for mask in carried]
        last = number
        if number not in film.files:
            continue
        moved = [_resized(mask, film.size_px) > 0.5 for mask in carried]
        birds, others = _segment(teacher, film.picture(number), moved)
        lost = [_iou(mask, before) <= MIN_SAME_IOU for mask, before in zip(birds, moved, strict=True)]
        if any(lost) or misses > MAX_MISSES:
            is_unbroken = False
            lost = [misses > MAX_MISSES or is_lost for is_lost in lost]
            again = _detected_again(teacher, film.picture(number), birds, lost)
            birds, lost = (again, [False] * len(again)) if again else (birds, lost)
        carried = [
            before if is_lost else _resized(mask, small_px)
            for mask, before, is_lost in zip(birds, carried, lost, strict=True)
        ]
        misses = misses + 1 if any(lost) else 0
        if not misses:
            total = np.sum(birds, axis=0)
            unknown = others & (total == 0) | (total > 1)
            yield film.stored(number, [mask & (total == 1) for mask in birds], unknown), is_unbroken


def _detected_again(
    teacher: Segmenter, picture: UInt8[np.ndarray, "H W 3"], birds: Sequence[Mask], lost: Sequence[bool]
) -> list[Mask]:
    """Return the masks of all birds, with those of lost birds by two runs of the teacher; empty if birds stay lost.

    Lost birds are detected if as many birds without a mask are detected in both runs.
    """
    first, second = _two_runs(teacher, picture)
    kept = [mask for mask, is_lost in zip(birds, lost, strict=True) if not is_lost]
    free = [first[i] & second[j] for i, j in _pairs(first, second)]
    free = [mask for mask in free if not any((mask & other).any() for other in kept)]
    if len(free) != sum(lost):
        return []
    left = iter(free)
    return [next(left) if is_lost else mask for mask, is_lost in zip(birds, lost, strict=True)]


def _segment(
    teacher: Segmenter, picture: UInt8[np.ndarray, "H W 3"], places: Sequence[Mask]
) -> tuple[list[Mask], Mask]:
    """Segment the birds at some places.

    Args:
        teacher: the teacher; `general` segments the boxes of the places, another teacher detects birds in the frame.
        picture: the frame.
        places: a mask of each bird, which may be inexact.

    Returns:
        The mask of each bird, empty without a bird; and the pixels of all birds that the teacher detects elsewhere.
    """
    size_px = picture.shape[1], picture.shape[0]
    others = np.zeros(picture.shape[:2], bool)
    if isinstance(teacher, DetectorAndSaliency):
        birds = []
        for place in places:
            x, y, width, height = box_of_mask(place) or (0, 0, 0, 0)
            corners_px = np.array([x, y, x + width, y + height], np.float32)
            bird = teacher.instance_in_box(picture, corners_px, CONTEXT) if width else None
            birds.append(np.zeros_like(others) if bird is None else bird.whole(size_px))
        covered = _union(birds, size_px)
        for x0, y0, x1, y1 in (np.round(box).astype(int).tolist() for box in teacher.boxes(picture)):
            part = slice(max(y0, 0), y1), slice(max(x0, 0), x1)
            if not covered[part].any():
                others[part] = True
        return birds, others
    detected = [bird.whole(size_px) for bird in teacher(picture)]
    of_place = dict(_pairs(places, detected))
    birds = [detected[of_place[i]] if i in of_place else others for i in range(len(places))]
    elsewhere = [bird for j, bird in enumerate(detected) if j not in of_place.values()]
    return birds, _union(elsewhere, size_px) & ~_union(birds, size_px)


def _two_runs(teacher: Segmenter, picture: UInt8[np.ndarray, "H W 3"]) -> tuple[list[Mask], list[Mask]]:
    """Return the masks of a picture, and of its mirror image at a smaller scale on a grey ground, mapped back."""
    height, width = picture.shape[:2]
    size_px = max(1, round(SMALLER * width)), max(1, round(SMALLER * height))
    left, top = (width - size_px[0]) // 2, (height - size_px[1]) // 2
    ground = np.full_like(picture, 114)
    part = slice(top, top + size_px[1]), slice(left, left + size_px[0])
    ground[part] = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA)[:, ::-1]
    second = [bird.whole((width, height))[part][:, ::-1] for bird in teacher(ground)]
    second = [_resized(mask, (width, height)) > 0.5 for mask in second]
    return [bird.whole((width, height)) for bird in teacher(picture)], [mask for mask in second if mask.any()]


def _pairs(first: Sequence[Mask], second: Sequence[Mask]) -> list[tuple[int, int]]:
    """Return the pairs of masks of the same bird."""
    ious = np.array([[_iou(a, b) for b in second] for a in first]).reshape(len(first), len(second))
    places = linear_sum_assignment(ious, maximize=True)
    return [(int(i), int(j)) for i, j in zip(*places, strict=True) if ious[i, j] > MIN_SAME_IOU]


def _iou(first: Mask, second: Mask) -> float:
    return float(np.nan_to_num(iou(first, second)))  # 0 where both are empty


def _union(masks: Sequence[Mask], size_px: tuple[int, int]) -> Mask:
    return np.any([np.zeros(size_px[::-1], bool), *masks], axis=0)


def _resized(mask: np.ndarray, size_px: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    return cv2.resize(mask.astype(np.float32), size_px, interpolation=cv2.INTER_LINEAR)
