"""COCO json: files that would take much time or memory are rejected at once, with the figure and a remedy."""

import pytest
from support.coco_files import annotation, content, saved

from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import IMAGE_SIDE_PX, KEYPOINTS, MASK_RUNS, POLYGON_LENGTH_PX, POLYGONS


def rejected(tmp_path, data, message):
    with pytest.raises(InputError, match=message):
        read_coco(saved(tmp_path, data))


def large_image(segmentation):
    data = content()
    for image in data["images"]:
        image["width"] = image["height"] = IMAGE_SIDE_PX
    data["annotations"] = [data["annotations"][4] | {"segmentation": segmentation}]
    return data


def zigzag(points):
    side = IMAGE_SIDE_PX - 1
    return [value for i in range(points) for value in (side * (i % 2), i * 7 % side)]


def test_the_length_of_polygons_is_bounded(tmp_path):
    rejected(tmp_path, large_image([zigzag(8000)]), r"segmentation has outlines of 1.31e\+08 pixels .*simplify")
    rejected(tmp_path, large_image([zigzag(40)] * 2), r"has outlines of 1.31e\+06 pixels")
    longest = zigzag(POLYGON_LENGTH_PX // IMAGE_SIDE_PX)
    assert read_coco(saved(tmp_path, large_image([longest]))).masks
    triangles = [[1, 1, 9, 1, 5, 9]] * (POLYGONS + 1)
    rejected(tmp_path, large_image(triangles), "segmentation has 257 polygons, more than 256")
    assert read_coco(saved(tmp_path, large_image(triangles[1:]))).masks


def test_the_number_of_runs_is_bounded(tmp_path):
    data = content()
    data["annotations"][3]["segmentation"]["counts"] = [0] * 602 + [600]
    rejected(tmp_path, data, "counts has 603 runs, more than the 600 pixels")
    data["annotations"][3]["segmentation"]["counts"] = [0, 600, 0]
    assert read_coco(saved(tmp_path, data)).mask(0, 0).all()
    side = IMAGE_SIDE_PX
    for counts in ("1" * (MASK_RUNS + 1), [1] * MASK_RUNS + [side**2 - MASK_RUNS]):
        data = large_image({"size": [side, side], "counts": counts})
        rejected(tmp_path, data, "counts has 1,000,001 runs, more than 1,000,000")
    # a text without the end of a number takes no time either
    rejected(tmp_path, large_image({"size": [side, side], "counts": "o" * 10 * MASK_RUNS}), "counts is corrupt")


def tracks_and_frames(tracks, frames, keypoints=18):
    """Return tracks of one box each over many frames."""
    data = content()
    data["categories"][0]["keypoints"] = [f"k{k}" for k in range(keypoints)]
    data["images"] = [{"id": t, "width": 30, "height": 20, "file_name": "a", "frame_index": t} for t in range(frames)]
    plain = annotation(1, 0, 0, keypoints=[1, 1, 2] * keypoints, segmentation=None)
    data["annotations"] = [plain | {"image_id": n % frames, "track_id": n} for n in range(tracks)]
    return data


def test_tables_are_rejected_by_estimate(tmp_path):
    message = "annotations of 3,600 tracks over 3,600 frames with 18 keypoints need 11.0 GB, more than 2 GB .*split"
    rejected(tmp_path, tracks_and_frames(3600, 3600), message)
    rejected(tmp_path, tracks_and_frames(300, 300, 999), "need 4.0 GB")
    assert read_coco(saved(tmp_path, tracks_and_frames(100, 100))).num_tracks == 100


def test_names_are_bounded(tmp_path):
    """An array of names takes the length of the longest name for every frame."""
    data = content()
    data["images"][0]["file_name"] = "x" * 5000
    rejected(tmp_path, data, r"images\[0\].file_name has 5,000 characters, more than 4,096")
    for name in ("a\0", "a\ud800"):
        data["images"][0]["file_name"] = name
        rejected(tmp_path, data, r"images\[0\].file_name holds a character that is no text")
    data = tracks_and_frames(2, 50_000, 3)
    data["images"][0]["file_name"] = "x" * 4000
    rejected(tmp_path, data, "annotations of 2 tracks over 50,000 frames with 3 keypoints need 2.4 GB")
    names = [f"k{k}" for k in range(KEYPOINTS + 1)]
    data = content()
    data["categories"][0]["keypoints"] = names
    rejected(tmp_path, data, "keypoints holds 1001 names, more than 1000")
