"""Files for CVAT: birds as `COCO Keypoints 1.0`, and the skeleton label that a task needs.

CVAT imports skeletons only where every annotation has the key `segmentation`, and takes a mask of a skeleton for an
error, so the masks are left out. The attribute `bird` of a skeleton holds the track id: CVAT keeps the attributes that
its label declares. `coco_exports` reads the file that CVAT exports.

Source: https://docs.cvat.ai/docs/dataset_management/formats/format-coco-keypoints; Datumaro's reader of COCO.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from jaxfit.data.observations import Observations
from jaxfit.foundation.files import write_whole

_BIRD, _TRACK = "bird", "bird"
"""Names of the label and of its attribute."""


def write_cvat(observations: Observations, path: str | Path) -> None:
    """Write observations for the import `COCO Keypoints 1.0` of CVAT.

    Args:
        observations: the birds; `file_name` holds the names of the pictures of the task.
        path: JSON file to write.

    Raises:
        InputError: the file cannot be written.
    """
    names, sizes = observations.file_name.tolist(), observations.image_size_px.tolist()
    images = [
        {"id": t, "width": width, "height": height, "file_name": name}
        for t, (name, (width, height)) in enumerate(zip(names, sizes, strict=True), 1)
    ]
    hidden = cast(np.ndarray, observations.occluded)
    annotations = []
    for n, t in np.argwhere(observations.present).tolist():
        points = np.zeros((observations.num_keypoints, 3))
        points[:, :2] = observations.keypoints_px[n, t]
        points[:, 2] = np.where(observations.confidence[n, t] > 0, np.where(hidden[n, t], 1, 2), 0)
        box = observations.box_px[n, t].astype(np.float64).tolist()
        bird = {"id": len(annotations) + 1, "image_id": t + 1, "category_id": 1, "iscrowd": 0, "segmentation": []}
        bird |= {"bbox": box, "area": box[2] * box[3], "num_keypoints": int((points[:, 2] > 0).sum())}
        attributes = {_TRACK: str(observations.track_id[n])}
        annotations.append(bird | {"keypoints": points.reshape(-1).tolist(), "attributes": attributes})
    skeleton = [[a + 1, b + 1] for a, b in observations.skeleton]
    category = {"id": 1, "name": _BIRD, "supercategory": "", "skeleton": skeleton}
    content = {"images": images, "categories": [category | {"keypoints": list(observations.keypoint_names)}]}
    write_whole(path, json.dumps(content | {"annotations": annotations}, allow_nan=False).encode())


def write_cvat_label(observations: Observations, path: str | Path) -> None:
    """Write the skeleton label of a task, for the tab `Raw` of CVAT's constructor of labels.

    The drawing of the skeleton, which CVAT places for a new bird, is the bird with the most confident keypoints.

    Args:
        observations: birds with the keypoints of the task.
        path: JSON file to write.

    Raises:
        InputError: the file cannot be written.
    """
    places = _template(observations)
    names = observations.keypoint_names
    lines = [
        f'<line x1="{places[a, 0]:.2f}" y1="{places[a, 1]:.2f}" x2="{places[b, 0]:.2f}" y2="{places[b, 1]:.2f}" '
        f'data-type="edge" data-node-from="{a + 1}" data-node-to="{b + 1}"></line>'
        for a, b in observations.skeleton
    ]
    circles = [
        f'<circle r="0.75" cx="{x:.2f}" cy="{y:.2f}" data-type="element node" data-element-id="{k}" '
        f'data-node-id="{k}" data-label-name={quoteattr(name)}></circle>'
        for k, (name, (x, y)) in enumerate(zip(names, places.tolist(), strict=True), 1)
    ]
    track = {"name": _TRACK, "input_type": "text", "mutable": False, "default_value": "", "values": [""]}
    parts: list[dict[str, Any]] = [{"name": name, "type": "points", "attributes": []} for name in names]
    label = {"name": _BIRD, "type": "skeleton", "attributes": [track], "sublabels": parts}
    write_whole(path, json.dumps([label | {"svg": "".join(lines + circles)}], indent=1).encode())


def _template(observations: Observations) -> Float[np.ndarray, "K 2"]:
    """Return positions in a square of side 100: those of the most confident bird, others on a circle."""
    angle = 2 * np.pi * np.arange(observations.num_keypoints) / max(observations.num_keypoints, 1)
    places = 50 + 40 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if not observations.present.any():
        return places
    total = observations.confidence.sum(-1)
    n, t = np.unravel_index(int(total.argmax()), total.shape)
    known = observations.confidence[n, t] > 0
    points = observations.keypoints_px[n, t].astype(np.float64)
    if known.any():
        low, extent = points[known].min(0), np.ptp(points[known], axis=0).max()
        places[known] = 10 + 80 * (points[known] - low) / max(extent, 1e-6)
    return places
