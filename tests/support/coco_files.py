"""Small COCO files for the tests, as Python values that a test can break."""

import json

import numpy as np

from jaxfit.data.masks import encode_mask

MASK = np.zeros((20, 30), bool)
MASK[4:12, 5:25] = True


def compressed(mask):
    rle = encode_mask(mask)
    return {"size": list(rle["size"]), "counts": rle["counts"].decode()}


def uncompressed(mask):
    flat = np.concatenate([[False], mask.T.reshape(-1)])
    ends = np.append(np.flatnonzero(np.diff(flat)), mask.size)
    return {"size": list(mask.shape), "counts": np.diff(np.append(0, ends)).tolist()}


def annotation(i, image, track, **changes):
    keypoints = [10, 5, 2, 20.5, 6.25, 1, 0, 0, 0]
    basic = {"id": i, "image_id": image, "category_id": 1, "track_id": track, "bbox": [5, 4, 20, 8]}
    return basic | {"keypoints": keypoints, "segmentation": compressed(MASK)} | changes


def content():
    """Two birds over three frames, given out of order; the second is missing in the last."""
    images = [
        {"id": 7, "width": 30, "height": 20, "file_name": "c.png", "frame_index": 12, "extra": None},
        {"id": 5, "width": 30, "height": 20, "file_name": "a.png", "frame_index": 3},
        {"id": 6, "width": 30, "height": 20, "file_name": "b.png", "frame_index": 4},
    ]
    category = {"id": 1, "name": "bird", "keypoints": ["bill", "nape", "tail"], "skeleton": [[1, 2], [2, 3]]}
    annotations = [
        annotation(1, 6, 2),
        annotation(2, 5, 2, keypoint_scores=[0.75, 0, 0.5]),
        annotation(3, 7, 2, segmentation=None),
        annotation(4, 5, 0, segmentation=uncompressed(~MASK)),
        annotation(5, 6, 0, segmentation=[[5, 4, 25, 4, 25, 12, 5, 12]], keypoints=[0] * 9),
    ]
    return {"info": {}, "images": images, "categories": [category], "annotations": annotations}


def saved(tmp_path, data):
    path = tmp_path / "birds.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path
