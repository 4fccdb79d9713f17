"""The folder of suggested frames: pictures, and their pre-filled labels in the formats of labelling programs."""

from __future__ import annotations

import csv
import io
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.cvat import write_cvat, write_cvat_label
from jaxfit.data.formats.deeplabcut.labels import write_deeplabcut_labels
from jaxfit.data.formats.label_studio import write_label_studio
from jaxfit.data.formats.sleap.write_project import write_sleap_project
from jaxfit.data.observations import Observations
from jaxfit.errors import one_line
from jaxfit.storage.files import write_whole

__all__ = ["IMAGES", "MARKER", "picture_name", "write_labels", "write_list"]

IMAGES, MARKER = "images", "suggested.csv"
_DEEPLABCUT = Path("deeplabcut") / "labeled-data"

_README = """Frames of {video} to label, suggested by jaxfit.

images/        the {count} pictures; the number at the end of a name is the number of the frame
suggested.csv  why every frame was suggested
coco.json      the labels that jaxfit detected, with masks and confidences

Correct the labels in ONE of these programs. Move wrong keypoints, remove keypoints that cannot be placed,
add missing birds, and remove detections that are no birds.

CVAT
  1. Create a task. Paste the content of cvat_labels.json into the tab "Raw" of the labels. Add images/.
  2. Upload annotations: format "COCO Keypoints 1.0", file cvat.json.
  3. After the correction, export in the format "COCO Keypoints 1.0" and unpack the archive.
     The attribute "bird" is the number of the bird. Give a new bird a new number.
  4. jaxfit import person_keypoints_default.json --masks {out}/coco.json --out corrected.json

Label Studio
  1. Start Label Studio with LABEL_STUDIO_LOCAL_FILES_SERVING_ENABLED=true and
     LABEL_STUDIO_LOCAL_FILES_DOCUMENT_ROOT={out}
  2. Create a project. Paste label_studio.xml into the code of the labelling interface.
     Add a source storage of local files: {out}/images
  3. Import label_studio.json. A new bird is a rectangle with key points inside.
  4. After the correction, export as JSON (not as COCO, which rounds positions to whole pixels).
  5. jaxfit import export.json --masks {out}/coco.json --out corrected.json

DeepLabCut
  1. Copy deeplabcut/labeled-data/{folder} into the folder labeled-data of a project for several animals,
     whose scorer is "{scorer}" and whose individuals are: {birds}.
     For another scorer, rename the files and run deeplabcut.convertcsv2h5.
  2. Open the folder in the labelling tool, and correct and save the labels.
  3. jaxfit import CollectedData_{scorer}.h5 --masks {out}/coco.json --out corrected.json

SLEAP
  1. Open labels.slp. A double click turns a prediction into a label that can be corrected.
     The tab "Labeling Suggestions" lists all frames.
  2. Save the project.
  3. jaxfit import labels.slp --masks {out}/coco.json --out corrected.json
     labels.slp holds the absolute paths of the pictures. SLEAP asks for a picture that was moved.

The pictures of the folder deeplabcut are the files of images/ under a second name (hard links), where the disk
allows it. coco.json can be corrected by a program of your own, too.
"""


def picture_name(video: Path, number: int) -> str:
    """Return the file name of the picture of a frame, from which `picture_names.frame_numbers` reads the number."""
    return f"{_stem(video)}_{number:06d}.png"


def _stem(video: Path) -> str:
    """Return the name of a video with the characters that all labelling programs accept in file names."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", one_line(video.stem))[:100].strip("_") or "video"


def write_labels(observations: Observations, video: Path, folder: Path, final: Path, scorer: str = "jaxfit") -> None:
    """Write the labels of all formats into a folder that holds the pictures of the frames in `images/`.

    Args:
        observations: the birds of the suggested frames.
        video: the video, for names.
        folder: the folder, which may have a temporary name.
        final: the absolute path that the folder will have.
        scorer: name of the labelling person or program in DeepLabCut.

    Raises:
        InputError: the extra `formats` is not installed, or a file cannot be written.
    """
    pictures = [picture_name(video, number) for number in observations.frame_index.tolist()]
    named = replace(observations, file_name=np.array(pictures, str))
    write_coco(named, folder / "coco.json", {"description": f"frames of {one_line(video.name)} to label"})
    write_cvat(named, folder / "cvat.json")
    write_cvat_label(named, folder / "cvat_labels.json")
    urls = [f"/data/local-files/?d={quote(f'{IMAGES}/{picture}')}" for picture in pictures]
    write_label_studio(named, urls, folder / "label_studio.json", folder / "label_studio.xml")
    write_sleap_project(named, [str(final / IMAGES / picture) for picture in pictures], folder / "labels.slp")
    deeplabcut = folder / _DEEPLABCUT / _stem(video)
    deeplabcut.mkdir(parents=True)
    for picture in pictures:
        _link(folder / IMAGES / picture, deeplabcut / picture)
    write_deeplabcut_labels(named, pictures, deeplabcut, scorer)
    birds = ", ".join(f"bird{track}" for track in named.track_id[named.present.any(1)].tolist()) or "none"
    facts = {"video": one_line(video.name), "count": len(pictures), "out": one_line(final), "birds": birds}
    write_whole(folder / "README.txt", _README.format(**facts, folder=_stem(video), scorer=scorer).encode())


def write_list(rows: list[tuple], path: Path) -> None:
    """Write the table of suggested frames: frame, time in seconds, picture, birds, reason, score."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "time_s", "picture", "birds", "reason", "score"))
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def _link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy the file where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
