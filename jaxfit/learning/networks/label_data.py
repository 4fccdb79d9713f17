"""Labels are checked, held out and stored as `LabelledFrames`.

Division of labelled pictures into a training part and a held-out part, by video or by blocks of time. Neighbouring
frames of a video are almost equal. A network that has seen one of two neighbours knows the other, so a held-out part of
random frames would measure memory.

Labelled pictures of a user as `LabelledFrames`: the same kind of training data as the simulated frames. The networks
are trained for birds of a certain length in pixels. The lengths of the labelled birds determine the scale at which the
new network will see the footage: `longer_side` of a segmenter, the margins of the crops of a keypoint network. Training
uses the scales around this scale.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.format import open_memmap

from jaxfit.data.masks import decode_mask
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.keypoints import CROPS, PAPER_PIXELS_PER_UNIT
from jaxfit.learning.networks.labelled_frames import (
    MARKER,
    UNKNOWN,
    UNKNOWN_OWNER,
    LabelledFrames,
    load_frames,
    save_labels,
)
from jaxfit.learning.networks.labels import (
    LabelledBird,
    LabelledPicture,
    LabelSet,
    LeftOut,
    StoredPicture,
    check_picture,
    check_sides,
    images_of,
    read_labels,
    read_pictures,
)
from jaxfit.learning.networks.segmenter import PIXELS_PER_UNIT
from jaxfit.learning.networks.teacher import Tracked, track_labels
from jaxfit.perception.keypoints import CropSettings
from jaxfit.perception.network import Segmenter
from jaxfit.perception.segmentation import LONGER_SIDE_PX, MULTIPLE

_logger = logging.getLogger(__name__)

GAP_FRAMES = 25
"""Pictures that are nearer to a held-out picture of their video, in frames, belong to neither part."""
MAX_GAP = 0.1
"""Largest share of a video's pictures in the gap at a border of a held-out block; at least one picture."""
PICTURES_PER_BLOCK = 50
"""Number of labelled pictures of a video for each held-out block of time."""
MAX_HELD_OUT = 0.4
"""Largest share of the pictures that are held out as whole videos."""


class Split(NamedTuple):
    """Positions of the pictures of each part; the pictures in the gaps are in no part."""

    training: list[int]
    holdout: list[int]
    gap: list[int]
    rule: str
    """How the pictures were divided, for people."""


def split_pictures(pictures: Sequence[LabelledPicture], share: float) -> Split:
    """Hold out whole videos if there are several, or else blocks of consecutive labelled pictures.

    Every label file is a video. Whole videos are held out if this keeps at least `1 − MAX_HELD_OUT` of the pictures
    for the training. Otherwise, the last part of every video, or of every block of `PICTURES_PER_BLOCK` labelled
    pictures, is held out. Pictures at the borders of a held-out block belong to neither part if they are nearer than
    `GAP_FRAMES`.

    Args:
        pictures: usable pictures, by file, and in the order of time in each file.
        share: share of the pictures to hold out; 0 holds out nothing.

    Raises:
        InputError: too few pictures for both parts.
    """
    everything = list(range(len(pictures)))
    if share == 0:
        return Split(everything, [], [], "nothing is held out")
    videos = [list(group) for _, group in groupby(everything, key=lambda i: pictures[i].source)]
    split = _by_video(pictures, videos, share) or _by_time(pictures, videos, share)
    with_birds = [any(pictures[i].birds for i in part) for part in (split.training, split.holdout)]
    if not all(with_birds):
        part = "hold-out" if with_birds[0] else "training part"
        problem = f"the {part} has no bird: there are {len(pictures)} usable labelled pictures"
        remedy = "label more pictures, of other times; or give --holdout 0 to train without a check of the result"
        raise InputError("train: labels", problem, remedy)
    return split


def _by_video(pictures: Sequence[LabelledPicture], videos: list[list[int]], share: float) -> Split | None:
    """Hold out videos, smallest first, until at least half the share is reached; None if that takes too many."""
    if len(videos) < 2:
        return None
    held: list[list[int]] = []
    for video in sorted(videos, key=len):
        if sum(map(len, held)) >= 0.5 * share * len(pictures):
            break
        held.append(video)
    holdout = sorted(i for video in held for i in video)
    if len(holdout) > MAX_HELD_OUT * len(pictures):
        return None
    names = ", ".join(pictures[video[0]].source.name for video in held)
    training = [i for i in range(len(pictures)) if i not in set(holdout)]
    return Split(training, holdout, [], f"held out by video: {names}")


def _by_time(pictures: Sequence[LabelledPicture], videos: list[list[int]], share: float) -> Split:
    training: list[int] = []
    holdout: list[int] = []
    gap: list[int] = []
    for video in videos:
        blocks = max(1, round(len(video) / PICTURES_PER_BLOCK))
        for block in np.array_split(video, blocks):
            count = round(share * len(block)) or (len(block) > 1)
            holdout += block[len(block) - count :].tolist()
        held = set(holdout) & set(video)
        reach = max(1, round(MAX_GAP * len(video)))
        for place, i in enumerate(video):
            if i in held:
                continue
            near = [j for j in video[max(place - reach, 0) : place + reach + 1] if j in held]
            close = any(abs(pictures[j].frame - pictures[i].frame) < GAP_FRAMES for j in near)
            (gap if close else training).append(i)
    return Split(training, holdout, gap, "held out by blocks of time")


PAPER_BIRD_PX = 250.0
"""Length of a bird in the footage for which the margins of the crops are chosen."""
INPUT_BIRD_PX = 60.0, 120.0
"""Range of the median length of a bird in the segmenter's input; the simulated birds have 50 to 139 pixels."""
LONGEST_SIDE_PX = 1728
"""Largest `longer_side`; the time of a segmenter grows with the square."""
STORED_BIRD_PX = 260.0
"""Larger birds are reduced to this median length before the training, which saves disk space."""


class Scale(NamedTuple):
    """The scale at which the network will see the footage."""

    bird_px: float
    """Median length of the labelled birds: the longer side of their boxes, pixels of the pictures."""
    longer_side_px: int
    """Longer side of the segmenter's input."""
    crops: CropSettings
    """The crops of the keypoint network, in pixels of the pictures."""

    def pixels_per_unit(self, network: str, size_px: tuple[int, int]) -> float:
        """Return the scale of a picture of this size as `LabelledFrames` stores the scale."""
        if network == "keypoints":
            return PAPER_PIXELS_PER_UNIT * self.bird_px / PAPER_BIRD_PX
        # the middle of the training scales becomes the scale in use
        return float(np.sqrt(np.prod(PIXELS_PER_UNIT))) * max(size_px) / self.longer_side_px


def choose_scale(pictures: Iterable[LabelledPicture]) -> Scale:
    """Choose the scale for labelled pictures with at least one bird."""
    lengths, shares = [], []
    for picture in pictures:
        for bird in picture.birds:
            lengths.append(float(bird.box_px[2:].max()))
            shares.append(lengths[-1] / max(picture.size_px))
    length, input_length = float(np.median(lengths)), LONGER_SIDE_PX * float(np.median(shares))
    longer_side = LONGER_SIDE_PX * float(np.clip(input_length, *INPUT_BIRD_PX)) / input_length
    longer_side = min(max(MULTIPLE * round(longer_side / MULTIPLE), 5 * MULTIPLE), LONGEST_SIDE_PX)
    pad, dilate = (max(2, round(margin * length / PAPER_BIRD_PX)) for margin in (CROPS.pad_px, CROPS.dilate_px))
    return Scale(length, longer_side, CROPS._replace(pad_px=pad, dilate_px=dilate))


def prepare_frames(
    folder: Path,
    pictures: Sequence[StoredPicture],
    names: Sequence[str],
    scale: Scale,
    network: str,
) -> LabelledFrames:
    """Write labelled pictures to a folder of labelled frames; an earlier folder is replaced.

    Pictures of several sizes lie in the upper left corners of frames of the largest size.

    DeepLabCut and SLEAP have no other mark for a hidden keypoint than a missing label. So a keypoint without a label is
    not visible, and the network learns to give it no confidence, unless the labels mark hidden keypoints (visibility
    1), or no bird has a label of this keypoint: then the keypoint is `UNKNOWN`.

    Args:
        folder: the folder.
        pictures: the pictures and their labels.
        names: names of the keypoints.
        scale: the scale of the network.
        network: `segmenter` or `keypoints`.
    """
    factor = min(1.0, STORED_BIRD_PX / scale.bird_px)
    sizes = np.array(
        [np.maximum(np.round(factor * np.array(picture.labels.size_px)), 1) for picture in pictures]
    ).astype(int)
    width, height = sizes.max(0).tolist()
    S, K, N = len(pictures), len(names), max(1, *(len(picture.labels.birds) for picture in pictures))
    points, visibility = np.zeros((S, N, K, 2), np.float32), np.zeros((S, N, K), np.uint8)
    per_unit = np.zeros(S, np.float32)
    given = [bird.visibility for picture in pictures for bird in picture.labels.birds] or [np.zeros(K)]
    without_label = np.where((np.max(given, 0) > 0) & ~(np.array(given) == 1).any(), 0, UNKNOWN)
    with new_folder(folder, overwrite=True, marker=MARKER) as part:
        stored = open_memmap(part / "pictures.npy", "w+", np.uint8, (S, height, width, 3))
        owner = open_memmap(part / "owner.npy", "w+", np.uint8, (S, height, width))
        for s, (picture, _) in enumerate(pictures):
            w, h = sizes[s].tolist()
            resample = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
            stored[s, :h, :w] = cv2.resize(pictures[s].pixels(), (w, h), interpolation=resample)
            birds = owner_of(picture.birds, picture.size_px)
            if picture.unknown is not None:
                birds[decode_mask(picture.unknown)] = UNKNOWN_OWNER
            owner[s, :h, :w] = cv2.resize(birds, (w, h), interpolation=cv2.INTER_NEAREST)
            per_unit[s] = factor * scale.pixels_per_unit(network, picture.size_px)
            for n, bird in enumerate(picture.birds):
                points[s, n] = bird.keypoints_px * (w / picture.size_px[0], h / picture.size_px[1])
                visibility[s, n] = np.where(bird.visibility > 0, bird.visibility, without_label)
        del stored, owner  # writes the memory-mapped files
        save_labels(part, points, visibility, per_unit, names)
    return load_frames(folder)


def owner_of(birds: Sequence[LabelledBird], size_px: tuple[int, int]) -> np.ndarray:
    """Return the number of the bird of each pixel, from 1: masks, and the boxes of birds without masks below them."""
    owner = np.zeros((size_px[1], size_px[0]), np.uint8)
    for n, bird in enumerate(birds, 1):
        if bird.mask is None:
            x, y, width, height = bird.box_px.tolist()
            rows = slice(max(round(y), 0), max(round(y + height), 0))
            owner[rows, max(round(x), 0) : max(round(x + width), 0)] = n
    for n, bird in enumerate(birds, 1):
        if bird.mask is not None:
            owner[decode_mask(bird.mask)] = n
    return owner


PICTURES, FRAMES, ALL_FRAMES, TRACKED = "pictures", "frames", "all_frames", "tracked"
"""Folders of the stored pictures, of the training part, of all labelled frames, and of the pictures of frames with
tracked masks, in the folder of a training."""
TRACKED_PER_HELD = 5
"""Number of tracked frames for each tracked frame that the first training does not see."""
_PICTURES_MARKER = "pictures.txt"


class LabelFiles(NamedTuple):
    """The files of the labels."""

    labels: tuple[Path, ...]
    """Files of any format of `read_observations`; for a segmenter also folders of pictures of masks."""
    images: tuple[Path, ...] = ()
    """Videos or folders of pictures: one for all files, or one for each file; empty if they lie beside the files."""
    masks: Path | None = None
    """Folder of pictures of masks, or COCO file, for labels without masks."""

    @property
    def sources(self) -> dict[Path, Path | None]:
        """The video or folder of the pictures of every file of labels; None if the pictures lie beside the file."""
        return dict(zip(self.labels, images_of(self.labels, self.images) or [None] * len(self.labels), strict=True))


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
    tracked: list[StoredPicture]
    """Other frames of the films of the labels, with masks that a teacher tracked."""
    tracked_holdout: list[StoredPicture]
    """The tracked frames that the first training does not see."""
    teacher: str
    """What the teacher did, for the user; empty without a teacher."""


def prepare_data(
    network: str,
    files: LabelFiles,
    share: float,
    references: LabelledFrames | None,
    folder: Path,
    labels: LabelSet | None = None,
    progress: ProgressTask = silent,
    teacher: Segmenter | None = None,
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
        teacher: tracks the masks of a segmenter's labels to other frames of their films; None for labels only.

    Raises:
        InputError: labels or pictures cannot be read, or too few labels can be used.
    """
    labels = labels or read_label_files(network, files, progress)
    left_out: list[LeftOut] = []
    stored: list[StoredPicture] = []
    sources = files.sources
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
        stored = [StoredPicture(right, old.file) for old, right in zip(stored, checked, strict=True) if right.birds]
    stored.sort(key=lambda picture: (files.labels.index(picture.labels.source), picture.labels.frame))
    if not any(picture.labels.birds for picture in stored):
        problem = f"holds no usable label: {left_out[0] if left_out else 'no bird'}"
        needs = "" if network == "keypoints" else "; a segmenter needs masks (--masks)"
        raise InputError(files.labels[0], problem, f"correct the labels{needs}")
    unused = [label for label in left_out if not label.bird]
    if unused:
        text = "%d of %d labelled pictures are not used, for example %s"
        _logger.warning(text, len(unused), len(labels.pictures), unused[0])
    tracked = Tracked([], [], 0, [])
    if teacher is not None:
        shutil.rmtree(folder / TRACKED, ignore_errors=True)
        tracked = track_labels(stored, sources, teacher, folder / TRACKED, progress)
        problem = "the teacher detects another bird, and so do the masks that are tracked from other labels"
        left_out += [LeftOut(picture.source, picture.name, "", problem) for picture in tracked.wrong]
        wrong = {(picture.source, picture.frame) for picture in tracked.wrong}
        stored = [picture for picture in stored if (picture.labels.source, picture.labels.frame) not in wrong]
    split = split_pictures([picture.labels for picture in stored], share)
    training, holdout = ([stored[i] for i in part] for part in (split.training, split.holdout))
    scale = choose_scale(picture.labels for picture in training)
    held = tracked.pictures[::TRACKED_PER_HELD] if holdout else []
    known = [picture.labels for picture in stored]
    seen = [
        picture
        for i, picture in enumerate(tracked.pictures)
        if not (held and i % TRACKED_PER_HELD == 0) and not _is_within(picture.labels, known, split.holdout)
    ]
    frames = prepare_frames(folder / FRAMES, [*training, *seen], labels.keypoint_names, scale, network)
    return FineTuningData(
        keypoint_names=labels.keypoint_names,
        frames=frames,
        pictures=stored,
        holdout=holdout,
        left_out=left_out,
        split=split,
        scale=scale,
        tracked=tracked.pictures,
        tracked_holdout=held,
        teacher=tracked.sentence() if tracked.confirmed or tracked.doubtful else "",
    )


def _is_within(picture: LabelledPicture, labels: Sequence[LabelledPicture], holdout: Sequence[int]) -> bool:
    """Return whether the labelled pictures before and after a picture of the film are both held out."""
    frames = [(label.frame, i in holdout) for i, label in enumerate(labels) if label.source == picture.source]
    before = max((frame for frame in frames if frame[0] <= picture.frame), default=(0, False))
    after = min((frame for frame in frames if frame[0] >= picture.frame), default=(0, False))
    return before[1] and after[1]


def read_label_files(network: str, files: LabelFiles, progress: ProgressTask = silent) -> LabelSet:
    """Read the labels for a network; errors as `prepare_data`."""
    images = images_of(files.labels, files.images)
    labels = read_labels(files.labels, images, files.masks, network == "keypoints", progress)
    if not any(picture.birds for picture in labels.pictures):
        raise InputError(files.labels[0], "holds no labelled bird", "label birds, or choose another file")
    return labels


def fingerprint(data: FineTuningData, scenes: Sequence[Path], base: Path, settings: Sequence[object]) -> str:
    """Return a hash of everything that determines a training, so that only the same training is resumed."""
    content = hashlib.blake2b(base.read_bytes(), digest_size=16)
    content.update(repr((tuple(settings), data.keypoint_names, data.scale, data.split)).encode())
    for folder in scenes:
        content.update((folder / MARKER).read_bytes())
    frames = data.frames
    for array in (frames.keypoints_px, frames.visibility, frames.pixels_per_unit, *frames.pictures, *frames.owner):
        content.update(np.ascontiguousarray(array).tobytes())
    for picture in (*data.pictures, *data.tracked):  # the measurements and the second training use all labels
        content.update(repr(picture.labels).encode())
    return content.hexdigest()
