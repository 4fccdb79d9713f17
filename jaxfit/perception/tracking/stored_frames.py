"""Recorded frames as arrays, so that an interrupted tracking continues after the last stored frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfit.perception.detections import Distances
from jaxfit.perception.instances import Instance
from jaxfit.perception.tracking.recorder import RecordedFrame
from jaxfit.perception.tracking.tracker import Tracker
from jaxfit.storage.parts import Parts

__all__ = ["FRAMES_PER_PART", "FramePart", "load_frames", "replay", "store_frames"]

FRAMES_PER_PART = 50
"""Frames between two writes. An interruption costs at most the work on so many frames."""

_LAYOUT = {
    "frame_index": "F",
    "file_name": "F",
    "size_px": "F 2",
    "time_s": "F",
    "birds": "F",  # number of instances of each frame
    "box_px": "M 4",
    "score": "M",
    "identity": "M",
    "mask_length": "m",
    "masks": "bytes",
    "keypoints_px": "m K 2",
    "confidence": "m K",
    "damaged": "D",
    "segmenter_distance": "S",
    "keypoint_distance": "P",
    "is_last": "",
}


class FramePart(NamedTuple):
    """Consecutive frames of a video, as the networks and the tracker processed them."""

    frames: list[RecordedFrame]
    damaged: list[int]
    """Numbers of the damaged frames among these frames."""
    distances: Distances
    is_last: bool
    """Whether the video ends with these frames."""


def store_frames(parts: Parts, part: FramePart, num_keypoints: int) -> None:
    """Store frames as the next part.

    Raises:
        InputError: as `Parts.add`.
    """
    frames = part.frames
    counts = [mask["counts"] for frame in frames for mask in frame.masks]

    def joined(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape), dtype), *(getattr(frame, name) for frame in frames)])

    parts.add(
        {
            "frame_index": np.array([frame.frame_index for frame in frames], np.int64),
            "file_name": np.array([frame.file_name for frame in frames] or np.zeros(0, "U1")),
            "size_px": np.array([frame.size_px for frame in frames], np.int64).reshape(-1, 2),
            "time_s": np.array([frame.time_s for frame in frames], np.float64),
            "birds": np.array([len(frame.score) for frame in frames], np.int64),
            "box_px": joined("box_px", (4,), np.float32),
            "score": joined("score", (), np.float64),
            "identity": joined("identity", (), np.int64),
            "mask_length": np.array([len(each) for each in counts], np.int64),
            "masks": np.frombuffer(b"".join(counts), np.uint8),
            "keypoints_px": joined("keypoints_px", (num_keypoints, 2), np.float32),
            "confidence": joined("confidence", (num_keypoints,), np.float32),
            "damaged": np.array(part.damaged, np.int64),
            "segmenter_distance": part.distances[0],
            "keypoint_distance": part.distances[1],
            "is_last": np.array(part.is_last),
        }
    )


def load_frames(parts: Parts, number: int) -> FramePart:
    """Return the frames of a part.

    Raises:
        InputError: the file is damaged.
    """
    arrays = parts.load(number, _LAYOUT)
    tracked = arrays["identity"] > 0
    ends = np.cumsum(arrays["birds"])
    is_whole = (arrays["birds"] >= 0).all() and (ends[-1] if len(ends) else 0) == len(tracked)
    is_whole &= len(arrays["mask_length"]) == tracked.sum() and (arrays["mask_length"] >= 0).all()
    if not is_whole or arrays["mask_length"].sum() != len(arrays["masks"]):
        raise parts.damaged(number, "holds frames whose numbers of birds do not agree")
    mask_ends, text = np.cumsum(arrays["mask_length"]), arrays["masks"].tobytes()
    first_tracked = np.concatenate([[0], np.cumsum(tracked)])
    frames = []
    for f, end in enumerate(ends.tolist()):
        birds = slice(end - int(arrays["birds"][f]), end)
        own = slice(int(first_tracked[birds.start]), int(first_tracked[end]))
        width, height = arrays["size_px"][f].tolist()
        masks = tuple(
            {"size": [height, width], "counts": text[int(mask_ends[m] - arrays["mask_length"][m]) : int(mask_ends[m])]}
            for m in range(own.start, own.stop)
        )
        frames.append(
            RecordedFrame(
                int(arrays["frame_index"][f]),
                str(arrays["file_name"][f]),
                (width, height),
                float(arrays["time_s"][f]),
                arrays["box_px"][birds],
                arrays["score"][birds],
                arrays["identity"][birds],
                masks,
                arrays["keypoints_px"][own],
                arrays["confidence"][own],
            )
        )
    distances = arrays["segmenter_distance"], arrays["keypoint_distance"]
    return FramePart(frames, arrays["damaged"].tolist(), distances, bool(arrays["is_last"]))


def replay(tracker: Tracker, frames: Sequence[RecordedFrame]) -> bool:
    """Bring a new tracker into its state after some frames; return whether it gives the recorded identities.

    The masks of the instances are rectangles: trackers see the boxes and scores only.
    """
    for frame in frames:
        instances = [
            Instance(np.broadcast_to(True, (h, w)), x, y, score, "bird")
            for (x, y, w, h), score in zip(frame.box_px.astype(int).tolist(), frame.score.tolist(), strict=True)
        ]
        identities = tracker.update(frame.frame_index, instances)
        if [identity or 0 for identity in identities] != frame.identity.tolist():
            return False
    return True
