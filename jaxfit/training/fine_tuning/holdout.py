"""Division of labelled pictures into a training part and a held-out part, by video or by blocks of time.

Neighbouring frames of a video are almost equal. A network that has seen one of two neighbours knows the other, so a
held-out part of random frames would measure memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from jaxfit.errors import InputError
from jaxfit.training.fine_tuning.labels import LabelledPicture

__all__ = ["Split", "split_pictures"]

GAP_FRAMES = 25
"""Pictures that are nearer to a held-out picture of their video, in frames, belong to neither part."""
MOST_GAP = 0.1
"""Largest share of a video's pictures in the gap at a border of a held-out block; at least one picture."""
PICTURES_PER_BLOCK = 50
"""Number of labelled pictures of a video for each held-out block of time."""
MOST_HELD_OUT = 0.4
"""Largest share of the pictures that are held out as whole videos."""


class Split(NamedTuple):
    """Positions of the pictures of each part; the pictures in the gaps are in no part."""

    training: list[int]
    holdout: list[int]
    gap: list[int]
    rule: str
    """How the pictures were divided, for people."""


def split_pictures(pictures: Sequence[LabelledPicture], share: float) -> Split:
    """Hold out whole videos if there are several, or else blocks of consecutive labelled pictures.

    Every label file is a video. Whole videos are held out if this keeps at least `1 − MOST_HELD_OUT` of the pictures
    for the training. Otherwise, the last part of every video, or of every block of `PICTURES_PER_BLOCK` labelled
    pictures, is held out. Pictures at the borders of a held-out block belong to neither part if they are nearer than
    `GAP_FRAMES`.

    Args:
        pictures: usable pictures, by file, and in the order of time in each file.
        share: share of the pictures to hold out; 0 holds out nothing.

    Raises:
        InputError: too few pictures for both parts.
    """
    everything = list(range(len(pictures)))
    if share == 0:
        return Split(everything, [], [], "nothing is held out")
    videos = [list(group) for _, group in groupby(everything, key=lambda i: pictures[i].source)]
    split = _by_video(pictures, videos, share) or _by_time(pictures, videos, share)
    with_birds = [any(pictures[i].birds for i in part) for part in (split.training, split.holdout)]
    if not all(with_birds):
        part = "hold-out" if with_birds[0] else "training part"
        problem = f"the {part} has no bird: there are {len(pictures)} usable labelled pictures"
        remedy = "label more pictures, of other times; or give --holdout 0 to train without a check of the result"
        raise InputError("train: labels", problem, remedy)
    return split


def _by_video(pictures: Sequence[LabelledPicture], videos: list[list[int]], share: float) -> Split | None:
    """Hold out videos, smallest first, until at least half the share is reached; None if that takes too many."""
    if len(videos) < 2:
        return None
    held: list[list[int]] = []
    for video in sorted(videos, key=len):
        if sum(map(len, held)) >= 0.5 * share * len(pictures):
            break
        held.append(video)
    holdout = sorted(i for video in held for i in video)
    if len(holdout) > MOST_HELD_OUT * len(pictures):
        return None
    names = ", ".join(pictures[video[0]].source.name for video in held)
    training = [i for i in range(len(pictures)) if i not in set(holdout)]
    return Split(training, holdout, [], f"held out by video: {names}")


def _by_time(pictures: Sequence[LabelledPicture], videos: list[list[int]], share: float) -> Split:
    training: list[int] = []
    holdout: list[int] = []
    gap: list[int] = []
    for video in videos:
        blocks = max(1, round(len(video) / PICTURES_PER_BLOCK))
        for block in np.array_split(video, blocks):
            count = round(share * len(block)) or (len(block) > 1)
            holdout += block[len(block) - count :].tolist()
        held = set(holdout) & set(video)
        reach = max(1, round(MOST_GAP * len(video)))
        for place, i in enumerate(video):
            if i in held:
                continue
            near = [j for j in video[max(place - reach, 0) : place + reach + 1] if j in held]
            close = any(abs(pictures[j].frame - pictures[i].frame) < GAP_FRAMES for j in near)
            (gap if close else training).append(i)
    return Split(training, holdout, gap, "held out by blocks of time")
