"""Labels of a user, of any format, and their pictures; wrong labels are named and left out.

Labels whose left and right are mixed up are detected by the layout of the keypoints of a bird. Layouts are compared
after the best similarity (position, size and rotation in the picture, no mirroring): for centred layouts a and b as
complex numbers, the distance is 1 − |⟨a, b⟩|² / (‖a‖² ‖b‖²). A bird whose left and right are exchanged resembles no
other bird, but resembles other birds once left and right are exchanged back. The reference birds are the simulated
birds, whose labels are exact, and the other labelled birds.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfit.data.formats.coco import coco_observations
from jaxfit.data.formats.coco_records import complete_export
from jaxfit.data.formats.fields import Field, read_json
from jaxfit.data.formats.mask_files import add_masks, mask_observations
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.masks import box_of_mask, decode_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.array_files import load_npy, load_npz
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.labelled_frames import MAX_BIRDS, LabelledFrames
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
            read, file_names = list(_pictures(mask_observations(file, progress), file)), (CENTRE,)
        else:
            observations = _observations(file, images[i] if images else None, needs_keypoints)
            if masks is not None:
                observations = add_masks(observations, masks, progress, images[i] if images else None)
            read, file_names = list(_pictures(observations, file)), observations.keypoint_names
        if not needs_keypoints:
            read = [picture._replace(birds=tuple(map(_at_centre, picture.birds))) for picture in read]
            file_names = (CENTRE,)
        if names and sorted(file_names) != sorted(names):
            different = sorted(set(file_names) ^ set(names))
            problem = f"names other keypoints than {files[0].name}: {', '.join(different)} only in one of the two"
            raise InputError(file, problem, "label the same keypoints in all files")
        names = names or file_names
        order = [file_names.index(name) for name in names]
        for picture in read:
            birds = (
                b._replace(keypoints_px=b.keypoints_px[order], visibility=b.visibility[order]) for b in picture.birds
            )
            pictures.append(picture._replace(birds=tuple(birds)))
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


def mask_bird(number: int, mask: np.ndarray) -> LabelledBird:
    """Return the bird of a mask, with the centre of its box as keypoint."""
    box, nowhere = np.array(box_of_mask(mask), np.float32), np.zeros(0)
    return _at_centre(LabelledBird(f"bird {number}", box, nowhere, nowhere, encode_mask(mask)))


def _at_centre(bird: LabelledBird) -> LabelledBird:
    """Return a bird with one keypoint, the centre of its box."""
    centre = (bird.box_px[:2] + bird.box_px[2:] / 2)[None].astype(np.float32)
    return bird._replace(keypoints_px=centre, visibility=np.full(1, 2, np.uint8))


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
    return {listed.index(file): picture.labels for picture, file in zip(pictures, files, strict=True) if file in listed}


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


MIN_COMMON = 6
"""Least number of keypoints that two birds must share for a comparison."""
MIN_REFERENCES = 20
"""With fewer comparable birds, nothing is detected."""
NEAREST = 3
"""The distance of a bird is the mean over this number of nearest reference birds: one wrong label misleads less."""
CLEARLY_BETTER = 0.35
"""A bird counts as mixed up if the exchange reduces its distance to less than this share. On 272 simulated birds with
references of other scenes, this value detects 99.6 % of the exchanged birds, and no other bird."""


REFERENCES = Path(__file__).with_name("reference_birds.npz")
"""Keypoints of the simulated birds of 20 training scenes, as `test_scenes.py` makes them: the check needs many
birds, before scenes are filmed."""


def load_reference_birds() -> LabelledFrames:
    """Return one frame per simulated bird, without pictures; a keypoint is known if it was in the picture."""
    stored = load_npz(REFERENCES, {"keypoints": "R K 2", "known": "R K"})
    points, visibility = stored["keypoints"][:, None].astype(np.float32), stored["known"][:, None].astype(np.uint8)
    R = len(points)
    pictures, owner = np.zeros((R, 0, 0, 3), np.uint8), np.zeros((R, 0, 0), np.uint8)
    return LabelledFrames(pictures, owner, points, visibility, np.ones(R, np.float32))


def mixed_up_birds(
    keypoints_px: Float[np.ndarray, "M K 2"],
    known: Bool[np.ndarray, "M K"],
    references_px: Float[np.ndarray, "R K 2"],
    references_known: Bool[np.ndarray, "R K"],
    names: Sequence[str],
) -> Bool[np.ndarray, "M"]:
    """Return the labelled birds whose left and right are mixed up.

    Args:
        keypoints_px: positions (x, y) of M labelled birds.
        known: whether a keypoint is labelled.
        references_px: positions of R other birds with exact labels, in any pictures.
        references_known: whether a keypoint of the other birds is known.
        names: names of the K keypoints, which tell their sides.
    """
    opposite = np.array(opposite_keypoints(names))
    M = len(keypoints_px)
    paired = (opposite >= 0) & (opposite != np.arange(len(opposite)))
    if not paired.any() or M == 0:
        return np.zeros(M, bool)
    exchange = np.where(opposite >= 0, opposite, np.arange(len(opposite)))
    layouts = np.concatenate([references_px, keypoints_px]) @ np.array([1, 1j])
    there = np.concatenate([references_known, known])
    wrong = np.zeros(M, bool)
    for m in range(M):
        both = known[m] & known[m, exchange] & paired
        if both.sum() < 2:
            continue
        others = np.arange(len(layouts)) != len(references_px) + m
        layout = keypoints_px[m] @ np.array([1, 1j])
        given = _distance(layout, known[m], layouts[others], there[others])
        exchanged = _distance(layout[exchange], known[m, exchange], layouts[others], there[others])
        if given is not None and exchanged is not None:
            wrong[m] = exchanged < CLEARLY_BETTER * given
    return wrong


def _distance(layout: np.ndarray, known: np.ndarray, others: np.ndarray, there: np.ndarray) -> float | None:
    """Return the mean distance of a layout to its nearest others; None with too few others."""
    common = known & there
    usable = common.sum(1) >= min(MIN_COMMON, known.sum())
    if usable.sum() < MIN_REFERENCES or known.sum() < 4:
        return None
    common, others = common[usable], others[usable]
    count = common.sum(1, keepdims=True)
    a, b = np.where(common, layout, 0), np.where(common, others, 0)
    a = np.where(common, a - a.sum(1, keepdims=True) / count, 0)
    b = np.where(common, b - b.sum(1, keepdims=True) / count, 0)
    norms = (np.abs(a) ** 2).sum(1) * (np.abs(b) ** 2).sum(1)
    distances = 1 - np.abs((np.conj(b) * a).sum(1)) ** 2 / np.maximum(norms, 1e-12)
    return float(np.partition(distances, NEAREST - 1)[:NEAREST].mean())


OUTSIDE_PX = 2.0
"""Largest distance of a label outside its picture."""
MIN_AREA_PX = 30
"""Least area of a mask."""
SECOND_PART = 0.3
"""Least area of the second part of a mask of two birds, as a share of the largest part."""
PART_DISTANCE = 0.5
"""Least distance between the parts of a mask of two birds, in lengths of the largest part. A bird or a rock in front
of a bird can divide its mask, but the parts are nearer: on simulated frames, this value detects 60 % of the pairs of
birds, and 1 of 1,170 single birds."""


class LeftOut(NamedTuple):
    """A label that is not used."""

    source: Path
    picture: str
    bird: str
    """Name of the bird; empty for the whole picture."""
    problem: str

    def __str__(self) -> str:
        return f"{self.source.name}: {' '.join(filter(None, (self.picture, self.bird)))}: {self.problem}"


def check_picture(
    picture: LabelledPicture, pixels: np.ndarray | None, network: str
) -> tuple[LabelledPicture | None, list[LeftOut]]:
    """Return the picture with its usable birds, and the labels that are not used.

    A bird without a label would be trained as background. So the segmenter does not use a picture at all if one of its
    birds is not usable. The keypoint network uses the other birds of the picture.

    Args:
        picture: the labels.
        pixels: the picture; None if it cannot be read.
        network: `segmenter` or `keypoints`.

    Returns:
        The picture with its usable birds, None if it is not used; and the problems.
    """

    def left_out(problem: str, bird: str = "") -> LeftOut:
        return LeftOut(picture.source, picture.name, bird, problem)

    if pixels is None:
        return None, [left_out("the picture is missing or cannot be read")]
    size = pixels.shape[1], pixels.shape[0]
    if size != picture.size_px:
        problem = f"the picture is {size[0]}×{size[1]}, but the labels say {picture.size_px[0]}×{picture.size_px[1]}"
        return None, [left_out(problem)]
    if len(picture.birds) > MAX_BIRDS:
        return None, [left_out(f"the picture holds {len(picture.birds)} birds, more than {MAX_BIRDS}")]
    usable, problems = [], []
    for bird in picture.birds:
        problem = _problem(bird, picture.size_px, network)
        if problem is None:
            usable.append(bird)
        else:
            problems.append(left_out(problem, bird.name))
    is_used = not problems if network == "segmenter" else bool(usable)
    return (picture._replace(birds=tuple(usable)) if is_used else None), problems


def check_sides(
    pictures: Sequence[LabelledPicture], names: Sequence[str], simulated: LabelledFrames | None
) -> tuple[list[LabelledPicture], list[LeftOut]]:
    """Return the pictures without the birds whose left and right are mixed up, and these birds.

    Args:
        pictures: usable pictures.
        names: names of the keypoints.
        simulated: simulated birds for the comparison; None compares the labelled birds with each other only.
    """
    birds = [(p, bird) for p, picture in enumerate(pictures) for bird in picture.birds]
    if not birds:
        return list(pictures), []
    references_px, references_known = np.zeros((0, len(names), 2)), np.zeros((0, len(names)), bool)
    if simulated is not None:
        frames = simulated.with_keypoints(names)
        usable = frames.known.sum(-1) >= MIN_COMMON
        references_px, references_known = frames.keypoints_px[usable], frames.known[usable]
    points = np.stack([bird.keypoints_px for _, bird in birds])
    known = np.stack([bird.visibility > 0 for _, bird in birds])
    wrong = mixed_up_birds(points, known, references_px, references_known, names)
    problem = "left and right are mixed up: the bird resembles other birds only if left and right are exchanged"
    problems = [
        LeftOut(pictures[p].source, pictures[p].name, bird.name, problem)
        for (p, bird), is_wrong in zip(birds, wrong, strict=True)
        if is_wrong
    ]
    kept: list[list[LabelledBird]] = [[] for _ in pictures]
    for (p, bird), is_wrong in zip(birds, wrong, strict=True):
        if not is_wrong:
            kept[p].append(bird)
    return [picture._replace(birds=tuple(birds)) for picture, birds in zip(pictures, kept, strict=True)], problems


def _problem(bird: LabelledBird, size_px: tuple[int, int], network: str) -> str | None:
    """Return why a bird cannot be used; None if it can be used."""
    (x, y, width, height), (image_width, image_height) = bird.box_px.tolist(), size_px
    if min(x, y) < -OUTSIDE_PX or x + width > image_width + OUTSIDE_PX or y + height > image_height + OUTSIDE_PX:
        return f"the box reaches outside the picture: x {x:.0f} to {x + width:.0f}, y {y:.0f} to {y + height:.0f}"
    known = bird.visibility > 0
    if network == "keypoints":
        if known.sum() < min(3, len(known)):
            return f"only {known.sum()} of the {len(known)} keypoints are labelled"
        outside = ((bird.keypoints_px < -OUTSIDE_PX) | (bird.keypoints_px > np.array(size_px) + OUTSIDE_PX)).any(-1)
        if (outside & known).any():
            x, y = bird.keypoints_px[outside & known][0].tolist()
            return f"a keypoint lies outside the picture, at x {x:.0f}, y {y:.0f}"
    if bird.mask is None:
        return "the bird has no mask" if network == "segmenter" else None
    mask = decode_mask(bird.mask)
    if mask.sum() < MIN_AREA_PX:
        return f"the mask has {mask.sum()} pixels"
    return "one mask covers two birds" if _covers_two_birds(mask) else None


def _covers_two_birds(mask: np.ndarray) -> bool:
    """Return whether a mask has two large parts that lie far from each other."""
    count, regions, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    if count < 3:
        return False
    areas = stats[1:, cv2.CC_STAT_AREA]
    largest = 1 + int(areas.argmax())
    length = stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max()
    distance = cv2.distanceTransform((regions != largest).view(np.uint8), cv2.DIST_L2, 5)
    parts = [part for part in range(1, count) if part != largest and areas[part - 1] >= SECOND_PART * areas.max()]
    return any(distance[regions == part].min() > PART_DISTANCE * length for part in parts)
