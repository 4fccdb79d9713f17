"""Masks of consecutive frames from a few key frames, which a slow segmenter segments.

Optical flow carries each bird of the key frames to the other frames. Masks of different key frames that overlap there
are votes for one bird. Where votes of earlier and later key frames agree, the mask has the pixels of most votes, so an
error of the segmenter in one key frame stays there, and a bird that it misses there is not lost. Where they do not
agree, or a bird has a single vote, the flow or the segmenter is wrong, or the bird came or left: of these frames, the
one farthest from all key frames becomes a key frame too. So birds that flow cannot follow are segmented in every frame.

The flow of a bird is computed in a crop around it at a size of its own, so large and small birds have equal errors.

Source: Kroeger et al. 2016, *Fast Optical Flow using Dense Inverse Search*; the votes are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfit.perception.merging import MIN_SAME_IOU, mask_iou, smaller_inside
from jaxfit.perception.network import Instance, instance_of
from jaxfit.perception.segmentation_inputs import enlarge

BLOCK_FRAMES = 15
"""Frames that share key frames. In longer blocks, the flow would need as much time as the segmenter."""
VOTES = 3
"""Number of the first key frames of a block, and largest number of votes for a mask: the smallest number of which most
can agree."""
AGREED_IOU = 0.85
"""Votes with a larger IoU agree: as much as the masks that several people draw, 0.85 to 0.91 (Kirillov et al. 2023)."""
MIN_INSIDE = 0.5
"""Votes are for the same bird if a larger share of the smaller mask lies in the other."""
MARGIN = 0.5
"""Margin on each side of the crop around a bird, as a share of the sides of its box."""
CROP_PX = 480
"""Longer side of a crop. The flow has a vector for every fourth pixel."""
_LEAST_PX = 64  # of the shorter side of a crop: the flow is computed in patches, and OpenCV 4 crashes at 24 pixels


_Source = tuple[int, int]
"""Key frame and number of a bird that the segmenter saw."""


class _Vote(NamedTuple):
    """A bird of a key frame, carried to another frame."""

    source: _Source
    bird: Instance

    @property
    def key(self) -> int:
        return self.source[0]


class _Tally(NamedTuple):
    """The result of the votes in a frame."""

    birds: list[Instance]
    sources: list[set[_Source]]
    """For each bird, the sources of all votes at its place."""
    is_open: bool
    """Whether the votes at another place do not agree."""


def segment_block(
    segment: Callable[[np.ndarray, Sequence[Instance]], list[Instance]], frames: Sequence[UInt8[np.ndarray, "H W 3"]]
) -> list[list[Instance]]:
    """Segment consecutive frames of a film.

    Args:
        segment: function of a frame and its known birds; it returns only the other birds.
        frames: at most `BLOCK_FRAMES` frames of the same size; blue, green, red.

    Returns:
        The birds of each frame, by falling score.
    """
    greys = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]
    num_frames = len(frames)
    votes: list[list[_Vote]] = [[] for _ in frames]
    added = sorted({(2 * part + 1) * num_frames // (2 * VOTES) for part in range(VOTES)})  # the middles of equal parts
    known = dict.fromkeys(added, _Tally([], [], False))  # key frame → result of the votes before
    while True:
        for key in added:
            for number, bird in enumerate(segment(frames[key], known[key].birds)):
                for n, mask in enumerate(_carried(bird, key, greys)):
                    if mask is not None:
                        votes[n].append(_Vote((key, number), mask))
        tallies = _tally_block(votes, known)
        open_frames = [n for n in range(num_frames) if tallies[n].is_open and n not in known]
        if not open_frames:
            return [sorted(of_frame.birds, key=lambda bird: -bird.score) for of_frame in tallies]
        added = [max(open_frames, key=lambda n: min(abs(n - key) for key in known))]
        known |= {key: tallies[key] for key in added}


def _tally_block(votes: Sequence[Sequence[_Vote]], known: Mapping[int, _Tally]) -> list[_Tally]:
    """Count the votes of all frames. A bird is not carried beyond a key frame in which it is not.

    Args:
        votes: the votes in each frame.
        known: key frame → birds that the segmenter was not asked for.
    """
    at_keys = {key: _tally_frame(key, votes[key], known) for key in known}

    def reaches(vote: _Vote, n: int) -> bool:
        between = (key for key in known if min(vote.key, n) < key < max(vote.key, n))
        return all(any(vote.source in sources for sources in at_keys[key].sources) for key in between)

    tallies = list[_Tally]()
    for n, of_frame in enumerate(votes):
        if n in at_keys:
            tallies.append(at_keys[n])
            continue
        reaching = [vote for vote in of_frame if reaches(vote, n)]
        tally = _tally_frame(n, reaching, known)
        # the segmenter may have missed a bird in the first or last key frame
        is_stopped = len(reaching) < len(of_frame) and not min(known) < n < max(known)
        tallies.append(tally._replace(is_open=tally.is_open or is_stopped))
    return tallies


def _tally_frame(n: int, votes: Sequence[_Vote], known: Mapping[int, _Tally]) -> _Tally:
    """Count the votes of a frame.

    A frame has a bird if the segmenter saw the bird in this frame, or if votes from an earlier and from a later key
    frame agree. Where the nearest key frame of a side has no vote, because there is none or because the segmenter was
    not asked for the bird, the agreeing votes may come from the other side.
    """
    groups: list[list[_Vote]] = []
    for vote in sorted(votes, key=lambda vote: abs(vote.key - n)):
        same = [_same_iou(vote, group) for group in groups]
        if any(same):
            groups[int(np.argmax(same))].append(vote)
        else:
            groups.append([vote])
    around = (
        [n] if n in known else [max(filter(n.__gt__, known), default=None), min(filter(n.__lt__, known), default=None)]
    )
    birds, places, is_open = list[Instance](), list[set[_Source]](), False
    for group in groups:
        sources = {vote.source for vote in group}
        one_side_suffices = any(
            key is None or any(sources & of_bird for of_bird in known[key].sources) for key in around
        )
        agreed = [
            vote.bird
            for vote in group
            if any(
                other is not vote
                and (one_side_suffices or (vote.key < n) != (other.key < n))
                and mask_iou(vote.bird, other.bird) > AGREED_IOU
                for other in group
            )
        ]
        if group[0].key != n and not agreed:
            is_open = True
            continue
        bird = group[0].bird if group[0].key == n else _majority(agreed[:VOTES])
        if any(mask_iou(bird, other) > MIN_SAME_IOU for other in birds):  # hidden behind the other bird
            continue
        birds.append(bird)
        places.append(sources)
    return _Tally(birds, places, is_open)


def _same_iou(vote: _Vote, group: Sequence[_Vote]) -> float:
    """Return the largest IoU with the votes of a group for the same bird; 0 if there are none.

    Votes of one key frame are for different birds, because the segmenter separated them.
    """
    if any(other.key == vote.key for other in group):
        return 0.0
    same = (other.bird for other in group if smaller_inside(vote.bird, other.bird) > MIN_INSIDE)
    return max((mask_iou(vote.bird, mask) for mask in same), default=0.0)


def _majority(masks: Sequence[Instance]) -> Instance:
    """Return the mask of the pixels of most masks, with the score of the first; of two masks, the first."""
    first = masks[0]
    if len(masks) == 2:
        return first
    corners = np.array([mask.corners_px for mask in masks]).astype(int)
    (x0, y0), (x1, y1) = corners.min(0)[:2].tolist(), corners.max(0)[2:].tolist()
    count = np.zeros((y1 - y0, x1 - x0), np.uint8)
    for mask in masks:
        height, width = mask.mask.shape
        count[mask.y0 - y0 :, mask.x0 - x0 :][:height, :width] += mask.mask
    return instance_of(2 * count > len(masks), first.score, first.label, x0, y0) or first


def _carried(bird: Instance, key: int, greys: Sequence[UInt8[np.ndarray, "H W"]]) -> list[Instance | None]:
    """Return the bird of a key frame in every frame, by the flow between the frames around it; None where it left."""
    frame_height, frame_width = greys[key].shape
    x0, y0, x1, y1 = enlarge(bird.corners_px, MARGIN, (frame_width, frame_height)).tolist()
    crop_px = (x1 - x0, y1 - y0)
    zoom = CROP_PX / max(crop_px)
    size_px = [max(round(side * zoom), _LEAST_PX) for side in crop_px]
    resizing, back = (cv2.INTER_AREA, cv2.INTER_LINEAR) if zoom < 1 else (cv2.INTER_LINEAR, cv2.INTER_AREA)

    def crop(picture: np.ndarray) -> np.ndarray:
        return cv2.resize(picture[y0:y1, x0:x1], size_px, interpolation=resizing)

    height, width = bird.mask.shape
    padded = np.zeros(crop_px[::-1], np.float32)
    padded[bird.y0 - y0 :, bird.x0 - x0 :][:height, :width] = bird.mask
    mask, here = cv2.resize(padded, size_px, interpolation=resizing), crop(greys[key])
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in size_px))
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    found: list[Instance | None] = []
    for n, grey in enumerate(greys):
        if n == key:
            found.append(bird)
            continue
        flow = method.calc(crop(grey), here, None)
        moved = cv2.remap(mask, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)
        moved = cv2.resize(moved, crop_px, interpolation=back)
        found.append(instance_of(moved > 0.5, bird.score, bird.label, x0, y0))
    return found
