"""Keypoints that a person places, hides, exchanges or accepts in single frames, and their form as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool

from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.observations import FROM_LABEL, Observations
from jaxfit.foundation.errors import InputError

POINT_EXAMPLES = {
    "place": "3@120 bill_tip 812.4,300.1",
    "hide": "3@120 bill_tip",
    "mirror": "3@120",
    "accept": "3@120",
}
"""Kind of a point → example of its track, frame, keypoint and position."""
_NUMBER = r"-?[0-9]{1,7}(?:\.[0-9]{1,9})?"
_FORM = re.compile(rf"([a-z]+) ([0-9]{{1,18}})@([0-9]{{1,18}})(?: (\S.*?))?(?: ({_NUMBER}),({_NUMBER}))?")


class Point(NamedTuple):
    """What a person says about keypoints of one bird in one frame; a label of confidence 1."""

    kind: str
    """`place`: the keypoint is at `at_px`. `hide`: the keypoint cannot be seen. `mirror`: left and right are exchanged.
    `accept`: all detected keypoints of the bird are right."""
    track: int
    """The track of the result, before any edit of tracks."""
    frame: int
    """Number of the frame."""
    keypoint: str = ""
    """Name of the keypoint that is placed or hidden."""
    at_px: tuple[float, float] | None = None
    """x, y of a placed keypoint, image pixels."""

    def __str__(self) -> str:
        """Return the point as text, the form that `parse_point` reads."""
        at = "" if self.at_px is None else f"{self.at_px[0]:.9g},{self.at_px[1]:.9g}"
        return " ".join(filter(None, (self.kind, f"{self.track}@{self.frame}", self.keypoint, at)))


def parse_point(text: str, source: object) -> Point:
    """Return a point from its form as text, for example ``place 3@120 bill_tip 812.4,300.1`` or ``mirror 3@120``.

    Args:
        text: kind, track, frame, name of the keypoint, and position in image pixels.
        source: the file, for messages.

    Raises:
        InputError: the text has another form.
    """
    match = _FORM.fullmatch(text)
    kind = text.partition(" ")[0]
    needed = {"place": (True, True), "hide": (True, False)}.get(kind, (False, False))
    if match is None or (match[4] is not None, match[5] is not None) != needed:
        raise InputError(source, f"'{text}' is not a correction", f"write for example {kind} {POINT_EXAMPLES[kind]}")
    at_px = (float(match[5]), float(match[6])) if needed[1] else None
    return Point(kind, int(match[2]), int(match[3]), match[4] or "", at_px)


def with_points(
    observations: Observations, points: Sequence[Point], source: object
) -> tuple[Observations, Bool[np.ndarray, "N T K"]]:
    """Return observations with the keypoints of a person, and which keypoints the person has placed or accepted.

    Placed keypoints have confidence 1, and the box grows to hold them. Their birds have the origin `FROM_LABEL`.

    Raises:
        InputError: a bird or keypoint is not there, or a position is outside the picture.
    """
    names = observations.keypoint_names
    keypoints, confidence = observations.keypoints_px.copy(), observations.confidence.copy()
    occluded, origin, box = (
        cast(np.ndarray, getattr(observations, name)).copy() for name in ("occluded", "keypoint_origin", "box_px")
    )
    labelled = np.zeros(confidence.shape, bool)
    opposite = np.array(opposite_keypoints(names))
    exchanged = np.where(opposite >= 0, opposite, np.arange(len(names)))
    rows, columns = ({int(v): i for i, v in enumerate(a)} for a in (observations.track_id, observations.frame_index))
    for point in points:
        cell = rows.get(point.track, -1), columns.get(point.frame, -1)
        if min(cell) < 0 or not observations.present[cell]:
            remedy = "name a track of the result and a frame in which the bird is detected"
            raise InputError(source, f"{point}: bird {point.track} is not in frame {point.frame}", remedy)
        if point.keypoint and point.keypoint not in names:
            raise InputError(source, f"{point}: there is no such keypoint", f"its keypoints are {', '.join(names)}")
        if point.kind == "mirror":
            for array in (keypoints, confidence, occluded, labelled):
                array[cell] = array[cell][exchanged]
        elif point.kind == "accept":
            labelled[cell] = confidence[cell] > 0
            confidence[cell] = labelled[cell]
        else:
            k = names.index(point.keypoint)
            is_placed = point.at_px is not None
            labelled[cell][k], confidence[cell][k], occluded[cell][k] = is_placed, float(is_placed), False
            keypoints[cell][k] = point.at_px or 0
            if point.at_px is not None:
                at, size = np.array(point.at_px), np.array(observations.image_size(*cell))
                if (at < 0).any() or (at > size).any():
                    problem = f"{point}: is outside the picture of {size[0]}×{size[1]} pixels"
                    raise InputError(source, problem, "hide a keypoint that the picture does not show")
                low, high = np.minimum(box[cell][:2], at), np.maximum(box[cell][:2] + box[cell][2:], at)
                box[cell] = [*low, *(high - low)]
        origin[cell] = FROM_LABEL
    arrays: dict[str, Any] = {"occluded": occluded, "keypoint_origin": origin, "box_px": box}
    return replace(observations, **arrays).with_keypoints(keypoints, confidence), labelled
