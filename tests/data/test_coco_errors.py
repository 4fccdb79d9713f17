"""COCO json: one clear error, with file, field and remedy, for every bad file."""

import copy
import json
import math

import numpy as np
import pytest
from support.coco_files import MASK, content, saved

from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.errors import InputError

# each: where in the content, the new value (or a function of the old), and what the message says
REMOVED = object()
BAD = [
    ([], [1, 2], "the file must hold an object"),
    ([], 42, "the file must hold an object"),
    (["images"], REMOVED, "the file lacks the key images"),
    (["annotations"], REMOVED, "the file lacks the key annotations"),
    (["categories"], REMOVED, "the file lacks the key categories"),
    (["images"], {}, "images must be a list, not an object"),
    (["images"], [], "images is empty"),
    (["images", 1], 3, r"images\[1\] must be an object, not a number \(3\)"),
    (["images", 1, "id"], 7, r"images\[1\].id is 7, as images\[0\].id is"),
    (["images", 1, "id"], None, r"images\[1\].id must be a whole number, not null"),
    (["images", 0, "width"], 0, r"images\[0\].width is 0, outside"),
    (["images", 0, "height"], -5, r"images\[0\].height is -5, outside"),
    (["images", 0, "height"], 10**9, r"images\[0\].height is 1000000000, outside"),
    (["images", 0, "height"], math.nan, r"images\[0\].height must be a whole number, not nan"),
    (["images", 0, "height"], math.inf, r"images\[0\].height must be a whole number, not inf"),
    (["images", 0, "width"], "30", r'images\[0\].width must be a whole number, not text \("30"\)'),
    (["images", 0, "width"], True, r"images\[0\].width must be a whole number, not true or false"),
    (["images", 0, "frame_index"], REMOVED, r"images\[0\] lacks the key frame_index \(give every image"),
    (["images", 0, "frame_index"], 1.5, r"images\[0\].frame_index must be a whole number, not 1.5"),
    (["images", 0, "frame_index"], 10**40, r"images\[0\].frame_index is 1000.*outside"),
    (["images", 0, "frame_index"], -1, r"images\[0\].frame_index is -1"),
    (["images", 0, "file_name"], 3, r"images\[0\].file_name must be text"),
    (["categories"], [], "categories hold none with keypoints"),
    (["categories", 0, "keypoints"], REMOVED, "categories hold none with keypoints"),
    (["categories", 0, "keypoints", 1], "bill", r"categories\[0\].keypoints holds a name twice"),
    (["categories", 0, "keypoints", 1], 4, r"categories\[0\].keypoints\[1\] must be text"),
    (["categories"], lambda old: old * 2, r"categories\[1\].id is 1 for the second time"),
    (["categories", 0, "skeleton", 0], [1, 4], r"categories\[0\].skeleton\[0\] is \[1, 4\]"),
    (["categories", 0, "skeleton", 0], [1], r"categories\[0\].skeleton\[0\] has 1 numbers, not 2"),
    (["annotations", 3], None, r"annotations\[3\] must be an object, not null"),
    (["annotations", 3, "image_id"], 99, r"annotations\[3\].image_id is 99, which no image has"),
    (["annotations", 3, "category_id"], 99, r"annotations\[3\].category_id is 99, which no category"),
    (["annotations", 3, "category_id"], REMOVED, r"annotations\[3\] lacks the key category_id"),
    (["annotations", 3, "track_id"], REMOVED, r"annotations\[3\] lacks the key track_id \(give every"),
    (["annotations", 3, "track_id"], "a", r"annotations\[3\].track_id must be a whole number"),
    (["annotations", 3, "track_id"], 2, r"track_id 2 twice in frame_index 3: id 2 \(a.*\[1\]\) and id 4 \("),
    (["annotations", 3, "keypoints"], REMOVED, r"annotations\[3\] lacks the key keypoints"),
    (["annotations", 3, "keypoints"], [1] * 8, r"annotations\[3\].keypoints has 8 numbers, not 9 \(x, y, v"),
    (["annotations", 3, "keypoints", 1], math.nan, r"annotations\[3\].keypoints holds nan at \[1\]"),
    (["annotations", 3, "keypoints", 7], math.inf, r"annotations\[3\].keypoints holds inf at \[7\]"),
    (["annotations", 3, "keypoints", 0], 1e300, r"annotations\[3\].keypoints holds 1e\+300 at \[0\]"),
    (["annotations", 3, "keypoints", 0], 10**400, r"annotations\[3\].keypoints holds 1000"),
    (["annotations", 3, "keypoints", 0], "1", r"annotations\[3\].keypoints\[0\] must be a number, not text"),
    (["annotations", 3, "keypoints", 0], None, r"annotations\[3\].keypoints\[0\] must be a number, not null"),
    (
        ["annotations", 3, "keypoints", 0],
        [1],
        r"annotations\[3\].keypoints\[0\] must be a number, not a list",
    ),
    (["annotations", 3, "keypoints", 2], -1, r"annotations\[3\].keypoints has visibility -1"),
    (["annotations", 1, "keypoint_scores", 0], 1.01, r"annotations\[1\].keypoint_scores holds 1.01 at \[0\]"),
    (["annotations", 1, "keypoint_scores", 2], -0.1, r"annotations\[1\].keypoint_scores holds -0.1 at \[2\]"),
    (["annotations", 1, "keypoint_scores", 2], math.nan, r"annotations\[1\].keypoint_scores holds nan"),
    (["annotations", 1, "keypoint_scores"], [1], r"annotations\[1\].keypoint_scores has 1 numbers, not 3"),
    (["annotations", 1, "score"], 1.5, r"annotations\[1\].score is 1.5, outside 0 to 1"),
    (["annotations", 1, "score"], math.nan, r"annotations\[1\].score is nan, outside 0 to 1"),
    (["annotations", 1, "score"], "high", r"annotations\[1\].score must be a number, not text"),
    (["annotations", 3, "bbox"], [1, 2, 3], r"annotations\[3\].bbox has 3 numbers, not 4"),
    (["annotations", 3, "bbox"], REMOVED, r"annotations\[3\] lacks the key bbox"),
    (["annotations", 3, "bbox", 2], -1, r"annotations\[3\].bbox has width -1 and height 8"),
    (["annotations", 3, "bbox", 2], 0, r"annotations\[3\].bbox has width 0"),
    (["annotations", 3, "bbox", 2], math.nan, r"annotations\[3\].bbox holds nan at \[2\]"),
    (["annotations", 3, "iscrowd"], 3, r"annotations\[3\].iscrowd is 3, outside 0 to 1"),
    (["annotations", 0, "segmentation"], "x", r"annotations\[0\].segmentation must be run lengths"),
    (
        ["annotations", 0, "segmentation", "size"],
        [30, 20],
        r"size is \[30, 20\], but its image is \[20, 30\]",
    ),
    (
        ["annotations", 0, "segmentation", "size"],
        REMOVED,
        r"annotations\[0\].segmentation lacks the key size",
    ),
    (["annotations", 0, "segmentation", "counts"], REMOVED, r"segmentation lacks the key counts"),
    (["annotations", 0, "segmentation", "counts"], 5, r"counts must be text or a list"),
    (["annotations", 0, "segmentation", "counts"], "", r"annotations\[0\].segmentation.counts is corrupt"),
    (["annotations", 0, "segmentation", "counts"], "é", r"segmentation.counts is corrupt"),
    (["annotations", 0, "segmentation", "counts"], " ~", r"segmentation.counts is corrupt"),
    (["annotations", 0, "segmentation", "counts"], "oooooooooooooooo1", r"segmentation.counts is corrupt"),
    (["annotations", 0, "segmentation", "counts"], lambda s: s[:-1], r"segmentation.counts is corrupt"),
    (
        ["annotations", 0, "segmentation", "counts"],
        lambda s: s + "1",
        r"segmentation.counts is corrupt: its runs",
    ),
    (["annotations", 0, "segmentation", "counts"], lambda s: s * 50, r"segmentation.counts is corrupt"),
    (["annotations", 3, "segmentation", "counts", 0], 1, r"segmentation.counts is corrupt: its runs cover"),
    (["annotations", 3, "segmentation", "counts"], [601, -1], r"segmentation.counts\[1\] is -1, outside"),
    (["annotations", 3, "segmentation", "counts"], [2**70], r"segmentation.counts\[0\] is 1180.* outside"),
    (
        ["annotations", 3, "segmentation", "counts"],
        ["600"],
        r"segmentation.counts\[0\] must be a whole number",
    ),
    (["annotations", 3, "segmentation", "counts"], [], r"segmentation.counts is corrupt: its runs cover 0"),
    (["annotations", 4, "segmentation"], [[1, 2, 3, 4, 5]], r"segmentation\[0\] has 5 numbers; a polygon"),
    (["annotations", 4, "segmentation"], [[1, 2, 3, 4]], r"segmentation\[0\] has 4 numbers; a polygon"),
    (
        ["annotations", 4, "segmentation"],
        [1, 2, 3, 4, 5, 6],
        r"segmentation\[0\] must be a list of x, y pairs",
    ),
    (["annotations", 4, "segmentation", 0, 3], math.nan, r"segmentation\[0\] holds nan at \[3\]"),
    (["annotations", 4, "segmentation", 0, 3], 500000, r"segmentation\[0\] lies far outside its image"),
    (["annotations", 4, "segmentation", 0, 3], 1e12, r"segmentation\[0\] holds 1.* no image position"),
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
    for _ in range(300):
        text = list(good)
        for _ in range(rng.integers(1, 4)):
            text[rng.integers(len(text))] = chr(rng.integers(32, 127))
        data["annotations"][0]["segmentation"]["counts"] = "".join(text)
        try:
            assert read_coco(saved(tmp_path, data)).mask(1, 1).shape == MASK.shape
        except InputError:
            refused += 1
    assert refused > 200


def test_broken_text_says_where(tmp_path):
    text = json.dumps(content(), indent=1)
    for length in range(0, len(text) - 1, 97):
        with pytest.raises(InputError) as caught:
            read_coco(saved(tmp_path, text[:length]))
        assert "is empty" in str(caught.value) or "not valid JSON at line" in str(caught.value)
    with pytest.raises(InputError, match=r"not valid JSON at line 2, column 1: .*correct the file"):
        read_coco(saved(tmp_path, '{"images": [],\n}'))
    with pytest.raises(InputError, match=r"not valid JSON at line 1, column 1: .*correct the file"):
        read_coco(saved(tmp_path, "not json"))
    with pytest.raises(InputError, match="ends midway"):
        read_coco(saved(tmp_path, '{"images": ['))
    with pytest.raises(InputError, match="recursion depth"):
        read_coco(saved(tmp_path, "[" * 200_000))
    with pytest.raises(InputError, match="digits"):
        read_coco(saved(tmp_path, '{"images": ' + "9" * 5000 + "}"))


def test_what_is_no_file_of_text(tmp_path):
    with pytest.raises(InputError, match=r"absent\.json: does not exist"):
        read_coco(tmp_path / "absent.json")
    with pytest.raises(InputError, match="is a folder"):
        read_coco(tmp_path)
    (tmp_path / "latin.json").write_bytes('{"images": "ü"}'.encode("latin-1"))
    with pytest.raises(InputError, match=r"is not UTF-8 text \(byte 12\)"):
        read_coco(tmp_path / "latin.json")
    (tmp_path / "marked.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(content()).encode())
    assert read_coco(tmp_path / "marked.json").num_tracks == 2


def test_only_other_categories_is_no_bird(tmp_path):
    data = content()
    data["categories"].append({"id": 2, "name": "boat"})
    for entry in data["annotations"]:
        entry["category_id"] = 2
    with pytest.raises(InputError, match=r"annotations hold no bird \(5 of other categories\)"):
        read_coco(saved(tmp_path, data))


def test_an_empty_path_is_one_error():
    with pytest.raises(InputError, match=r"\. *: is a folder"):
        read_coco("")
