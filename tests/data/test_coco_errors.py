"""COCO json: one clear error, with file, entry and remedy, for every bad file."""

import copy
import math

import numpy as np
import pytest
from support.coco_files import MASK, annotation, content, saved

from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.errors import InputError

# each: where in the content, the new value (or a function of the old), and what the message says
REMOVED = object()
BAD = [
    ([], [1, 2], "must hold an object with images, categories and annotations"),
    (["images"], REMOVED, "lacks the key images"),
    (["images"], [], "images is empty"),
    (["images", 1, "id"], 7, r"images\[1\]: id 7 occurs for the second time"),
    (["images", 0, "width"], 0, r"images\[0\]: a size of 0×20 is outside 1 to 16,384 pixels"),
    (["images", 0, "width"], "30", r"images\[0\]: '30' must be a whole number"),
    (["images", 0, "frame_index"], REMOVED, r"images\[0\] lacks the key frame_index \(give every image"),
    (["categories"], [], "categories hold none with keypoints"),
    (["categories", 0, "keypoints", 1], "bill", "keypoint_names must be different names, but hold 'bill' twice"),
    (["categories"], lambda old: old * 2, r"categories\[1\]: id 1 occurs for the second time"),
    (["categories", 0, "skeleton", 0], [1, 4], r"categories\[0\]: skeleton \[\(1, 4\), .* are not 1 to 3"),
    (["annotations", 3, "image_id"], 99, r"annotations\[3\]: image_id is 99, which no image has"),
    (["annotations", 3, "category_id"], 99, r"annotations\[3\]: category_id is 99, which no category"),
    (["annotations", 3, "track_id"], REMOVED, r"annotations\[3\] lacks the key track_id \(give every"),
    (["annotations", 3, "track_id"], 2, r"track_id 2 twice in frame_index 3: id 2 \(a.*\[1\]\) and id 4 \("),
    (["annotations", 3, "keypoints"], [1] * 8, r"annotations\[3\]: keypoints has 8 numbers, not 9"),
    (["annotations", 3, "keypoints", 1], math.nan, "keypoints_px must be finite where it is not missing"),
    (["annotations", 3, "keypoints", 0], 1e30, "keypoints_px holds 1e.30, which is no position in an image"),
    (["annotations", 1, "keypoint_scores", 0], 1.01, r"confidence must lie in \[0, 1\]"),
    (["annotations", 1, "keypoint_scores"], [1], r"annotations\[1\]: keypoint_scores has 1 numbers, not 3"),
    (["annotations", 3, "bbox", 2], 0, r"annotations\[3\]: bbox has width 0 and height 8"),
    (["annotations", 0, "segmentation", "size"], [30, 20], r"size is \[30, 20\], but its image is \[20, 30\]"),
    (["annotations", 0, "segmentation", "counts"], "", r"annotations\[0\]\): segmentation.counts is corrupt"),
    (["annotations", 0, "segmentation", "counts"], lambda s: s[:-1], "segmentation.counts is corrupt"),
    (["annotations", 3, "segmentation", "counts", 0], 1, "segmentation.counts is corrupt: its runs do not cover"),
    (["annotations", 4, "segmentation"], [[1, 2, 3, 4, 5]], "segmentation must be a list of polygons"),
    (["annotations", 4, "segmentation", 0, 3], 500000, "segmentation lies far outside its image"),
    (["info"], {"fps": -25}, "fps must be positive"),
]


@pytest.mark.parametrize(("where", "value", "message"), BAD, ids=range(len(BAD)))
def test_one_clear_error(tmp_path, where, value, message):
    data = {"root": content()}
    *parents, last = ["root", *where]
    holder = data
    for key in parents:
        holder = holder[key]
    if value is REMOVED:
        del holder[last]
    else:
        holder[last] = value(holder[last]) if callable(value) else copy.deepcopy(value)
    path = saved(tmp_path, data["root"])
    with pytest.raises(InputError, match=message) as caught:
        read_coco(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).endswith(")"), "there is no remedy"
    assert "\n" not in str(caught.value)


def test_no_byte_of_a_mask_brings_the_reader_down(tmp_path):
    """Corrupt counts are refused, or make another mask of the right size; pycocotools sees no others."""
    rng = np.random.default_rng(0)
    data, refused = content(), 0
    good = data["annotations"][0]["segmentation"]["counts"]
    for _ in range(200):
        text = list(good)
        for _ in range(rng.integers(1, 4)):
            text[rng.integers(len(text))] = chr(rng.integers(32, 127))
        data["annotations"][0]["segmentation"]["counts"] = "".join(text)
        try:
            assert read_coco(saved(tmp_path, data)).mask(1, 1).shape == MASK.shape
        except InputError:
            refused += 1
    assert refused > 130


def test_an_outline_without_area_is_no_mask(tmp_path):
    """Annotation programs write empty outlines, and outlines of a point or a line."""
    data = content()
    for outline in ([[]], [[1, 2, 3, 4]]):
        data["annotations"][4]["segmentation"] = outline
        assert read_coco(saved(tmp_path, data)).mask(0, 1) is None
    data["annotations"][4]["segmentation"] = [[5, 4, 25, 4, 25, 12, 5, 12], [1, 2, 3, 4]]
    assert read_coco(saved(tmp_path, data)).mask(0, 1).sum() == MASK.sum()


def test_tables_are_rejected_by_estimate(tmp_path):
    data = content()
    data["images"] = [{"id": t, "width": 30, "height": 20, "file_name": "a", "frame_index": t} for t in range(3600)]
    plain = annotation(1, 0, 0, segmentation=None)
    data["annotations"] = [plain | {"image_id": n, "track_id": n} for n in range(3600)]
    message = r"annotations of 3,600 tracks over 3,600 frames with 3 keypoints need 2.5 GB, more than 2 GB .*split"
    with pytest.raises(InputError, match=message):
        read_coco(saved(tmp_path, data))


def test_only_other_categories_is_no_bird(tmp_path):
    data = content()
    data["categories"].append({"id": 2, "name": "boat"})
    for entry in data["annotations"]:
        entry["category_id"] = 2
    with pytest.raises(InputError, match=r"annotations hold no bird \(5 of other categories\)"):
        read_coco(saved(tmp_path, data))
