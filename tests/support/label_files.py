"""Observations of three birds in four frames, and their files in the formats of labelling programs."""

import numpy as np

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.cvat import write_cvat
from jaxfit.data.formats.label_studio import write_label_studio
from jaxfit.data.formats.write_deeplabcut import write_deeplabcut_labels
from jaxfit.data.formats.write_sleap import write_sleap_project
from jaxfit.data.masks import box_of_keypoints, encode_mask
from jaxfit.data.observations import Observations

NAMES = ("bill_tip", "left_wingtip", "right_wingtip")
FRAMES = (3, 12, 20, 21)
SIZE = (90, 70)


def labelled_birds():
    """Return birds 4, 7 and 9: bird 7 lacks a frame, bird 9 lacks a keypoint, and the last frame has no bird."""
    random = np.random.default_rng(0)
    points = random.uniform(5, 65, (3, 4, 3, 2)).astype(np.float32)
    confidence = random.uniform(0.2, 1, (3, 4, 3)).astype(np.float32)
    confidence[1, 1] = confidence[2, :, 1] = confidence[:, 3] = 0
    present = confidence.any(-1)
    box = box_of_keypoints(points, confidence > 0)
    occluded = np.zeros((3, 4, 3), bool)
    occluded[0, 0, 2] = True
    return Observations(
        track_id=np.array([4, 7, 9]),
        frame_index=np.array(FRAMES),
        present=present,
        keypoints_px=points,
        confidence=confidence,
        box_px=np.where(present[..., None], box, 0),
        image_size_px=np.tile(SIZE, (4, 1)),
        file_name=np.array([f"clip_{frame:06d}.png" for frame in FRAMES]),
        keypoint_names=NAMES,
        skeleton=((0, 1), (0, 2)),
        masks={(0, 0): encode_mask(np.ones(SIZE[::-1], bool))},
        occluded=occluded,
        score=np.where(present, 0.75, 0),
    )


def write_label_file(kind, observations, folder):
    """Write a file of labels of a kind of `KINDS` and return its path."""
    pictures = observations.file_name.tolist()
    if kind == "coco":
        write_coco(observations, folder / "coco.json")
        return folder / "coco.json"
    if kind == "cvat":
        write_cvat(observations, folder / "cvat.json")
        return folder / "cvat.json"
    if kind == "label studio":
        urls = [f"/data/local-files/?d=images/{picture}" for picture in pictures]
        write_label_studio(observations, urls, folder / "tasks.json", folder / "config.xml")
        return folder / "tasks.json"
    if kind == "sleap":
        write_sleap_project(observations, [f"/films/images/{picture}" for picture in pictures], folder / "labels.slp")
        return folder / "labels.slp"
    write_deeplabcut_labels(observations, pictures, folder)
    return folder / f"CollectedData_jaxfit.{kind.removeprefix('deeplabcut ')}"


KINDS = ("coco", "cvat", "label studio", "sleap", "deeplabcut csv", "deeplabcut h5")
