"""Observations of birds that are rectangles, so that a hand computes every overlap."""

import numpy as np

from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations

WIDTH, HEIGHT = 120, 100


def rectangle(x, y, w, h):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y : y + h, x : x + w] = True
    return encode_mask(mask)


def birds(tracks, frames, visible=None, masks=True, names=("bill", "tail"), **changes):
    """Tracks of whole rectangles.

    Args:
        tracks: track → frame's number → x, y, width, height.
        frames: the frames' numbers.
        visible: (track, frame) → the part that is to be seen, None for nothing; the rest stands for whole birds.
        masks: whether there are any.
    """
    N, T, K = len(tracks), len(frames), len(names)
    present, box, seen, whole = np.zeros((N, T), bool), np.zeros((N, T, 4)), {}, {}
    for n, (track, boxes) in enumerate(tracks.items()):
        for frame, corners in boxes.items():
            t = list(frames).index(frame)
            present[n, t], box[n, t] = True, corners
            part = (visible or {}).get((track, frame), corners)
            if masks and part is not None:
                seen[n, t] = rectangle(*part)
            if masks and visible is not None:
                whole[n, t] = rectangle(*corners)
    # the first keypoint lies in the upper left corner, the last in the lower right one
    share = np.linspace(0, 1, K)[:, None]
    values = {
        "track_id": np.array(list(tracks), int),
        "frame_index": np.array(frames, int),
        "present": present,
        "keypoints_px": box[:, :, None, :2] + share * box[:, :, None, 2:],
        "confidence": np.repeat(present[..., None], K, -1).astype(np.float32),
        "box_px": box,
        "image_size_px": np.full((T, 2), [WIDTH, HEIGHT]),
        "file_name": np.array([f"{frame}.png" for frame in frames]),
        "keypoint_names": names,
        "masks": seen,
        "amodal_masks": whole,
    }
    return Observations(**values | changes)


def steady(box, frames):
    """One place over many frames."""
    return dict.fromkeys(frames, box)
