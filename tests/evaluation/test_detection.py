"""Birds and keypoints found: what counts, what is ignored, and what a hand computes of it."""

import dataclasses
import math

import numpy as np
import pytest
from support.rectangles import HEIGHT, WIDTH, birds, steady

from jaxfit.data.masks import encode_mask
from jaxfit.evaluation.tracking import evaluate_observations
from jaxfit.evaluation.truth import Truth
from jaxfit.foundation.errors import InputError

HERE, THERE, AWAY = (10, 10, 20, 10), (60, 10, 20, 10), (10, 60, 20, 10)
PERFECT = pytest.approx({"ap50": 1, "ap50-95": 1, "precision": 1, "recall": 1, "mean_iou": 1})


def scores(*values):
    return np.array(values, np.float32).reshape(len(values), -1)


def test_what_was_there_is_perfect():
    """Numbers of tracks, and the order of both, mean nothing."""
    truth = birds({1: steady(HERE, range(3)), 2: steady(THERE, range(3))}, range(3))
    found = birds({7: steady(THERE, range(3)), 5: steady(HERE, range(3))}, range(3))
    result = evaluate_observations(found, truth)
    assert result.detection == PERFECT
    assert result.tracking == {**dict.fromkeys(("mota", "idf1"), 1), "switches": 0, "fragments": 0} | {
        name: pytest.approx(1) for name in ("hota", "deta", "assa")
    }
    assert result.keypoints["all"] == (12, 1, 1, 12, 1, 1)
    assert result.counts == {"frames": 3, "true": 6, "detected": 6} | dict.fromkeys(
        ("ignored", "excused", "true_elsewhere", "detected_elsewhere"), 0
    )
    assert result.compared == "masks"


def test_average_precision_by_hand(capsys):
    """Right, wrong, right by score: precision is 1 up to a recall of 0.5 (51 of 101), and 2/3 from there."""
    truth = birds({1: {0: HERE}, 2: {0: THERE}}, [0])
    found = birds({1: {0: THERE}, 2: {0: AWAY}, 3: {0: HERE}}, [0], score=scores(0.9, 0.8, 0.7))
    figures = evaluate_observations(found, truth).detection
    assert figures["ap50"] == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert figures["ap50-95"] == pytest.approx(figures["ap50"])
    assert (figures["precision"], figures["recall"], figures["mean_iou"]) == (2 / 3, 1, 1)
    first = birds({1: {0: THERE}, 2: {0: AWAY}, 3: {0: HERE}}, [0], score=scores(0.9, 0.6, 0.7))
    assert evaluate_observations(first, truth).detection["ap50"] == pytest.approx(1)  # the wrong one comes last
    assert not capsys.readouterr().out


def test_overlap_by_hand():
    """IoU 0.62 is right at 0.50, 0.55 and 0.60 of ten thresholds; 0.4 at none, and no match."""
    truth = birds({1: {0: (0, 0, 50, 20)}}, [0])
    figures = evaluate_observations(birds({1: {0: (0, 0, 31, 20)}}, [0]), truth).detection
    expected = {"ap50": 1, "ap50-95": 0.3, "precision": 1, "recall": 1, "mean_iou": 0.62}
    assert figures == pytest.approx(expected)
    figures = evaluate_observations(birds({1: {0: (0, 0, 20, 20)}}, [0]), truth).detection
    assert figures == pytest.approx({name: 0 for name in expected} | {"mean_iou": math.nan}, nan_ok=True)


def test_masks_count_not_boxes():
    """An L has the box of a full square and 3/4 of its area."""
    truth = birds({1: {0: (0, 0, 20, 20)}}, [0])
    part = birds({1: {0: (0, 0, 20, 20)}}, [0], masks=False)
    assert evaluate_observations(part, truth).compared == "boxes"
    assert evaluate_observations(truth, part).compared == "boxes"
    assert evaluate_observations(part, truth).detection == PERFECT
    ell = np.zeros((HEIGHT, WIDTH), bool)
    ell[:20, :20], ell[10:20, 10:20] = True, False
    found = dataclasses.replace(truth, masks={(0, 0): encode_mask(ell)})
    assert evaluate_observations(found, truth).detection["mean_iou"] == 0.75


WHOLE = (10, 10, 50, 20)
"""1000 px, of which 5 % are 50 px."""


def test_labels_of_keypoints_are_compared_by_boxes_of_the_same_keypoints():
    """The box of labelled keypoints is smaller than that of the mask, and hidden keypoints have no label."""
    names = ("bill", "eye", "tail", "far wing")
    truth = birds({1: {0: HERE}, 2: {0: THERE}}, [0], masks=False, names=names)
    points = truth.keypoints_px.copy()
    boxes = np.concatenate([points[:, :, 0], points[:, :, 2] - points[:, :, 0]], -1)
    truth = dataclasses.replace(truth.with_keypoints(points, truth.confidence * [1, 1, 1, 0]), box_px=boxes)
    points[:, :, 3] += 25
    found = birds({7: {0: (50, 5, 50, 50)}, 5: {0: (0, 5, 50, 50)}}, [0], names=names)
    found = found.with_keypoints(points[::-1], np.ones((2, 1, 4), np.float32))
    result = evaluate_observations(found, truth)
    assert result.detection == PERFECT
    assert result.compared == "boxes of labelled keypoints"
    assert result.keypoints["all"] == (6, 1, 1, 6, 1, 1)
    drawn = dataclasses.replace(truth, box_px=found.box_px[::-1])  # the boxes of a person stay
    assert evaluate_observations(found, drawn).detection == PERFECT
    assert evaluate_observations(found, drawn).compared == "boxes"


@pytest.mark.parametrize(
    ("visible", "ignored"),
    [((10, 10, 7, 7), 1), ((10, 10, 10, 5), 0), (None, 1)],
)
def test_a_bird_that_is_hardly_to_be_seen_is_ignored(visible, ignored):
    """49 px are too little of it, 50 px are not."""
    truth = birds({1: steady(WHOLE, range(3))}, range(3), visible={(1, 1): visible})
    found = birds({1: {0: WHOLE, 2: WHOLE}}, range(3))
    result = evaluate_observations(found, truth)
    assert (result.counts["ignored"], result.counts["true"]) == (ignored, 3 - ignored)
    assert result.detection["recall"] == (1 if ignored else 2 / 3)
    assert result.detection["ap50"] == pytest.approx(1 if ignored else 67 / 101)
    assert result.tracking["fragments"] == (0 if ignored else 1)
    assert result.tracking["mota"] == pytest.approx(1 if ignored else 2 / 3)


def test_who_finds_an_ignored_bird_is_excused():
    """Half of the found bird must lie on what is to be seen."""
    hidden = birds({1: {0: WHOLE, 1: WHOLE}}, [0, 1], visible={(1, 1): (10, 10, 7, 7)})
    on, half, off = (10, 10, 7, 6), (10, 10, 7, 14), (10, 10, 7, 15)
    for box, excused in ((on, 1), (half, 1), (off, 0), (WHOLE, 0)):
        found = birds({1: {0: WHOLE}, 2: {1: box}}, [0, 1], score=scores([0.5, 0], [0, 0.9]))
        result = evaluate_observations(found, hidden)
        assert (result.counts["excused"], result.counts["detected"]) == (excused, 2 - excused)
        assert result.detection["precision"] == (1 if excused else 1 / 2)
        assert result.detection["ap50"] == pytest.approx(1 if excused else 1 / 2)
        assert result.tracking["mota"] == (1 if excused else 0)
        assert result.tracking["idf1"] == (1 if excused else 2 / 3)


CROWD = (50, 0, 60, 40)


def without_mask(truth):
    """The second bird is annotated without a mask, as are crowds of COCO."""
    return dataclasses.replace(truth, masks={(0, 0): truth.masks[0, 0]})


@pytest.mark.parametrize(
    ("truth", "found", "counts", "precision"),
    [
        # a completely hidden bird is no ignored region
        (birds({1: steady(WHOLE, [0, 1])}, [0, 1], visible={(1, 1): None}), {1: steady(WHOLE, [0, 1])}, (1, 1, 0), 0.5),
        # a crowd is an ignored region for any number of birds
        (
            without_mask(birds({1: {0: HERE}, 2: {0: CROWD}}, [0])),
            {1: {0: HERE}, 2: {0: (55, 5, 20, 10)}, 3: {0: (80, 5, 20, 10)}, 4: {0: AWAY}},
            (1, 1, 2),
            0.5,
        ),
        # a counted bird goes before an ignored one
        (without_mask(birds({1: {0: HERE}, 2: {0: (0, 0, 60, 40)}}, [0])), {1: {0: HERE}}, (1, 1, 0), 1),
    ],
    ids=["hidden", "crowd", "both"],
)
def test_regions_to_ignore(truth, found, counts, precision):
    result = evaluate_observations(birds(found, truth.frame_index.tolist()), truth)
    assert tuple(result.counts[name] for name in ("true", "ignored", "excused")) == counts
    assert result.detection["precision"] == precision


def test_only_shared_frames_are_compared():
    """A file that looked at some frames of the video, and at others that nobody annotated."""
    truth = birds({1: steady(HERE, [3, 4, 5])}, [3, 4, 5])
    found = birds({1: steady(HERE, [4, 5, 6])}, [4, 5, 6, 7])
    result = evaluate_observations(found, truth)
    assert result.detection == PERFECT
    assert [result.counts[name] for name in ("frames", "true_elsewhere", "detected_elsewhere")] == [2, 1, 1]


SIDE = (20, 20, 40, 20)
"""5 % of its longer side are 2 px."""


def test_keypoints_by_hand():
    """One 2 px off, one 2.1 px, one 4 px, one not found; the third one is hidden."""
    names = ("a", "b", "c", "d")
    truth = birds({1: {0: SIDE}}, [0], names=names, occluded=np.array([[[False, False, True, False]]]))
    off = np.array([[2, 0], [0, 2.1], [0, -4], [0, 0]])
    found = birds(
        {1: {0: SIDE}},
        [0],
        names=names,
        keypoints_px=truth.keypoints_px + off,
        confidence=np.array([[[0.1, 1, 1, 0]]]),
    )
    rows = evaluate_observations(found, truth).keypoints
    nan = math.nan
    for name, expected in {
        "a": (1, 1, 1, 1, 1, 1),
        "b": (1, 0, 1, 1, 0, 1),
        "c": (0, nan, nan, 1, 0, 1),
        "d": (1, 0, 0, 1, 0, 0),
        "all": (3, 1 / 3, 2 / 3, 4, 1 / 4, 3 / 4),
    }.items():
        assert rows[name] == pytest.approx(expected, nan_ok=True), name
    assert list(rows) == [*names, "all"]


def test_keypoints_go_by_name():
    truth = birds({1: {0: SIDE}}, [0], names=("bill", "back", "tail"))
    found = birds({1: {0: SIDE}}, [0], names=("tail", "crown", "bill"))
    rows = evaluate_observations(found, truth).keypoints
    assert list(rows) == ["bill", "tail", "all"]
    assert rows["all"] == (2, 0, 0, 2, 0, 0)  # they lie where the other stands
    assert evaluate_observations(birds({1: {0: SIDE}}, [0], names=("x", "y")), truth).keypoints == {}


def test_nothing_found():
    truth = birds({1: steady(HERE, range(2))}, range(2))
    result = evaluate_observations(birds({}, range(2)), truth)
    assert (result.detection["ap50"], result.detection["ap50-95"], result.detection["recall"]) == (0, 0, 0)
    assert math.isnan(result.detection["precision"])
    assert (result.tracking["mota"], result.tracking["idf1"], result.tracking["hota"]) == (0, 0, 0)
    assert result.keypoints["all"].visible == 0
    assert math.isnan(result.keypoints["all"].pck_05)


def test_nothing_to_find():
    result = evaluate_observations(birds({1: steady(HERE, range(2))}, range(2)), birds({}, range(2)))
    assert result.detection["precision"] == 0
    assert all(math.isnan(result.detection[name]) for name in ("ap50", "ap50-95", "recall", "mean_iou"))
    assert math.isnan(result.tracking["mota"])
    assert result.tracking["idf1"] == 0


def test_files_that_do_not_belong_together():
    truth = birds({1: {0: HERE}}, [0])
    with pytest.raises(InputError, match=r"truth.json.*shares no frame"):
        evaluate_observations(birds({1: {5: HERE}}, [5]), Truth(truth, source="truth.json"))
    smaller = birds({1: {0: HERE}}, [0], masks=False, image_size_px=np.array([[60, 50]]))
    with pytest.raises(InputError, match=r"frame 0 of 120×100 pixels, the observations of 60×50"):
        evaluate_observations(smaller, truth)
    photographs = birds({1: {0: HERE}}, [0], own_images={(0, 0): ("b.png", WIDTH, HEIGHT)})
    for pair in ((photographs, truth), (truth, photographs)):
        with pytest.raises(InputError, match="photographs"):
            evaluate_observations(*pair)


def test_random_birds_against_a_plain_reckoning():
    """Masks that overlap as they like, compared pixel by pixel."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        true, own = (
            {i: {0: (*rng.integers(0, 40, 2), *rng.integers(10, 40, 2))} for i in range(rng.integers(1, 6))}
            for _ in range(2)
        )
        result = evaluate_observations(birds(own, [0]), birds(true, [0]))
        matched = plain_matches(true, own)
        assert result.detection["recall"] == pytest.approx(len(matched) / len(true))
        assert result.detection["mean_iou"] == pytest.approx(np.mean(matched) if matched else math.nan, nan_ok=True)


def plain_matches(true, own):
    """IoUs of the matches with the greatest sum, of all one-to-one choices."""

    def pixels(box):
        x, y, w, h = box
        return {(i, j) for i in range(x, x + w) for j in range(y, y + h)}

    rows, columns = ([pixels(boxes[0]) for boxes in tracks.values()] for tracks in (true, own))
    table = [[len(a & b) / len(a | b) for b in columns] for a in rows]

    def best(row, free):
        if row == len(table):
            return []
        choices = [best(row + 1, free)]
        choices += [[table[row][n], *best(row + 1, free - {n})] for n in free if table[row][n] >= 0.5]
        return max(choices, key=sum)

    return best(0, frozenset(range(len(own))))
