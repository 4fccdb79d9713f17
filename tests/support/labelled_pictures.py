"""Small labelled pictures for the tests of training on labels."""

import json
from pathlib import Path

import cv2
import numpy as np

SIZE = 160, 120
"""Width and height of the pictures."""


def square(x: int, y: int, side: int = 30) -> list[int]:
    """Return the polygon of a square."""
    return [x, y, x + side, y, x + side, y + side, x, y + side]


def coco(frames: dict[int, list[dict]], keypoints: list[str] | None = None) -> dict:
    """Return a COCO file with the birds of each frame; pictures are named by their frames."""
    width, height = SIZE
    images = [
        {"id": t, "width": width, "height": height, "file_name": f"frame_{t:04d}.png", "frame_index": t} for t in frames
    ]
    annotations = []
    for t, birds in frames.items():
        for n, bird in enumerate(birds, 1):
            annotation = {"id": len(annotations) + 1, "image_id": t, "category_id": 1, "track_id": n, "iscrowd": 0}
            annotations.append(annotation | bird)
    category: dict = {"id": 1, "name": "bird"}
    if keypoints is not None:
        category["keypoints"] = keypoints
    return {"images": images, "categories": [category], "annotations": annotations}


def bird(x: int = 40, y: int = 30, side: int = 30, **other) -> dict:
    """Return the annotation of a square bird without keypoints."""
    return {"bbox": [x, y, side, side], "segmentation": [square(x, y, side)]} | other


def write_labels(folder: Path, content: dict, pictures: list[int], name: str = "labels.json") -> Path:
    """Write a COCO file, and grey pictures with white squares for some of its frames."""
    folder.mkdir(exist_ok=True, parents=True)
    for t in pictures:
        picture = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
        for annotation in content["annotations"]:
            if annotation["image_id"] == t:
                x, y, width, height = (int(value) for value in annotation["bbox"])
                picture[max(y, 0) : y + height, max(x, 0) : x + width] = 250
        cv2.imwrite(str(folder / f"frame_{t:04d}.png"), picture)
    (folder / name).write_text(json.dumps(content))
    return folder / name
