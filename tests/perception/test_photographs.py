"""Photographs: every bird has an image of its own, in pictures of several sizes."""

import cv2
import numpy as np
import pytest
from support.toy_footage import Footage, TrueKeypoints

from jaxfit.config.perception import FramesConfig, SegmenterConfig, TrackConfig
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.foundation.errors import InputError
from jaxfit.perception import photographs, segmenter_choice
from jaxfit.perception.network import instance_of
from jaxfit.perception.photographs import track_photographs

NAMED = TrackConfig(segmenter=SegmenterConfig("general"))


class Red:
    """One bird: the red pixels."""

    class_names = ("bird",)

    def photograph(self, picture):
        bird = instance_of(picture[..., 2] > 200, 0.7, "bird")
        return [] if bird is None else [bird]

    def __call__(self, picture):
        raise AssertionError("photographs are searched more thoroughly")


class Corners:
    """Keypoints: the corners of the box."""

    keypoint_names = ("bill_tip", "tail_tip", "left_eye")

    def __call__(self, picture, birds):
        boxes = np.array([bird.box_px for bird in birds], np.float32).reshape(-1, 4)
        ends = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:], boxes[:, :2]], 1)
        return ends, np.full(ends.shape[:2], 0.9)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for module in (photographs, segmenter_choice):
        monkeypatch.setattr(module, "open_segmenter", lambda config: Red())
        monkeypatch.setattr(module, "open_keypoint_detector", lambda config: Corners())
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name, shape, box in (
        ("2.png", (40, 60), (5, 6, 20, 30)),
        ("10.png", (80, 50), (1, 2, 9, 70)),
        ("3.png", (9, 9), None),
    ):
        picture = np.zeros((*shape, 3), np.uint8)
        if box:
            picture[box[1] : box[3], box[0] : box[2]] = (0, 0, 255)
        cv2.imwrite(str(pictures / name), picture)
    (pictures / "4.png").write_bytes(b"damage")
    return pictures


def test_birds_of_pictures_of_several_sizes(folder, tmp_path, caplog):
    found = track_photographs(folder, NAMED)
    write_coco(found.observations, tmp_path / "birds.json", found.info())
    for birds in (found.observations, read_coco(tmp_path / "birds.json")):
        assert (birds.num_tracks, birds.num_frames, birds.photographs) == (2, 1, 2)
        assert [birds.image_file(n, 0) for n in range(2)] == ["2.png", "10.png"]
        assert [birds.image_size(n, 0) for n in range(2)] == [(60, 40), (50, 80)]
        np.testing.assert_array_equal(birds.box_px[:, 0], [[5, 6, 15, 24], [1, 2, 8, 68]])
        np.testing.assert_array_equal(birds.keypoints_px[1, 0, :2], [[1, 2], [9, 70]])
        assert birds.mask(1, 0).sum() == 8 * 68
    assert (found.damaged_frames, found.failure, found.choice) == ([2], None, None)
    assert "no bird in 3.png" in caplog.text


def test_a_range_of_the_pictures_and_no_bird(folder):
    some = TrackConfig(FramesConfig(1, 2), SegmenterConfig("general"))
    found = track_photographs(folder, some)
    assert (found.observations.num_tracks, found.trust.level) == (0, "low")
    assert "no bird was detected in 1 picture" in str(found.failure)
    with pytest.raises(InputError, match="has no picture from 9 on"):
        track_photographs(folder, TrackConfig(FramesConfig(9)))
    with pytest.raises(InputError, match=r"2.png: is no folder"):
        track_photographs(folder / "2.png")


def test_auto_sees_the_pictures(folder, monkeypatch):
    monkeypatch.setattr(segmenter_choice, "installed_general", lambda: None)
    monkeypatch.setattr(Red, "__call__", Red.photograph)
    footage = Footage()
    monkeypatch.setattr(segmenter_choice, "open_keypoint_detector", lambda _: TrueKeypoints(footage))
    monkeypatch.setattr(
        segmenter_choice, "first_trust", lambda _, __, pictures, birds: type("Trust", (), {"level": "low"})
    )
    choice = track_photographs(folder).choice
    assert (choice.segmenter, "on 3 frames" in choice.reason) == ("builtin", True)
