"""COCO keypoints of CVAT and Label Studio: without frame numbers, with tracks in attributes or without tracks."""

import json
import logging

import numpy as np
import pytest
from support.coco_files import content as video
from support.coco_files import saved as saved_video

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError

KEYPOINTS = [10, 5, 2, 20.5, 6.25, 1, 0, 0, 0]


def cvat(files, birds):
    """Return an export of CVAT; `birds` holds (picture, changes) of every annotation."""
    images = [
        {"id": i, "width": 30, "height": 20, "file_name": file, "license": 0, "date_captured": 0}
        for i, file in enumerate(files, 1)
    ]
    skeleton = {
        "id": 1,
        "name": "bird",
        "supercategory": "",
        "keypoints": ["beak", "nape", "tail"],
        "skeleton": [[1, 2]],
    }
    part = {"id": 2, "name": "beak", "supercategory": "bird", "keypoints": [], "skeleton": []}
    basic = {"category_id": 1, "segmentation": [], "area": 90.0, "bbox": [9.0, 4.0, 12.0, 4.0], "iscrowd": 0}
    basic |= {"keypoints": KEYPOINTS, "num_keypoints": 2}
    annotations = [basic | {"id": i, "image_id": image} | more for i, (image, more) in enumerate(birds, 1)]
    return {"licenses": [], "info": {}, "images": images, "categories": [skeleton, part], "annotations": annotations}


def label_studio(files):
    """Return an export of Label Studio: one bird per picture, ids from 0, no attributes."""
    images = [{"width": 30, "height": 20, "id": i, "file_name": f"images/{file}"} for i, file in enumerate(files)]
    category = {"id": 1, "name": "default", "supercategory": "default", "keypoints": ["beak", "nape", "tail"]}
    rectangle = {"id": 9, "image_id": 0, "category_id": 0, "segmentation": [], "bbox": [1, 1, 3, 3], "ignore": 0}
    single = {"keypoints": [7, 8, 2, *[0] * 6], "num_keypoints": 1, "bbox": [7, 8, 0, 0]}
    birds = [{"id": i, "image_id": i, "category_id": 1, "iscrowd": 0} | single for i in range(len(files))]
    categories = [{"id": 0, "name": "box"}, category | {"skeleton": []}]
    return {"images": images, "categories": categories, "annotations": [rectangle, *birds]}


def saved(tmp_path, content):
    (tmp_path / "export.json").write_text(json.dumps(content))
    return tmp_path / "export.json"


def test_tracks_of_cvat(tmp_path):
    """The number in the name is the frame; tracks stand in the attributes; birds outside the picture are absent."""
    outside = {"keypoints": [], "num_keypoints": 0, "bbox": [0.0, 0.0, 0.0, 0.0]}
    birds = [(image, {"attributes": {"occluded": False, "track_id": k}}) for image in (1, 2) for k in (0, 3)]
    birds[3] = (2, outside | birds[3][1])
    path = saved(tmp_path, cvat(["frame_000012.PNG", "frame_000015.PNG"], birds))
    observed = read_observations(path)
    assert observed.frame_index.tolist() == [12, 15]
    assert observed.track_id.tolist() == [0, 3]
    assert observed.present.tolist() == [[True, True], [True, False]]
    assert observed.confidence[0, 0].tolist() == [1, 1, 0]
    assert observed.skeleton == ((0, 1),)
    write_coco(observed, tmp_path / "again.json")
    np.testing.assert_array_equal(read_observations(tmp_path / "again.json").keypoints_px, observed.keypoints_px)


def test_masks_of_birds_without_a_labelled_keypoint_are_kept(tmp_path):
    polygon = {"segmentation": [[9, 4, 21, 4, 21, 8]], "keypoints": [0] * 9, "num_keypoints": 0}
    path = saved(tmp_path, cvat(["frame_000012.PNG"], [(1, polygon | {"attributes": {"track_id": 3}})]))
    assert read_observations(path).masks.keys() == {(0, 0)}


def test_pictures_of_label_studio(tmp_path):
    """The prefix of uploads is no part of the name; one bird per picture is one track; a keypoint has a box."""
    observed = read_observations(saved(tmp_path, label_studio(["0a1b2c3d-img_7.png", "99990000-img_5.png"])))
    assert observed.frame_index.tolist() == [5, 7]
    assert observed.track_id.tolist() == [1]
    assert observed.box_px[0, 0].tolist() == [6.5, 7.5, 1, 1]


@pytest.mark.parametrize(
    ("files", "frames", "tracks"),
    [
        (["img_1.png", "img_2.png"], [1, 2], [1, 2, 3]),  # several birds in a frame, without tracks
        (["murre.png", "gull.png"], [0], [1, 2, 3]),  # photographs
        (["a/1.png", "b/1.png"], [0], [1, 2, 3]),  # two videos
    ],
)
def test_birds_without_tracks(tmp_path, files, frames, tracks):
    observed = read_observations(saved(tmp_path, cvat(files, [(1, {}), (1, {}), (2, {})])))
    assert observed.frame_index.tolist() == frames
    assert observed.track_id.tolist() == tracks
    if frames == [0]:
        assert observed.image_file(2, 0) == files[1]


def test_images_of_several_sizes_are_photographs(tmp_path, caplog):
    """The frames of a video have one size."""
    content = cvat(["img_1.png", "img_2.png"], [(1, {}), (2, {})])
    content["images"][0]["width"] += 8
    assert read_observations(saved(tmp_path, content)).track_id.tolist() == [1, 2]
    assert "2 sizes" in caplog.text


@pytest.mark.parametrize(
    ("content", "program"),
    [
        ({"version": "5.2.1", "shapes": [], "imagePath": "a.jpg", "imageHeight": 9, "imageWidth": 9}, "LabelMe.*COCO"),
        ({"_via_settings": {}, "_via_img_metadata": {"a.jpg123": {"filename": "a.jpg", "regions": []}}}, "VIA.*COCO"),
        ({"a.jpg123": {"filename": "a.jpg", "size": 123, "regions": []}}, "VIA.*COCO"),
    ],
)
def test_a_file_of_a_program_that_is_not_read_is_named(tmp_path, content, program):
    with pytest.raises(InputError, match=program):
        read_observations(saved(tmp_path, content))


def test_a_video_file_that_lacks_a_track_is_still_an_error(tmp_path):
    content = cvat(["frame_1.png", "frame_2.png"], [(1, {"track_id": 4}), (2, {})])
    with pytest.raises(InputError, match=r"annotations\[1\] lacks the key track_id"):
        read_observations(saved(tmp_path, content))


def untracked_video():
    """Return a file with frame numbers, but without a track."""
    without = video()
    for annotation in without["annotations"]:
        del annotation["track_id"]
    return without


def test_photographs_without_tracks(tmp_path, caplog):
    """For a fit, a file without any track is a set of photographs, and a line says so."""
    observed = read_observations(saved_video(tmp_path, untracked_video()), untracked="photographs")
    assert observed.frame_index.tolist() == [0]
    assert observed.present.tolist() == [[True]] * 5
    assert [observed.image_file(n, 0) for n in range(5)] == ["b.png", "a.png", "c.png", "a.png", "b.png"]
    assert "no annotation has a track_id" in caplog.text
    assert "3 images" in caplog.text
    assert "5 annotations" in caplog.text
    one_bird = label_studio(["0a1b2c3d-img_7.png", "99990000-img_5.png"])
    observed = read_observations(saved(tmp_path, one_bird), untracked="photographs")
    assert observed.frame_index.tolist() == [0]
    assert observed.track_id.tolist() == [1, 2]


def test_tracks_of_any_kind_are_kept(tmp_path, caplog):
    """A file with tracks is a video for a fit too, whether the tracks are keys or attributes."""
    tracked = cvat(["frame_1.png", "frame_2.png"], [(image, {"attributes": {"track_id": 3}}) for image in (1, 2)])
    for path in (saved(tmp_path, tracked), saved_video(tmp_path, video())):
        for untracked in ("labels", "photographs"):
            as_video, read = read_observations(path), read_observations(path, untracked=untracked)
            np.testing.assert_array_equal(read.track_id, as_video.track_id)
            np.testing.assert_array_equal(read.frame_index, as_video.frame_index)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_only_labels_and_fits_read_a_video_without_tracks(tmp_path):
    with pytest.raises(InputError, match=r"annotations\[0\] lacks the key track_id"):
        read_observations(saved_video(tmp_path, untracked_video()))


@pytest.mark.parametrize(
    ("third", "confidence"),
    [
        ((0.96, 0.03, 1.0), (0.96, 0.03, 1)),
        ((2, 0.4, 0), (1, 0.4, 0)),  # 2 is a score, too
        ((3.2, 0.5, 1), (1, 0.5, 1)),  # the peak of a heat map
    ],
)
def test_scores_in_place_of_visibilities(tmp_path, caplog, third, confidence):
    """Only 0, 1 and 2 are visibilities; one other number makes all of them scores."""
    points = [value for x, score in zip((10, 20.5, 1), third, strict=True) for value in (x, 5, score)]
    observed = read_observations(saved(tmp_path, cvat(["frame_1.png"], [(1, {"keypoints": points})])))
    np.testing.assert_allclose(observed.confidence[0, 0], confidence)
    assert not observed.occluded.any()
    assert "holds scores in place of visibilities" in caplog.text


@pytest.mark.parametrize("third", [96, -1, 11.5])
def test_third_numbers_of_keypoints_that_are_no_scores(tmp_path, third):
    path = saved(tmp_path, cvat(["frame_1.png"], [(1, {"keypoints": [10, 5, 2, 20.5, 6.25, third, 1, 2, 0]})]))
    with pytest.raises(InputError, match=f"keypoint 1 is {third}, which is no visibility"):
        read_observations(path)


def test_cocovid(tmp_path):
    """Frames are numbered by `frame_id`, tracks by `instance_id`; the message about several videos names them."""
    birds = [(1, {"instance_id": 7}), (2, {"instance_id": 4}), (2, {"instance_id": 7})]
    content = cvat(["bird/1.png", "bird/2.png"], birds)
    for i, image in enumerate(content["images"]):
        image |= {"video_id": 1, "frame_id": 5 * i}
    observed = read_observations(saved(tmp_path, content))
    assert observed.frame_index.tolist() == [0, 5]
    assert observed.track_id.tolist() == [4, 7]
    assert observed.present.tolist() == [[False, True], [True, True]]
    content["images"][1]["video_id"] = 2
    content["videos"] = [{"id": 1, "name": "north"}, {"id": 2, "name": "south"}]
    with pytest.raises(InputError, match=r"holds 2 videos \(video_id\): north, south"):
        read_observations(saved(tmp_path, content))
