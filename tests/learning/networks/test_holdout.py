"""The held-out part of labelled pictures."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.label_data import GAP_FRAMES, split_pictures
from jaxfit.learning.networks.labels import LabelledBird, LabelledPicture

BIRD = LabelledBird("bird 1", np.ones(4), np.ones((1, 2)), np.full(1, 2), None)


def pictures(*videos):
    return [
        LabelledPicture(Path(f"{v}.json"), f"{t}.png", t, (9, 9), (BIRD,))
        for v, video in enumerate(videos)
        for t in video
    ]


@pytest.mark.parametrize("times", [range(0, 40, 4), range(200), range(0, 20_000, 100)])
def test_blocks_of_time(times):
    labels = pictures(times)
    split = split_pictures(labels, 0.2)
    parts = split.training + split.holdout + split.gap
    assert sorted(parts) == list(range(len(labels)))
    assert len(split.holdout) == pytest.approx(0.2 * len(labels), abs=1)
    # held-out pictures are few runs of consecutive labels
    assert (np.diff(split.holdout) > 1).sum() < max(1, len(labels) / 40)
    nearest = min(abs(labels[i].frame - labels[j].frame) for i in split.training for j in split.holdout)
    step = times[1] - times[0]
    assert nearest >= min(GAP_FRAMES, 2 * step)
    assert nearest > step or step >= GAP_FRAMES


def test_whole_videos():
    split = split_pictures(pictures(range(10), range(30), range(12)), 0.2)
    assert split.holdout == list(range(10))
    assert "by video" in split.rule
    assert not split.gap
    halves = split_pictures(pictures(range(0, 900, 30), range(0, 900, 30)), 0.2)  # half of the labels is too much
    assert "blocks of time" in halves.rule


def test_too_few_pictures():
    with pytest.raises(InputError, match="--holdout 0"):
        split_pictures(pictures([5]), 0.2)
    assert split_pictures(pictures([5]), 0).training == [0]
